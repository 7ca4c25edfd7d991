"""A fit in parts has the posterior of all data at once."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from sim2gp.data import windows_likelihood
from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cuts_of
from sim2gp.data.windows_likelihood import (
    AnyWindows,
    information_at,
    likelihood_of,
)
from sim2gp.errors import NotConverged
from sim2gp.identification import fit
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals import pulls
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.identification.missing_physics import reach
from sim2gp.inference import in_parts
from sim2gp.inference.estimate import Estimate, about_point
from sim2gp.inference.laplace import laplace
from sim2gp.inference.levenberg_marquardt import evaluate
from sim2gp.inference.prior import ParameterPrior
from sim2gp.project import training_windows
from sim2gp.systems import CartPole, UniformRodArm
from sim2gp.systems.simulate import HeldInputs, simulate
from sim2gp.types import in_float64

KEY, WINDOW, ROWS, NOISE = jax.random.key(0), 0.2, 120, 1e-3
PART = 7  # windows


def log_of(k: int) -> Log:
    """Half a dozen sines drive the arm; a sample in thirty is far off."""
    system, rng = UniformRodArm(), np.random.default_rng(k)
    time = 0.01 * np.arange(ROWS)
    waves = 2.0 * np.pi * rng.uniform(0.3, 2.0, (6, 2, 1)), rng.uniform(0, 6, (6, 2, 1))
    torque = 0.1 * np.sin(waves[0] * time + waves[1]).sum(axis=0).T
    with jax.enable_x64(True):
        params = system.record(system.values(system.parameters.prior().mean + 0.4))
        knots, area = time, np.cumsum(0.01 * torque, axis=0) - 0.01 * torque
        held = HeldInputs(np.diff(time, prepend=time[:1]), knots, area)
        states = np.asarray(simulate(system, params, held, jnp.zeros(4)))
    y = states[:, :2] + NOISE * rng.standard_normal((ROWS, 2))
    y[rng.uniform(size=ROWS) < 1 / 30] += 20.0 * NOISE
    return Log(
        name=f"log{k}",
        source=f"log{k}.csv",
        time=time,
        channels={"q1": y[:, 0], "q2": y[:, 1]},
        inputs={"torque1": torque[:, 0], "torque2": torque[:, 1]},
        mask={name: np.ones(ROWS, bool) for name in ("q1", "q2")},
    )


LOGS = [log_of(k) for k in range(4)]


@pytest.fixture(scope="module")
def cuts() -> Cuts:
    found = cuts_of(LOGS, UniformRodArm(), window=WINDOW)
    assert len(found) % PART
    return found


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch, cuts: Cuts) -> None:
    for module in (windows_likelihood, fit, reach):
        monkeypatch.setattr(module, "AT_A_TIME", PART * cuts.length)


@pytest.mark.parametrize("robust", [False, True])
def test_the_posterior_is_that_of_all_at_once(
    cuts: Cuts, robust: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And all parts share one trace, which is that of the first fit."""
    traces: list[int] = []
    blocks = windows_likelihood.WindowsLikelihood.blocks

    def counted(self: Any, *args: Any) -> Any:
        traces.append(len(self.counts))
        return blocks(self, *args)

    monkeypatch.setattr(windows_likelihood.WindowsLikelihood, "blocks", counted)
    jax.clear_caches()
    parts = fit_windows(cuts.system, cuts, key=KEY, robust=robust)
    assert traces == [PART]
    whole = fit_windows(cuts.system, cuts.whole(), key=KEY, robust=robust)
    same_posterior(parts, whole)
    names = ("nuisances", "scores")
    for name in names:
        pair = (np.asarray(getattr(x, name)) for x in (parts, whole))
        np.testing.assert_allclose(*pair, atol=1e-4, err_msg=name)
    weights = (np.asarray(x.noise.weights) for x in (parts, whole))
    np.testing.assert_allclose(*weights, rtol=1e-6)
    assert (np.min(np.asarray(parts.noise.weights)) < 0.5) == robust


@in_float64
def same_posterior(one: Estimate, other: Estimate) -> None:
    sd = np.asarray(other.posterior.sd())
    away = np.asarray(one.posterior.mean - other.posterior.mean) / sd
    np.testing.assert_allclose(away, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.asarray(one.posterior.sd()) / sd, 1.0, rtol=1e-6)
    noise = (np.asarray(x.noise.sd) for x in (one, other))
    np.testing.assert_allclose(*noise, rtol=1e-6)
    assert float(one.log_evidence) == pytest.approx(float(other.log_evidence), abs=1e-5)


