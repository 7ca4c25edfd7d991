"""The next experiment: what it would tell, its limits, and what is asked of it."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim2gp import design as d
from sim2gp.design import search
from sim2gp.design.limits import excess, kept
from sim2gp.errors import InputError
from sim2gp.gaussian import Gaussian
from sim2gp.logs import Log
from sim2gp.models.cutting import cut
from sim2gp.models.windows import WindowsBelief, information_at
from sim2gp.systems.actuator import Actuated, actuator_prior
from simulated_logs import pendulum

pytestmark = pytest.mark.usefixtures("float64")

PERIOD, STEPS, WINDOW = 0.01, 200, 20
TRAJECTORY, INFORMATION = eqx.filter_jit(d.trajectory), eqx.filter_jit(d.information)
ROWS = eqx.filter_jit(d.experiment.sensitivity_at)
LIMITS = {"theta": (-1.5, 1.5), "theta.velocity": (-15.0, 15.0)}


def experiment(system=None, *, width=0.5) -> d.Experiment:
    """Two seconds of a pendulum with three unknown constants, angles measured."""
    system = pendulum() if system is None else system
    prior = system.parameters.prior()
    return d.Experiment(
        system,
        Gaussian(prior.mean + 0.1, width * prior.scale),
        jnp.asarray([2e-3, 3e-3]),
        jnp.asarray([0.1, 0.4, 0.0, 0.0]),
        jnp.asarray([0.05, 0.05, 1.0, 1.0]),
        (0, 1),
        PERIOD,
        STEPS,
        WINDOW,
    )


def commands(seed=0, size=4.0):
    rng = np.random.default_rng(seed)
    held = np.repeat(rng.uniform(-size, size, (STEPS // 4, 1)), 4, axis=0)
    held[:4] = 0.0  # as before the log, whose first input is taken to have held
    return jnp.asarray(held)


def limits(system, stated=LIMITS, rates=None, start=(0.1, 0.4, 0.0, 0.0)):
    return d.Limits.of(system, stated, rates or {}, start=np.asarray(start))


def delayed():
    """The same pendulum behind an input with an unknown delay."""
    system = pendulum()
    free = {"voltage.delay": actuator_prior(system.actions[0], "delay")}
    return Actuated(system, free)


@pytest.mark.parametrize("system", [pendulum(), delayed()], ids=["plain", "delayed"])
def test_it_tells_what_the_log_of_it_would(system) -> None:
    """Against `models.windows`, on the log that the experiment would leave."""
    e, U = experiment(system), commands()
    nowhere = jnp.zeros_like(e.belief.mean)
    states = TRAJECTORY(e, nowhere, U)
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
    belief = WindowsBelief(
        system,
        e.belief,
        e.belief,
        e.noise,
        jnp.zeros((len(nowhere),) * 2),
        jnp.ones(len(windows)),
        jnp.asarray(y[[i for _, i in rows]]),
        jnp.zeros(()),
    )
    theirs = np.asarray(information_at(belief, windows)(e.belief.mean))
    ours = np.asarray(INFORMATION(e, nowhere, U, states))
    np.testing.assert_allclose(ours.T @ ours, theirs.T @ theirs, rtol=1e-6)
    scale = np.asarray(d.after(e.belief, jnp.asarray(ours)))
    precision = np.linalg.inv(np.asarray(e.belief.covariance()))
    S0 = np.linalg.inv(np.asarray(e.belief.scale))
    precision = precision + S0.T @ (theirs.T @ theirs) @ S0
    np.testing.assert_allclose(scale @ scale.T, np.linalg.inv(precision), rtol=1e-6)


def test_a_plan_moves_as_the_system_steps() -> None:
    """Period by period, but for the blur of the inputs' edges."""
    e, U = experiment(), commands()
    states = np.asarray(TRAJECTORY(e, jnp.zeros_like(e.belief.mean), U))
    with jax.enable_x64(True):
        params = e.record(jnp.zeros_like(e.belief.mean))
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

    assert nats(d.Everything()) == pytest.approx(volume(C0) - volume(C1), rel=1e-10)
    some = np.ix_([2, 0], [2, 0])
    expected = volume(C0[some]) - volume(C1[some])
    assert nats(d.Named((2, 0))) == pytest.approx(expected, rel=1e-10)
    G = rng.standard_normal((5, 4))
    ratio = np.trace(G @ C0 @ G.T) / np.trace(G @ C1 @ G.T)
    goal = d.Prediction(jnp.asarray(G))
    assert nats(goal) == pytest.approx(0.5 * np.log(ratio), rel=1e-10)


