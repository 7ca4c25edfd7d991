"""The replay data: fixed capacities, masks, doubling, nothing lost."""

import logging

import jax
import numpy as np
import pytest

from sim2gp.data.transitions import Transitions

RNG = np.random.default_rng(0)


def rows(count, n=3, m=2):
    return tuple(RNG.standard_normal((count, k)) for k in (n, m, n))


def test_empty_has_room_and_no_rows():
    data = Transitions.empty(8, 3, 2)
    assert (data.count, data.state.shape, data.action.shape) == (0, (8, 3), (8, 2))
    assert not data.mask.any()
    assert Transitions.empty(0, 3, 2).state.shape == (1, 3)


def test_rows_stay_in_order_and_capacity_doubles(caplog):
    data, seen = Transitions.empty(4, 3, 2), []
    with caplog.at_level(logging.INFO, logger="sim2gp.data.transitions"):
        for count in (3, 1, 0, 5, 30):
            seen.append(rows(count))
            data = data.extend(*seen[-1])
    assert data.count == 39
    assert len(data.mask) == 64
    assert [r.args for r in caplog.records] == [(4, 16), (16, 64)]
    parts = (data.state, data.action, data.next_state)
    for got, expected in zip(parts, zip(*seen, strict=True), strict=True):
        np.testing.assert_array_equal(got[:39], np.concatenate(expected))
        np.testing.assert_array_equal(got[39:], 0.0)
    np.testing.assert_array_equal(data.mask, np.arange(64) < 39)


def test_extending_changes_nothing_else():
    one = Transitions.empty(8, 3, 2).extend(*rows(2))
    before = one.state.copy()
    two = one.extend(*rows(3))
    np.testing.assert_array_equal(one.state, before)
    assert (one.count, two.count) == (2, 5)


def test_a_full_buffer_does_not_double():
    data = Transitions.empty(4, 3, 2).extend(*rows(4))
    assert len(data.mask) == 4
    assert len(data.extend(*rows(0)).mask) == 4


def test_of_holds_exactly_these():
    given = rows(5)
    data = Transitions.of(*given)
    assert (data.count, len(data.mask)) == (5, 5)
    with jax.enable_x64(True):
        np.testing.assert_array_equal(data.delta(), given[2] - given[0])


def test_float32_rows_are_kept_in_double():
    data = Transitions.of(*(x.astype(np.float32) for x in rows(2)))
    assert data.state.dtype == np.float64


@pytest.mark.parametrize("bad", [(3, 4), (2, 3)])
def test_shapes_are_checked(bad):
    s, a, s2 = rows(4)
    with pytest.raises(Exception, match=r"type-?check|broadcast|shape"):
        Transitions.empty(8, 3, 2).extend(s[: bad[0]], a[: bad[1]], s2)
