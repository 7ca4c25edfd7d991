"""Windows that are made when they are asked for are those that are made at once."""

import dataclasses

import numpy as np
import pytest

from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut, cuts_of
from sim2gp.data.windows import Windows
from sim2gp.systems import UniformRodArm


def log_of(k: int, rows: int) -> Log:
    """A log with an uneven clock, missing samples and held torques."""
    rng = np.random.default_rng(k)
    time = np.cumsum(rng.uniform(0.005, 0.02, rows))
    mask = {name: rng.uniform(size=rows) < 0.8 for name in ("q1", "q2")}
    return Log(
        name=f"log{k}",
        source=f"log{k}.csv",
        time=time,
        channels={name: np.sin(time + i) for i, name in enumerate(mask)},
        inputs={name: rng.standard_normal(rows) for name in ("torque1", "torque2")},
        mask=mask,
        group=0,
    )


LOGS = [log_of(k, rows) for k, rows in enumerate((90, 40, 130))]


def fields(windows: Windows) -> dict[str, np.ndarray]:
    return {
        f.name: np.asarray(getattr(windows, f.name))
        for f in dataclasses.fields(windows)
    }


@pytest.fixture(scope="module")
def cuts() -> Cuts:
    return cuts_of(LOGS, UniformRodArm(), window=0.2)


def test_some_are_those_of_all(cuts: Cuts) -> None:
    """In any order, from several logs."""
    whole, places = cut(LOGS, UniformRodArm(), window=0.2)
    which = np.random.default_rng(0).permutation(len(cuts))[:9]
    assert len({cuts.pieces[w, 0] for w in which}) > 1
    some = fields(cuts.some(which))
    for name, values in fields(whole).items():
        own = values if name in ("floor", "outputs") else values[which]
        np.testing.assert_array_equal(some[name], own, err_msg=name)
    np.testing.assert_array_equal(cuts.counts, whole.counts)
    np.testing.assert_allclose(cuts.seconds, whole.seconds, rtol=1e-7)
    np.testing.assert_array_equal(cuts.places, places)
    assert cuts.length == whole.length
    assert cuts.most >= whole.most


def test_parts_are_as_large_and_hold_each_window_once(cuts: Cuts) -> None:
    parts = list(cuts.in_parts(7))
    assert len(cuts) % 7
    own = np.concatenate([own for own, _ in parts])
    np.testing.assert_array_equal(own, np.arange(len(cuts)))
    assert {windows.y.shape for _, windows in parts} == {(7, cuts.length, 2)}
    counts = np.concatenate([windows.counts for _, windows in parts])
    np.testing.assert_array_equal(counts[: len(cuts)], cuts.counts)
    assert not counts[len(cuts) :].any()


def test_a_mask_leaves_windows_without_data(cuts: Cuts) -> None:
    used = np.arange(len(cuts)) % 3 > 0
    both = cuts.masked(used).whole(), cuts.whole().masked(used)
    np.testing.assert_array_equal(*(np.asarray(windows.mask) for windows in both))
    counts = cuts.masked(used).counts
    np.testing.assert_array_equal(counts, cuts.counts * used[:, None])
