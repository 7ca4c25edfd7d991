"""The next experiment: what it would tell, its limits, and what is asked of it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sim2gp.experiment_design as d
from descents import estimate_of
from design_cases import (
    PERIOD,
    STEPS,
    WINDOW,
    commands,
    delayed,
    experiment,
    limits,
)
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood, information_at
from sim2gp.experiment_design import by_gradients
from sim2gp.experiment_design.limits import clip_commands, excess
from sim2gp.inference.arrowhead import Noise
from simulated_logs import pendulum

pytestmark = pytest.mark.usefixtures("float64")

TRAJECTORY, INFORMATION = eqx.filter_jit(d.trajectory), eqx.filter_jit(d.information)
ROWS = eqx.filter_jit(d.experiment.sensitivity_at)


@pytest.mark.parametrize(
    "system",
    [
        pytest.param(pendulum(), id="plain", marks=pytest.mark.nightly),
        pytest.param(delayed(), id="delayed"),
    ],
)
@pytest.mark.nightly
def test_it_tells_what_the_log_of_it_would(system) -> None:
    """Against `data.windows_likelihood`, on the log that the experiment would leave."""
    e, U = experiment(system), commands()
    nowhere = jnp.zeros_like(e.belief.mean)
    states = TRAJECTORY(e, e.belief.at(nowhere), U)
    y = np.asarray(states)[:-1]
    log = Log(
        name="log",
        source="log.csv",
        time=PERIOD * np.arange(STEPS),
        channels={"theta": y[:, 0], "alpha": y[:, 1]},
        inputs={"voltage": np.asarray(U)[:, 0]},
        mask={n: np.ones(STEPS, bool) for n in ("theta", "alpha")},
        notes=(),
    )
    sd = dict(zip(("theta", "alpha"), (0.05, 0.05), strict=True))
    sd |= {f"{n}.velocity": 1.0 for n in ("theta", "alpha")}
    windows, rows = cut([log], system, window=WINDOW * PERIOD, start_sd=sd)
    starts = (y[[i for _, i in rows]] - windows.start) / windows.start_sd
    noise = Noise(e.noise, jnp.ones(len(windows)))
    fitted = estimate_of(e.belief, e.belief, noise, jnp.asarray(starts))
    likelihood = WindowsLikelihood(system, windows)
    theirs = np.asarray(information_at(likelihood, fitted)(e.belief.mean))
    ours = np.asarray(INFORMATION(e, nowhere, U, states))
    np.testing.assert_allclose(ours.T @ ours, theirs.T @ theirs, rtol=1e-6)
    scale = np.asarray(d.posterior_scale(e.belief, jnp.asarray(ours)))
    precision = np.linalg.inv(np.asarray(e.belief.covariance()))
    S0 = np.linalg.inv(np.asarray(e.belief.scale))
    precision = precision + S0.T @ (theirs.T @ theirs) @ S0
    np.testing.assert_allclose(scale @ scale.T, np.linalg.inv(precision), rtol=1e-6)


def test_a_plan_moves_as_the_system_steps() -> None:
    """Period by period, but for the blur of the inputs' edges."""
    e, U = experiment(), commands()
    states = np.asarray(TRAJECTORY(e, e.belief.mean, U))
    with jax.enable_x64(True):
        params = e.record(e.belief.mean)
        step = jax.jit(lambda s, a: e.system.step(params, s, a, PERIOD))
        s = np.asarray(e.start)
        for k, a in enumerate(np.asarray(U)):
            s = np.asarray(step(jnp.asarray(s), jnp.asarray(a)))
            np.testing.assert_allclose(states[k + 1], s, rtol=1e-3, atol=1e-3)


# ----------------------------------------------------------------- goals
def test_goals_are_those_of_dense_covariances() -> None:
    rng = np.random.default_rng(0)
    before, after = (rng.standard_normal((4, 4)) for _ in range(2))
    C0, C1 = before @ before.T, after @ after.T

    def nats(goal: d.AbstractGoal) -> float:
        return float(goal.nats(jnp.asarray(before), jnp.asarray(after)))

    def volume(C: np.ndarray) -> float:
        return 0.5 * float(np.linalg.slogdet(C)[1])

    assert nats(d.DOptimal()) == pytest.approx(volume(C0) - volume(C1), rel=1e-10)
    some = np.ix_([2, 0], [2, 0])
    expected = volume(C0[some]) - volume(C1[some])
    assert nats(d.SubsetDOptimal((2, 0))) == pytest.approx(expected, rel=1e-10)
    G = rng.standard_normal((5, 4))
    ratio = np.trace(G @ C0 @ G.T) / np.trace(G @ C1 @ G.T)
    goal = d.VOptimal(jnp.asarray(G))
    assert nats(goal) == pytest.approx(0.5 * np.log(ratio), rel=1e-10)


