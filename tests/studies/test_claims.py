"""Claims of studies: bootstrap intervals, comparisons, looking in many places."""

import numpy as np
import pytest
import scipy.stats

from sim2gp.studies import claims


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def seeds(z: float, count: int = 20) -> np.ndarray:
    """Differences whose mean is ``z`` standard errors from zero."""
    x = np.random.default_rng(0).standard_normal(count)
    x = (x - x.mean()) / x.std()
    return x + z / np.sqrt(count)


@pytest.mark.parametrize(("level", "z"), [(0.95, 1.960), (0.5, 0.674)])
def test_a_bootstrap_interval_covers_the_mean(level: float, z: float):
    """Of normal samples: mean -+ z sd / sqrt(n), nearly."""
    sample = np.random.default_rng(1).standard_normal(200)
    low, high = claims.bootstrap_interval(sample, rng(), level)
    half = z * sample.std() / np.sqrt(200)
    assert low == pytest.approx(sample.mean() - half, abs=0.02)
    assert high == pytest.approx(sample.mean() + half, abs=0.02)


@pytest.mark.parametrize("lost", [0, 10])
def test_a_medians_interval_is_its_exact_bootstrap(lost: int):
    """A resample's median is at most the k-th where half of it or more is among k."""
    count = 21
    values = np.arange(1.0, count + 1)
    shares = scipy.stats.binom(count, np.arange(1, count + 1) / count).sf(count // 2)
    shares = np.diff(shares, prepend=0.0)  # of each value, to be the median
    cumulative = np.cumsum(shares)
    low, high = (values[np.searchsorted(cumulative, t)] for t in (0.025, 0.975))
    values[count - lost :] = np.inf  # seeds that never got there
    middle, below, above = claims.bootstrap_median(values[::-1], rng())
    assert (middle, below) == (11.0, low)
    assert above == (np.inf if lost else high)


def test_every_resample_has_as_many_seeds():
    weights = claims.bootstrap_weights(7, rng())
    np.testing.assert_array_equal(weights.sum(axis=1), 7.0)
    assert weights.mean(axis=0) == pytest.approx(np.ones(7), abs=0.05)
    assert weights.var(axis=0) == pytest.approx(np.full(7, 6 / 7), abs=0.08)


def test_the_best_is_asked_of_all_others():
    base = np.zeros(20)
    rivals = {"RES": base, "close": base + seeds(1.0), "far": base - 5.0}
    assert claims.at_least_as_good("RES", rivals, rng(), "")["holds"]
    rivals["better"] = base + seeds(4.0)
    found = claims.at_least_as_good("RES", rivals, rng(), "words")
    assert not found["holds"]
    assert found["figure"].endswith("to better")
    assert found["text"] == "words"


def test_a_lost_seed_is_not_a_tie():
    base = np.zeros(20)
    lost = np.where(np.arange(20) < 2, -np.inf, base)
    assert claims.at_least_as_good("RES", {"RES": base, "FS": lost}, rng(), "")["holds"]
    found = claims.at_least_as_good("RES", {"RES": lost, "FS": base}, rng(), "")
    assert not found["holds"]
    assert found["figure"] == "no score on 2 seeds, FS has one"
    both = {"RES": lost, "FS": lost - 1.0}
    assert claims.at_least_as_good("RES", both, rng(), "")["holds"]
    nothing = np.full(20, -np.inf)
    both = {"RES": nothing, "FS": nothing}
    assert not claims.at_least_as_good("RES", both, rng(), "")["holds"]


def test_who_looks_in_many_places_needs_more():
    """2.4 standard errors are something in one place and nothing in fifteen."""
    base = np.zeros(20)
    places = {"here": (seeds(2.4), base)}
    found = claims.better_somewhere(places, rng(), "")
    assert found["holds"]
    assert found["figure"].startswith("here: +0.53")
    places |= {f"place {i}": (seeds(-1.0), base) for i in range(14)}
    assert not claims.better_somewhere(places, rng(), "")["holds"]
    places["there"] = (seeds(6.0), base)
    found = claims.better_somewhere(places, rng(), "")
    assert found["holds"]
    assert found["figure"].startswith("there: ")
