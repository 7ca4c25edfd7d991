"""Logs at an even period: inputs, states and rollouts, each computed another way."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.belief import AbstractBelief
from sim2gp.data.grid import evaluation_windows, steps_of
from sim2gp.data.logs import Log
from sim2gp.data.one_step_log import (
    Steps,
    mean_inputs,
    samples_of,
    smoothed_states,
    steps_of_grid,
    transitions,
)
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import Sim2GP, Sim2GPBelief
from sim2gp.models.ensemble import ensemble
from sim2gp.systems import AbstractSystem, Delay, free_parts
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.simulate import simulate
from sim2gp.types import Dynamics, in_float64
from simulated_logs import pendulum, simulated

PERIOD = 0.02
DELAY = 0.007


def behind_delay() -> AbstractSystem:
    """The pendulum with a delay to be learned."""
    return free_parts(pendulum(), [Delay("voltage")])


@in_float64
def known(system: AbstractSystem) -> Gaussian:
    """A posterior that is sure of the published constants and of the delay."""
    values = pendulum().parameters.nominal() | {"voltage.delay": DELAY}
    theta = jnp.asarray([values[name] for name in system.parameters.names])
    tt = system.parameters.unconstrain(theta)
    return Gaussian(tt, 1e-9 * jnp.eye(tt.size))


@pytest.fixture(scope="module")
def log() -> Log:
    return simulated(seconds=1.2, seed=5, delay=DELAY)


def test_mean_inputs_are_integrals_of_what_was_held(log: Log) -> None:
    since = np.asarray([0.1, 0.3333, 1.19])
    found = mean_inputs(log, ["voltage"], since, PERIOD, 2, 3)
    assert found.shape == (3, 5, 1)
    # Every input is held for 40 ms from a multiple of it; sampled finely instead.
    u = log.inputs["voltage"]
    for w, t in enumerate(since):
        for k in range(5):
            fine = t + PERIOD * (k - 2 + (np.arange(4000) + 0.5) / 4000)
            row = np.clip(np.searchsorted(log.time, fine, side="right") - 1, 0, None)
            assert found[w, k, 0] == pytest.approx(u[row].mean(), abs=5e-3)


def test_the_delay_stays_a_constant_and_the_past_is_carried() -> None:
    system = behind_delay()
    stepper = carrying_inputs(system, PERIOD)
    assert stepper.parameters == system.parameters
    assert [c.name for c in stepper.states[4:]] == ["voltage[-1]"]
    assert carrying_inputs(pendulum(), PERIOD) == pendulum()
    half = carrying_inputs(system, 0.01)
    assert [c.name for c in half.states[4:]] == ["voltage[-1]", "voltage[-2]"]


def test_rows_follow_each_other_and_carry_the_past(log: Log) -> None:
    stepper = carrying_inputs(behind_delay(), PERIOD)
    samples = samples_of([log, log], stepper, PERIOD)
    data, of = transitions(samples, samples.rough), samples.step_log()
    count = data.count
    assert len(of) == count == len(data.mask)
    np.testing.assert_array_equal(of, np.repeat([0, 1], count // 2))
    # The past input of a row is the action of the one before it.
    half = count // 2
    state, action, then = (
        np.asarray(x)[:half] for x in (data.state, data.action, data.next_state)
    )
    np.testing.assert_allclose(state[1:, 4:], action[:-1], atol=1e-12)
    np.testing.assert_allclose(then[:-1], state[1:], atol=1e-12)
    np.testing.assert_allclose(then[:, 4:], action, atol=1e-12)


def test_smoothed_states_are_the_machines_own() -> None:
    """Of a pendulum that swings freely, angles recorded exactly."""
    system = pendulum()
    with jax.enable_x64(True):
        tt = known(behind_delay()).mean[:3]
        nothing = jnp.zeros(1)

        def step(s: jax.Array, period: float) -> jax.Array:
            return system.transition(tt, s, nothing, period)

        s0 = jnp.asarray([0.1, 1.2, 0.5, -1.0])
        path = jax.lax.scan(lambda s, _: (step(s, 2e-3), s), s0, None, length=500)[1]
        y = {"theta": np.asarray(path[:, 0]), "alpha": np.asarray(path[:, 1])}
        whole = {name: np.ones(500, bool) for name in y}
        time = 2e-3 * np.arange(500)
        log = Log("free", "free", time, y, {"voltage": np.zeros(500)}, whole)
        samples = samples_of([log], system, PERIOD)
        truth = np.asarray(path)[20:488:10]
        smooth = smoothed_states(system, tt, samples)
        other = smoothed_states(system, tt + 0.1, samples)
    assert smooth.shape == truth.shape

    def off(states: np.ndarray) -> np.ndarray:
        return np.sqrt(np.mean((states - truth) ** 2, axis=0))

    # A parabola alone is off by the swing's third derivative.
    assert off(samples.rough)[3] > 0.05
    np.testing.assert_array_less(off(smooth), 2e-3)
    # A machine that is not quite the simulator is still recorded as it is.
    np.testing.assert_array_less(off(other), 0.1 * off(samples.rough))
    data = transitions(samples, smooth)
    np.testing.assert_allclose(data.state[1:], data.next_state[:-1], atol=1e-12)


def test_masked_samples_leave_no_transition(log: Log) -> None:
    bad = {name: mask.copy() for name, mask in log.mask.items()}
    bad["alpha"][300] = False
    other = Log(log.name, log.source, log.time, log.channels, log.inputs, bad)
    system = carrying_inputs(pendulum(), PERIOD)
    whole, part = (len(samples_of([x], system, PERIOD).first) for x in (log, other))
    # A parabola spans 50 ms, a transition has two of them 20 ms apart.
    assert whole - part in (3, 4)


@pytest.mark.nightly
def test_rollouts_are_the_windows_forecasts(log: Log) -> None:
    """At 20 ms with mean inputs, the point is the forecast at 2 ms."""
    system = behind_delay()
    grid = evaluation_windows([log], system, longest=0.2)
    stepper = carrying_inputs(system, PERIOD)
    steps = steps_of_grid(grid, [log], stepper, PERIOD, (5, 10))
    posterior = known(system)
    rows = np.asarray([steps_of(0.1), steps_of(0.2)])
    fine = simulated_at(system, posterior, grid.windows, rows)
    np.testing.assert_array_equal(steps.y, np.asarray(grid.windows.y)[:, rows])
    np.testing.assert_array_equal(steps.valid, np.asarray(grid.windows.mask)[:, rows])
    belief = frozen(stepper, posterior)
    key = jax.random.key(0)
    found = ensemble(belief, steps, np.zeros(4), draws=2, key=key)
    np.testing.assert_allclose(found.point, fine, atol=4e-3)
    moved = np.abs(fine - np.asarray(grid.windows.start)[:, None, :2])
    assert moved.max() > 0.3


@in_float64
def simulated_at(
    system: AbstractSystem, posterior: Gaussian, windows: Windows, rows: np.ndarray
) -> np.ndarray:
    """Angles at rows of the grid, every window at 2 ms under the recorded inputs."""
    params = system.record(system.parameters.values(posterior.mean))
    exact = jax.tree.map(jnp.asarray, windows)
    run = jax.jit(
        lambda w: w.each(lambda one: simulate(system, params, one, one.start))
    )
    return np.asarray(run(exact))[:, rows, :2]


@in_float64
def frozen(stepper: AbstractSystem, prior: Gaussian) -> Sim2GPBelief:
    """A simulator with its constants given, and no noise."""
    belief = Sim2GP(stepper, dt=PERIOD, prior=prior).init(jax.random.key(0))
    return eqx.tree_at(lambda b: b.noise, belief, jnp.zeros(4))


class Standing(AbstractBelief):
    """A machine that stays where it is but for the noise of a step."""

    noise: jax.Array

    def point(self) -> Dynamics:
        return Stays(jnp.zeros((), jnp.float32))

    def sample(self, key: jax.Array) -> Dynamics:
        return Stays(0.1 * jax.random.normal(key, (), jnp.float32))

    def latent(self, s: jax.Array, a: jax.Array) -> Gaussian:
        raise AssertionError("not of interest here")

    predict = sensitivity = coordinates = latent


class Stays(eqx.Module):
    """A draw: where it is, moved by a constant of its own."""

    off: jax.Array

    def __call__(self, s: jax.Array, a: jax.Array) -> jax.Array:
        return s + self.off * jnp.asarray([0.0, 0.0, 1.0, 0.0], jnp.float32)


def test_draws_spread_by_function_start_and_noise() -> None:
    """Variances add up as a random walk's; a draw's function is one for all windows."""
    W = 1500
    windows = Steps(
        np.zeros((W, 4)),
        np.zeros((W, 4, 1)),
        np.zeros((W, 2, 3)),
        np.ones((W, 2, 3), bool),
        np.zeros(W, int),
        (1, 4),
        (0, 1, 2),
    )
    start_sd = np.asarray([0.03, 0.0, 0.0, 0.0])
    with jax.enable_x64(True):
        belief = Standing(jnp.asarray([0.04, 0.04, 0.0, 0.0]))
    found = ensemble(belief, windows, start_sd, draws=4, key=jax.random.key(1))
    np.testing.assert_array_equal(found.point, 0.0)
    sd = found.draws.std(axis=(0, 1))
    np.testing.assert_allclose(sd[0, :2], [0.05, 0.04], rtol=0.05)
    np.testing.assert_allclose(sd[1, :2], [np.hypot(0.03, 0.08), 0.08], rtol=0.05)
    # Every draw and window has a start and a noise of its own.
    one, other = found.draws[:2, :, 0, 0]
    assert abs(np.corrcoef(one, other)[0, 1]) < 0.1
    assert np.ptp(found.draws[:, :, 0, 2], axis=1).max() == 0.0
    off = found.draws[:, 0, 0, 2]
    assert len(set(off)) == 4
    np.testing.assert_allclose(found.draws[:, 0, 1, 2], 4.0 * off, rtol=1e-5)


@pytest.mark.nightly
def test_given_constants_are_not_learned_twice() -> None:
    """The noise alone is fitted: about the residuals' rms, whatever the prior's sd."""
    system = pendulum()
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        nominal = system.parameters.nominal()
        theta = jnp.asarray([nominal[n] for n in system.parameters.names])
        tt = system.parameters.unconstrain(theta)
        prior = Gaussian(tt, 0.01 * jnp.eye(tt.size))
        S = jnp.asarray(rng.uniform(-1.0, 1.0, (300, 4)))
        A = jnp.asarray(rng.uniform(-4.0, 4.0, (300, 1)))
        off = tt + 0.3  # data of another machine: a fit would move there
        then = jax.vmap(lambda s, a: system.transition(off, s, a, PERIOD))(S, A)
        here = jax.vmap(lambda s, a: system.transition(tt, s, a, PERIOD))(S, A)
    data = Transitions.of(np.asarray(S), np.asarray(A), np.asarray(then))
    model = Sim2GP(system, dt=PERIOD, prior=prior, frozen=True)
    belief = model.init(jax.random.key(0))
    fitted = model.fit(belief, data, key=jax.random.key(0))
    np.testing.assert_array_equal(fitted.posterior.mean, prior.mean)
    np.testing.assert_array_equal(fitted.posterior.scale, prior.scale)
    rms = np.sqrt(np.mean(np.asarray(then - here) ** 2, axis=0))
    np.testing.assert_allclose(fitted.noise, rms, rtol=0.02)
    assert int(fitted.count) == 300
    gain = np.asarray(fitted.information)
    assert not gain.any()