def test_goals_count_their_directions() -> None:
    """All sd smaller by one factor are worth its log, once for each direction."""
    scale = jnp.asarray(np.random.default_rng(0).standard_normal((4, 4)))
    goals = (d.Everything(), d.Named((2, 0)), d.Prediction(scale[:3]))
    for goal, count in zip(goals, (4, 2, 1), strict=True):
        assert goal.directions(scale) == count
        worth = float(goal.nats(scale, scale / 1.7))
        assert worth == pytest.approx(count * np.log(1.7), rel=1e-10)


def test_a_prediction_depends_on_what_moves_it() -> None:
    """Rows against differences of simulations over the horizon."""
    e, U = experiment(), commands(1)
    periods = 25
    rows = np.asarray(ROWS(e, U, periods))
    states = np.asarray(TRAJECTORY(e, jnp.zeros(3), U))
    step, at = 1e-5, 3  # the fourth prediction
    ahead = []
    for sign in (1.0, -1.0):
        moved = eqx.tree_at(lambda x: x.start, e, jnp.asarray(states[at * periods]))
        tt = e.belief.mean.at[1].add(sign * step)
        moved = eqx.tree_at(lambda x: x.belief.mean, moved, tt)
        future = U[at * periods :]
        moved = dataclasses.replace(moved, steps=len(future))
        ahead.append(np.asarray(TRAJECTORY(moved, jnp.zeros(3), future))[periods])
    slope = (ahead[0] - ahead[1])[:2] / (2.0 * step) / np.asarray(e.noise)
    np.testing.assert_allclose(rows[2 * at : 2 * at + 2, 1], slope, rtol=1e-5)


# ---------------------------------------------------------------- limits
@settings(max_examples=20)
@given(st.integers(0, 10**6), st.floats(0.05, 1.0), st.floats(1.0, 500.0))
def test_commands_keep_their_limits_exactly(seed: int, size: float, rate: float):
    """Of value and rate, from the first step on, both families."""
    box = limits(pendulum(), {"voltage": (-2.0, 3.0)}, {"voltage": rate})
    for family in (d.Multisine, d.Free):
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
    signal = d.Multisine(PERIOD, STEPS)
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
    beyond = search._beyond_of(e, box)
    states = np.zeros((2, STEPS + 1, 4))
    states[0, 10:13, 0] = 1.8, 2.1, 1.8
    states[0, 100, 2] = -18.0
    assert float(beyond(jnp.asarray(states))) == pytest.approx(0.5 * (0.4 + 0.2))


def test_random_motions_have_sd_one() -> None:
    for family in (d.Multisine, d.Free):
        signal = family(PERIOD, STEPS)
        keys = jax.random.split(jax.random.key(0), 300)
        C = np.asarray(jax.vmap(lambda k, s=signal: s.random(k, 2))(keys))
        assert C.shape[1:] == (signal.coefficients, 2)
        assert np.std(C) == pytest.approx(1.0, abs=0.05)
        assert abs(np.mean(C[..., 0] * C[..., 1])) < 0.1


def test_rates_are_followed_by_the_nearest_command() -> None:
    box = limits(pendulum(), {}, {"voltage": 100.0})
    U = kept(box, jnp.full((4, 1), 2.5), PERIOD)
    np.testing.assert_allclose(U[:, 0], [1.0, 2.0, 2.5, 2.5])