@in_float64
def test_where_passes_rest_so_does_the_fit_of_all(cuts: Cuts) -> None:
    """At their noise all windows at once have this posterior, and no step is left.

    To 1e-9; a fit at once ends where its own noise rests, at a change of 1e-6.
    """
    system, found = cuts.system, fit_windows(cuts.system, cuts, key=KEY)
    whole = likelihood_of(system, cuts.whole())
    about = ParameterPrior(system.parameters.prior(), system.parameters)
    noise = found.noise
    at = evaluate(whole, about, found.z(), jnp.asarray(found.nuisances), noise)
    here = laplace(at, noise)
    assert float(here.newton_step_sd()) < 1e-9
    once = about_point(here, noise, about, whole.counts, 0)
    sd, same = (np.asarray(x.posterior.sd()) for x in (found, once))
    np.testing.assert_allclose(same, sd, rtol=1e-9)
    pair = (np.asarray(x.information) for x in (found, once))
    grams = [A.T @ A for A in pair]
    np.testing.assert_allclose(*grams, rtol=1e-9, atol=1e-9 * np.abs(grams[0]).max())


def test_a_warm_start_and_masked_windows(cuts: Cuts) -> None:
    """A fold begins at the fit of all, and sees some."""
    used = np.arange(len(cuts)) > 4
    first = fit_windows(cuts.system, cuts, key=KEY)
    parts = fit_windows(cuts.system, cuts.masked(used), key=KEY, warm_start=first)
    whole = fit_windows(cuts.system, cuts.some(used), key=KEY)
    same_posterior(parts, whole)


def test_passes_that_do_not_rest_are_no_answer(
    cuts: Cuts, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = fit_windows(cuts.system, cuts, key=KEY)
    with jax.enable_x64(True):
        away = first.posterior.mean + 30.0 * first.posterior.sd()
        far = jax.tree.map(lambda x: x, first)
        object.__setattr__(far.posterior, "mean", away)
    monkeypatch.setattr(in_parts, "MOST", 1)
    with pytest.raises(NotConverged, match="E201"):
        fit_windows(cuts.system, cuts, key=KEY, warm_start=far)


def test_what_follows_a_fit_is_the_same_in_parts(
    cuts: Cuts, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows of windows, residuals' tests, information elsewhere, and ranges."""
    system, whole = cuts.system, cuts.whole()
    found = fit_windows(system, whole, key=KEY)
    group = cuts.places[:, 0]
    each = cuts.length * 4 * (4 + len(system.parameters))
    monkeypatch.setattr(windows_likelihood, "TOGETHER", PART * each)

    def asked(likelihood: AnyWindows) -> tuple[Any, ...]:
        with jax.enable_x64(True):
            rows = pulls.rows_of(likelihood, found, found.posterior.mean, group)
            A = information_at(likelihood, found)(found.posterior.mean + 0.1)
            tested = misfit_of_windows(likelihood, found)
            gram = np.swapaxes(rows.factors, 1, 2) @ rows.factors
            values = [finding.p for finding in tested.tests.values()]
            return gram, rows.costs, np.asarray(A.T @ A), np.asarray(values, float)

    pair = (asked(likelihood_of(system, windows)) for windows in (cuts, whole))
    for one, other in zip(*pair, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-6)
    assert reach.box_of(system, cuts) == reach.box_of(system, whole)
    cart = reach.box_of(CartPole(), whole)
    assert cart == reach.box_of(CartPole(), cuts)


@pytest.mark.nightly
def test_identify_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = sg.identify(UniformRodArm(), LOGS)
    monkeypatch.setattr(training_windows, "MANY", 10)
    parts = sg.identify(UniformRodArm(), LOGS)
    for name, entry in whole.summary["parameters"].items():
        for what in ("mean", "sd"):
            got = parts.summary["parameters"][name][what]
            assert got == pytest.approx(entry[what], rel=1e-6)
    errors = (x.summary["held_out"]["open_loop_rmse"] for x in (parts, whole))
    one, other = errors
    assert one == pytest.approx(other, rel=1e-6)
    assert parts.summary["misfit"]["alarm"] == whole.summary["misfit"]["alarm"]
