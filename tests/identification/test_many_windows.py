"""Very many windows are worked on some at a time; what comes out is the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linear_system import linear
from sim2gp.data import windows as windows_module
from sim2gp.data import windows_likelihood
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals import pulls
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.inference.estimate import Estimate

COUNT = 23  # windows, no multiple of what is done at a time


@pytest.fixture(scope="module")
def fitted() -> tuple[WindowsLikelihood, Estimate]:
    """A linear machine of two constants and a state."""
    rows, rng = 6 * COUNT + 1, np.random.default_rng(30)
    a = np.repeat(rng.standard_normal((rows // 4 + 1, 2)), 4, axis=0)[:rows]
    x = np.cumsum(np.concatenate([[0.0], 0.1 * a[:-1] @ [0.7, -0.4]]))
    log = Log(
        name="log",
        source="log.csv",
        time=0.1 * np.arange(rows),
        channels={"x0": x + 0.02 * rng.standard_normal(rows)},
        inputs={"a0": a[:, 0], "a1": a[:, 1]},
        mask={"x0": np.ones(rows, bool)},
    )
    system = linear(2, 1)
    found, _ = cut([log], system, window=0.6)
    assert len(found) == COUNT
    fit = fit_windows(system, found, key=jax.random.key(0))
    return WindowsLikelihood(system, found), fit


def test_rows_of_some_at_a_time(
    fitted: tuple[WindowsLikelihood, Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    likelihood, found = fitted
    with jax.enable_x64(True):
        tt, group = found.posterior.mean + 0.1, np.zeros(COUNT, int)
        whole = pulls.rows_of(likelihood, found, tt, group)
        each = likelihood.windows.span.shape[1] * 1 * 3  # derivatives of a window
        monkeypatch.setattr(windows_likelihood, "TOGETHER", 4 * each)
        assert windows_likelihood.together(likelihood.system, likelihood.windows) == 4
        parts = pulls.rows_of(likelihood, found, tt, group)
    grams = (np.swapaxes(x.factors, 1, 2) @ x.factors for x in (parts, whole))
    np.testing.assert_allclose(*grams, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(parts.costs, whole.costs, rtol=1e-9)


def test_a_program_of_some_windows_at_a_time(
    fitted: tuple[WindowsLikelihood, Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    likelihood, found = fitted
    with jax.enable_x64(True):
        args = found.posterior.mean, jnp.asarray(found.nuisances), found.prior.scale
        whole = likelihood.blocks(*args)
        rows = likelihood.windows.span.shape[1]
        monkeypatch.setattr(windows_module, "AT_A_TIME", 5 * rows)
        parts = likelihood.blocks(*args)
    np.testing.assert_allclose(parts, whole, rtol=1e-12, atol=1e-12)


def gram(factors: np.ndarray) -> np.ndarray:
    """Fisher information of windows together, added up one by one."""
    return np.sum([F.T @ F for F in factors], axis=0)


def test_runs_of_windows_say_what_their_windows_say() -> None:
    """Of one group alone, in their order."""
    rng = np.random.default_rng(31)
    factors, costs = rng.standard_normal((COUNT, 5, 4)), rng.uniform(size=COUNT)
    group, each = np.repeat([3, 1], [14, 9]), np.arange(COUNT)
    rows = pulls.WindowRows(factors, costs, each)
    alone = pulls.pulls_of_rows(rows, group)
    joined = rows.in_runs(group, 3)
    runs = pulls.pulls_of_rows(joined, group)
    assert runs.group.tolist() == [3] * 5 + [1] * 3
    members = np.split(each, [3, 6, 9, 12, 14, 17, 20])
    assert joined.first.tolist() == [own[0] for own in members]
    for run, own in enumerate(members):
        pair = gram(runs.factors[run : run + 1]), gram(alone.factors[own])
        np.testing.assert_allclose(*pair, atol=1e-12)
        score = alone.scores[own].sum(axis=0)
        np.testing.assert_allclose(runs.scores[run], score, atol=1e-12)
        assert joined.costs[run] == pytest.approx(costs[own].sum())


@pytest.mark.parametrize(
    ("group", "of_runs"),
    [
        (np.repeat([0, 1], [11, 12]), [0] * 4 + [1] * 4),
        (np.arange(COUNT), [0, 3, 6, 9, 12, 15, 18, 21]),  # logs of one window each
    ],
)
def test_of_many_windows_rows_are_those_of_runs(
    group: np.ndarray,
    of_runs: list[int],
    fitted: tuple[WindowsLikelihood, Estimate],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """All that intervals ask of the windows together stays."""
    likelihood, found = fitted
    whole = pulls.pulls_of_windows(likelihood, found, group)
    monkeypatch.setattr(pulls, "MOST", 8)
    runs = pulls.pulls_of_windows(likelihood, found, group)
    assert runs.group.tolist() == of_runs
    totals = runs.fisher, gram(whole.factors)
    np.testing.assert_allclose(*totals, rtol=1e-10)
    totals = (x.scores.sum(axis=0) for x in (runs, whole))
    np.testing.assert_allclose(*totals, rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("groups", [1, 2, COUNT])
def test_a_run_has_windows_of_several_parts(
    groups: int,
    fitted: tuple[WindowsLikelihood, Estimate],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two windows are linearised at a time, and four or more are a run."""
    likelihood, found = fitted
    group = np.arange(COUNT) * groups // COUNT
    whole = pulls.pulls_of_windows(likelihood, found, group)
    monkeypatch.setattr(pulls, "MOST", 6)
    each = likelihood.windows.span.shape[1] * 1 * 3
    monkeypatch.setattr(windows_likelihood, "TOGETHER", 2 * each)
    tt = found.posterior.mean
    rows = pulls.rows_of(likelihood, found, tt, group)
    assert len(rows.first) <= 2 * 6
    if groups == 1:
        assert rows.first.tolist() == [0, 4, 8, 12, 16, 20]
    runs = pulls.pulls_of_rows(rows, group)
    np.testing.assert_allclose(runs.fisher, gram(whole.factors), rtol=1e-10)
    totals = (x.scores.sum(axis=0) for x in (runs, whole))
    np.testing.assert_allclose(*totals, rtol=1e-7, atol=1e-9)


def test_residuals_are_tested_on_windows_from_everywhere(
    fitted: tuple[WindowsLikelihood, Estimate], monkeypatch: pytest.MonkeyPatch
) -> None:
    likelihood, found = fitted
    whole = misfit_of_windows(likelihood, found)
    each = likelihood.windows.span.shape[1] * 1 * 3
    monkeypatch.setattr(windows_likelihood, "TOGETHER", 8 * each)
    some = misfit_of_windows(likelihood, found)
    which = np.linspace(0, COUNT - 1, 8).round().astype(int)
    assert {0, COUNT - 1} <= set(which.tolist())
    counts = np.asarray(likelihood.counts).sum(axis=1)
    assert some.rows == counts[which].sum() < whole.rows