@pytest.mark.parametrize(
    ("stated", "rates", "start", "words"),
    [
        ({"voltage": (1.0, 2.0)}, {}, (0, 0, 0, 0), "E150 limits of voltage"),
        ({}, {"voltage": 0.0}, (0, 0, 0, 0), "E150 rate of voltage"),
        ({"alpha": (-1.0, 1.0)}, {}, (0, 2.0, 0, 0), "E150 limits of alpha"),
        ({"voltag": (-1.0, 1.0)}, {}, (0, 0, 0, 0), "E103 .*did you mean voltage"),
        ({}, {"theta": 1.0}, (0, 0, 0, 0), "E103 .*expected one of voltage"),
    ],
)
def test_limits_that_admit_no_motion_are_said(stated, rates, start, words) -> None:
    with pytest.raises(InputError, match=words):
        limits(pendulum(), stated, rates, np.asarray(start, float))


def test_stated_limits_narrow_those_of_the_channels() -> None:
    """Whatever a user states, a channel's own limits hold as well."""
    system = pendulum()
    (channel,) = system.actions
    wide = limits(system, {"voltage": (2.0 * channel.low, 0.5 * channel.high)})
    assert wide.low[0] == channel.low
    assert wide.high[0] == 0.5 * channel.high


# ---------------------------------------------------------------- search
QUICK = {"BLOCKS": 3, "TRIALS": 60, "GUARDS": 12, "CHECKED": 200}