def test_goals_count_their_directions() -> None:
    """All sd smaller by one factor are worth its log, once for each direction."""
    scale = jnp.asarray(np.random.default_rng(0).standard_normal((4, 4)))
    goals = (d.DOptimal(), d.SubsetDOptimal((2, 0)), d.VOptimal(scale[:3]))
    for goal, count in zip(goals, (4, 2, 1), strict=True):
        assert goal.directions(scale) == count
        worth = float(goal.nats(scale, scale / 1.7))
        assert worth == pytest.approx(count * np.log(1.7), rel=1e-10)


@pytest.mark.nightly
def test_a_prediction_depends_on_what_moves_it() -> None:
    """Rows against differences of simulations over the horizon."""
    e, U = experiment(), commands(1)
    periods = 25
    rows = np.asarray(ROWS(e, U, periods))
    states = np.asarray(TRAJECTORY(e, e.belief.mean, U))
    step, at = 1e-5, 3  # the fourth prediction
    ahead = []
    for sign in (1.0, -1.0):
        moved = eqx.tree_at(lambda x: x.start, e, jnp.asarray(states[at * periods]))
        tt = e.belief.mean.at[1].add(sign * step)
        future = U[at * periods :]
        moved = dataclasses.replace(moved, steps=len(future))
        ahead.append(np.asarray(TRAJECTORY(moved, tt, future))[periods])
    slope = (ahead[0] - ahead[1])[:2] / (2.0 * step) / np.asarray(e.noise)
    np.testing.assert_allclose(rows[2 * at : 2 * at + 2, 1], slope, rtol=1e-5)


# ---------------------------------------------------------------- limits
@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.05, 1.0), st.floats(1.0, 500.0))
def test_commands_keep_their_limits_exactly(seed: int, size: float, rate: float):
    """Of value and rate, from the first step on, both families."""
    box = limits(pendulum(), {"voltage": (-2.0, 3.0)}, {"voltage": rate})
    for family in (d.MultisineCommands, d.FreeCommands):
        signal = family(PERIOD, STEPS)
        shape = (signal.coefficients, 1)
        C = np.random.default_rng(seed).uniform(-size, size, shape)
        with jax.enable_x64(True):
            U = np.asarray(signal.commands(jnp.asarray(C), box))[:, 0]
        assert U.shape == (STEPS,)
        assert U.max() <= 3.0
        assert U.min() >= -2.0
        assert np.abs(np.diff(U, prepend=0.0)).max() <= rate * PERIOD * (1.0 + 1e-12)


def test_a_multisine_is_scaled_not_cut() -> None:
    box = limits(pendulum(), {"voltage": (-2.0, 3.0)})
    signal = d.MultisineCommands(PERIOD, STEPS)
    C = np.random.default_rng(0).uniform(-1.0, 1.0, (signal.coefficients, 1))
    U, V = (np.asarray(signal.commands(jnp.asarray(x), box)) for x in (C, 0.7 * C))
    assert np.abs(U).max() == pytest.approx(2.0, rel=1e-9)
    np.testing.assert_allclose(U, V, atol=1e-9)  # both were too large
    assert U[0] == V[0] == 0.0


def test_excess_is_a_share_of_the_half_width() -> None:
    box = limits(pendulum())
    S = jnp.asarray([[1.4, 9.0, -14.1, 99.0], [0.0, 0.0, -18.0, 0.0]])
    assert float(excess(box, S[:1])) == pytest.approx(-0.06)
    assert float(excess(box, S)) == pytest.approx(0.2)


def test_every_turn_beyond_the_limits_counts() -> None:
    """Each at its worst; then the mean over machines."""
    e, box = experiment(), limits(pendulum())
    beyond = by_gradients._beyond_of(e, box)
    states = np.zeros((2, STEPS + 1, 4))
    states[0, 10:13, 0] = 1.8, 2.1, 1.8
    states[0, 100, 2] = -18.0
    assert float(beyond(jnp.asarray(states))) == pytest.approx(0.5 * (0.4 + 0.2))


def test_random_motions_have_sd_one() -> None:
    for family in (d.MultisineCommands, d.FreeCommands):
        signal = family(PERIOD, STEPS)
        keys = jax.random.split(jax.random.key(0), 300)
        C = np.asarray(jax.vmap(lambda k, s=signal: s.random(k, 2))(keys))
        assert C.shape[1:] == (signal.coefficients, 2)
        assert np.std(C) == pytest.approx(1.0, abs=0.05)
        assert abs(np.mean(C[..., 0] * C[..., 1])) < 0.1


def test_rates_are_followed_by_the_nearest_command() -> None:
    box = limits(pendulum(), {}, {"voltage": 100.0})
    U = clip_commands(box, jnp.full((4, 1), 2.5), PERIOD)
    np.testing.assert_allclose(U[:, 0], [1.0, 2.0, 2.5, 2.5])


def test_stated_limits_narrow_those_of_the_channels() -> None:
    """Whatever a user states, a channel's own limits hold as well."""
    system = pendulum()
    (channel,) = system.actions
    wide = limits(system, {"voltage": (2.0 * channel.low, 0.5 * channel.high)})
    assert wide.low[0] == channel.low
    assert wide.high[0] == 0.5 * channel.high
