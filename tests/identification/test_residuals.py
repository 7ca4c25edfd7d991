"""The misfit tests of whole fits: one-step models and windows of logs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from descents import estimate_of
from linear_system import linear, transitions
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.split_log import cut
from sim2gp.data.transitions import earlier_inputs, episode_numbers
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import (
    WindowsLikelihood,
    _linearise,
    compile_linearise,
    linearise,
)
from sim2gp.identification.misfit.residuals import (
    encode_angles,
    misfit_of_transitions,
    misfit_of_windows,
)
from sim2gp.identification.misfit.tests import Misfit, misfit
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems import Channel, Furuta
from sim2gp.types import in_float64
from simulated_logs import pendulum, simulated


def test_a_linear_fit_is_tested_on_its_own_rows() -> None:
    """Against the core, given the Jacobian that is known in closed form."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((300, 2, 3))
    y = J @ np.array([0.5, -1.0, 0.2]) + 0.1 * rng.standard_normal((300, 2))
    y[:, 1] += 0.2 * np.abs(J[:, 1, 0])  # not linear in the action: a misfit
    data, system = transitions(J, y), linear(3, 2)
    # Room for more rows, which must not count.
    padded = data.extend(np.full((1, 2), 9.0), np.full((1, 6), 9.0), np.ones((1, 2)))
    padded = dataclasses.replace(padded, mask=np.arange(600) < 300)
    estimate = np.linalg.lstsq(J.reshape(600, 3), y.reshape(600), rcond=None)[0]
    with jax.enable_x64(True):
        prior, noise = system.parameters.prior(), jnp.array([0.1, 0.15])
        posterior = Gaussian(jnp.asarray(estimate), prior.scale)
    likelihood = OneStepLikelihood(system, padded, 1.0)
    found = misfit_of_transitions(likelihood, prior, posterior, noise)
    sd, tt = np.asarray(noise), estimate
    theirs = misfit(
        (J @ tt - y) / sd, J.reshape(300, 6), jacobian=J / sd[:, None],
        past=earlier_inputs(J.reshape(300, 6), np.arange(300)), group=np.arange(300),
    )  # fmt: skip
    for name, finding in theirs.tests.items():
        ours, its = found.tests[name].statistic, finding.statistic
        assert ours == pytest.approx(its, rel=1e-6, nan_ok=True), name
    assert found.rows == 300
    assert found.tests["f_test"].alarm
    assert "x1" in found.tests["f_test"].text
    # Every row starts anew at zero: none follows another.
    assert "too few rows follow each other" in found.tests["ljung_box"].text


def test_inputs_of_the_tests() -> None:
    a = np.arange(6.0)[:, None]
    s = np.array([0.0, 1.0, 2.0, 3.0, 0.0, 1.0])[:, None]
    episode = episode_numbers(s, s + 1.0)
    np.testing.assert_array_equal(episode, [0, 0, 0, 0, 1, 1])
    past = earlier_inputs(a, episode)
    np.testing.assert_array_equal(past[3], [2.0, 1.0, 0.0])
    np.testing.assert_array_equal(past[1], [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(past[5], [4.0, 4.0, 4.0])
    channels = (Channel("q", "rad", angle=True), Channel("v", "rad/s"))
    columns = encode_angles(np.array([[0.3, 2.0]]), channels)
    np.testing.assert_allclose(columns, [[np.sin(0.3), np.cos(0.3), 2.0]])


@in_float64
def at_the_truth(windows: Windows, noise: float, start: np.ndarray) -> Estimate:
    """A fit that found the constants and these starts."""
    system, W = pendulum(), len(windows)
    prior = system.parameters.prior()
    nominal = Furuta().parameters.nominal()
    truth = jnp.asarray([nominal[name] for name in system.parameters.names])
    posterior = Gaussian(system.parameters.unconstrain(truth), 0.01 * prior.scale)
    sd = jnp.full(len(windows.outputs), noise)
    e = np.zeros_like(windows.start)
    away, free = start - windows.start, windows.start_sd > 0.0
    np.divide(away, windows.start_sd, out=e, where=free)
    return estimate_of(prior, posterior, Noise(sd, jnp.ones(W)), jnp.asarray(e))


def misfit_at_the_truth(windows: Windows, noise: float, start: np.ndarray) -> Misfit:
    found = at_the_truth(windows, noise, start)
    return misfit_of_windows(WindowsLikelihood(pendulum(), windows), found)


def test_one_step_rows_with_noisy_states_are_named() -> None:
    """The noise of a state enters twice, with both signs."""
    log = simulated(seconds=0.6, seed=1, noise=1e-4, velocities=True)
    windows, _ = cut([log], pendulum(), window=0.0)
    found = misfit_at_the_truth(windows, 1.4e-4, windows.start)
    assert found.rows == 299
    assert found.tests["ljung_box"].alarm
    assert "sensor noise on the states" in found.verdict
    assert "likelihood.window" in found.verdict


def test_windows_compiled_in_advance_are_linearised_alike(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    log = simulated(seconds=0.6, seed=1, noise=1e-4, velocities=True)
    windows, _ = cut([log], pendulum(), window=0.1)
    fitted = at_the_truth(windows, 1e-4, windows.start)
    likelihood = WindowsLikelihood(pendulum(), windows)
    plain = linearise(likelihood, fitted, fitted.posterior.mean)
    compile_linearise(pendulum(), windows)
    linearise(likelihood, fitted, fitted.posterior.mean)
    monkeypatch.setattr(_linearise, "_jitted", None)  # nothing is left to compile with
    again = linearise(likelihood, fitted, fitted.posterior.mean)
    jax.tree.map(np.testing.assert_array_equal, again, plain)


@pytest.mark.parametrize("delay", [0.0, 0.01])
@pytest.mark.nightly
def test_windows_find_a_delay(delay: float) -> None:
    exact, noisy = (
        simulated(seconds=1.3, seed=1, noise=sd, delay=delay, velocities=True)
        for sd in (0.0, 5e-4)
    )
    windows, _ = cut([noisy], pendulum(), window=0.2)
    start = cut([exact], pendulum(), window=0.2)[0].y[:, 0]
    found = misfit_at_the_truth(windows, 5e-4, start)
    assert found.rows == 600
    assert found.alarm is (delay > 0.0)
    if delay:
        assert "too narrow" in found.verdict