def test_worth_has_a_gradient_in_the_commands() -> None:
    """Against differences, also where some windows tell nothing of a constant."""
    e = experiment(delayed())
    z = 0.3 * jnp.ones_like(e.belief.mean)

    @jax.jit
    def worth(U):
        states = d.trajectory(e, z, U)
        return search._worth_at(e, d.Everything(), z, U, states)[0]

    U = commands(2).at[: STEPS // 2].set(0.0)
    V = commands(3)
    slope = float(jnp.sum(jax.jit(jax.grad(worth))(U) * V))
    h = 1e-5
    difference = float(worth(U + h * V) - worth(U - h * V)) / (2.0 * h)
    assert slope == pytest.approx(difference, rel=1e-5)


def test_a_search_on_longer_periods_sees_the_same() -> None:
    """Fewer samples of as much less noise; an experiment of few periods stays whole."""
    fine = dataclasses.replace(experiment(), period=0.002, steps=500, window=50)
    coarse, signal = search._coarser(fine, d.Multisine(0.002, 500))
    assert (coarse.period, coarse.steps, coarse.window) == (0.01, 100, 10)
    box, nowhere = limits(fine.system), jnp.zeros((1, 3))
    C = 0.1 * jax.random.normal(jax.random.key(1), (signal.coefficients, 1))
    told = [
        float(search._worth(e, d.Everything(), nowhere, s.commands(C, box))[0])
        for e, s in ((fine, d.Multisine(0.002, 500)), (coarse, signal))
    ]
    assert told[1] == pytest.approx(told[0], abs=0.1)
    short = dataclasses.replace(fine, steps=3, window=3)
    kept, _ = search._coarser(short, d.Multisine(0.002, 3))
    assert (kept.period, kept.steps, kept.window) == (0.002, 3, 3)


def test_commands_are_made_no_smaller_than_they_must_be() -> None:
    e = experiment()
    box, draws = limits(e.system), jax.random.normal(jax.random.key(1), (100, 3))
    U, states, bad = search._kept(e, box, commands(4, 5.0), draws)
    share = float(jnp.max(jnp.abs(U)) / jnp.max(jnp.abs(commands(4, 5.0))))
    assert 0.0 < share < 1.0
    assert bad <= 0.01
    assert np.mean([float(excess(box, S)) > 0.0 for S in states]) == pytest.approx(bad)
    _, larger = search._checked(e, box, U / search.SMALLER, draws)
    assert float(jnp.mean(larger > 0.0)) > 0.01


class Away:
    """A climb that always ends far outside."""

    def compile_for(self, *args) -> None:
        pass

    def __call__(self, *args):
        C, state = args[7:9]
        return 0.0 * C + 1.0, state


def test_a_climb_that_ends_far_outside_is_given_up(monkeypatch) -> None:
    e = experiment()
    box, signal = limits(e.system), d.Multisine(PERIOD, STEPS)
    draws = jax.random.normal(jax.random.key(1), (50, 3))
    monkeypatch.setattr(search, "_climb", Away())
    improve = search._climber(e, signal, d.Everything(), box, draws[:2], draws)
    start = improve(jax.random.key(3))
    assert float(jnp.max(jnp.abs(start))) < 1.0
    # It begins nearly within its limits.
    U = signal.commands(start.astype(float), box)
    _, beyond = search._checked(e, search._narrowed(box), U, draws)
    assert float(jnp.mean(beyond > 0.0)) <= search.LEAVING + 0.05


@pytest.fixture(scope="module")
def found():
    """A short search."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        for name, value in QUICK.items():
            patch.setattr(search, name, value)
        e = experiment()
        box = limits(e.system, LIMITS, {"voltage": 100.0})
        signal = d.Multisine(PERIOD, STEPS)
        key, goal = jax.random.key(0), d.Everything()
        best = d.design(e, goal, box, signal, key=key)
        assert d.design(e, goal, box, signal, key=key, starts=3).nats > best.nats
        return e, box, signal, best


def test_a_designed_experiment_beats_random_ones(found) -> None:
    e, box, signal, best = found
    assert best.violations <= 0.01
    assert float(excess(box, jnp.asarray(best.states))) <= 0.0
    draws = jax.random.normal(jax.random.key(5), (12, signal.coefficients, 1))
    nowhere = jnp.zeros(3)

    @jax.jit
    def random(c):
        U = signal.commands(0.05 * c, box)
        states = d.trajectory(e, nowhere, U)
        scale = d.after(e.belief, d.information(e, nowhere, U, states))
        return d.Everything().nats(e.belief.scale, scale), excess(box, states)

    told = [random(c) for c in draws]
    nats = [float(n) for n, beyond in told if float(beyond) <= 0.0]
    assert nats
    assert best.nats > max(nats) + 0.3
    # The scale that is told is that of its own commands.
    U = jnp.asarray(best.commands)
    states = TRAJECTORY(e, nowhere, U)
    A = np.asarray(INFORMATION(e, nowhere, U, states))
    np.testing.assert_allclose(best.states, states, atol=1e-9)
    np.testing.assert_allclose(best.scale, d.after(e.belief, jnp.asarray(A)), rtol=1e-9)


def test_a_refused_start_does_not_end_the_search(found, monkeypatch) -> None:
    """The second of two is returned; the first one's refusal is not."""
    e, box, signal, _ = found
    for name, value in QUICK.items():
        monkeypatch.setattr(search, name, value)
    kept, calls = search._kept, []

    def refused_once(*args: object) -> object:
        calls.append(args)
        if len(calls) == 1:
            raise InputError("E150", "no commands keep the limits")
        return kept(*args)

    monkeypatch.setattr(search, "_kept", refused_once)
    key = jax.random.key(0)
    second = d.design(e, d.Everything(), box, signal, key=key, starts=2)
    assert len(calls) == 2
    assert second.violations <= search.ALLOWED


def test_no_commands_keep_limits_that_nothing_can(found) -> None:
    """A pole that starts beside its limit swings beyond it whatever is done."""
    e, _, signal, _ = found
    box = limits(e.system, {"alpha": (-0.2, 0.401)})
    with pytest.MonkeyPatch.context() as patch:
        for name, value in QUICK.items():
            patch.setattr(search, name, value)
        with pytest.raises(InputError, match="E150 no commands keep the limits"):
            d.design(e, d.Everything(), box, signal, key=jax.random.key(0))
