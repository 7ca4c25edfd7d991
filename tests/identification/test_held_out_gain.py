"""Forces that predict recordings left out: against refits, and by their level."""

import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from sim2gp.identification.missing_physics.held_out_gain import (
    LEVEL,
    MOST,
    SCALES,
    WORTH,
    LeaveOneOut,
    helpful_kinds,
    recordings_or_parts,
)

OWN = np.array([0, 3])
KINDS = {"first": np.array([1, 2]), "second": np.array([4]), "third": np.array([5])}
P, ROWS = 6, 60


def problem(
    rng: np.random.Generator, force: float = 0.0, rho: float = 0.0, recordings: int = 5
) -> LeaveOneOut:
    """Slow sensitivities, noise of a colour, and a force of the second kind."""
    found, true = [], np.zeros(P)
    true[KINDS["second"]] = force
    for _ in range(recordings):
        A = np.cumsum(rng.standard_normal((ROWS, P)), axis=0) / np.sqrt(ROWS)
        noise = rng.standard_normal(ROWS)
        for k in range(1, ROWS):
            noise[k] = rho * noise[k - 1] + np.sqrt(1.0 - rho**2) * noise[k]
        found.append(np.column_stack([A, A @ -true + noise]))
    return LeaveOneOut(found, OWN, np.array([0.3, -0.2]), KINDS)


def refitted(data: LeaveOneOut, scales: dict[str, float]) -> np.ndarray:
    """The error of each recording after a descent on all rows of the others."""
    sd = np.zeros(P)
    sd[OWN] = 1.0
    for kind, tau in scales.items():
        sd[KINDS[kind]] = tau
    free = np.flatnonzero(sd)
    start = np.zeros(P)
    start[OWN] = data.at
    out = []
    for b, tested in enumerate(data.rows):
        others = np.concatenate([x for k, x in enumerate(data.rows) if k != b])

        def residual(w, others=others):
            full = np.zeros(P)
            full[free] = w
            data_rows = others[:, :-1] @ full + others[:, -1]
            return np.concatenate([data_rows, (start + full)[free] / sd[free]])

        w = scipy.optimize.least_squares(residual, np.zeros(len(free)), xtol=1e-15).x
        out.append(np.sum((tested[:, free] @ w + tested[:, -1]) ** 2))
    return np.asarray(out)


@pytest.mark.parametrize("scales", [{}, {"second": 0.3}, {"third": 1.0, "first": 0.1}])
def test_misfits_are_those_of_refits(scales: dict[str, float]) -> None:
    data = problem(np.random.default_rng(0), force=1.0, rho=0.8)
    expected = refitted(data, scales)
    np.testing.assert_allclose(data.misfit(scales), expected, rtol=1e-6)


def test_the_force_that_is_there_is_chosen_by_a_paired_test() -> None:
    """Also against SciPy's t test of the refits' gains."""
    data = problem(np.random.default_rng(1), force=2.0)
    found = helpful_kinds(data)
    assert set(found) == {"second"}
    without = refitted(data, {})
    gains = {tau: 1.0 - refitted(data, {"second": tau}) / without for tau in SCALES}
    assert max(gains, key=lambda tau: gains[tau].mean()) == found["second"]
    gain = gains[found["second"]]
    test = scipy.stats.ttest_1samp(gain, 0.0, alternative="greater")
    assert test.pvalue <= LEVEL / len(KINDS)
    assert gain.mean() >= WORTH


@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_without_missing_physics_forces_are_chosen_in_one_case_of_twenty(
    rho: float,
) -> None:
    rng, sets = np.random.default_rng(2), 100
    wrong = sum(bool(helpful_kinds(problem(rng, rho=rho))) for _ in range(sets))
    assert wrong <= scipy.stats.binom.ppf(0.99, sets, LEVEL)


def test_one_recording_alone_says_nothing() -> None:
    assert not helpful_kinds(problem(np.random.default_rng(4), 5.0, recordings=1))


def test_few_recordings_are_cut_into_parts_in_order() -> None:
    one = recordings_or_parts(np.zeros(40, int))
    np.testing.assert_array_equal(one, np.repeat(np.arange(10), 4))
    three = recordings_or_parts(np.repeat([0, 1, 5], 8))
    np.testing.assert_array_equal(three, np.repeat(np.arange(12), 2))
    few = recordings_or_parts(np.zeros(3, int))
    assert len(np.unique(few)) == 3
    many = np.array([0, 0, 1, 2, 3])
    np.testing.assert_array_equal(recordings_or_parts(many), many)


def test_very_many_recordings_are_joined_in_order() -> None:
    """A fit for each of thousands would be asked for a fit of all others."""
    found = recordings_or_parts(np.repeat(np.arange(3, 1003), 2))
    np.testing.assert_array_equal(found, np.repeat(np.arange(MOST), 20))
