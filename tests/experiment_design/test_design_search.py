"""The search for the next experiment."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp.experiment_design as d
from design_cases import (
    LIMITS,
    PERIOD,
    STEPS,
    commands,
    delayed,
    experiment,
    limits,
    rail_experiment,
)
from sim2gp.errors import InputError
from sim2gp.experiment_design import by_gradients, search
from sim2gp.experiment_design.limits import excess

pytestmark = pytest.mark.usefixtures("float64")

QUICK = {"BLOCKS": 3, "TRIALS": 60, "GUARDS": 12, "CHECKED": 200}


@pytest.mark.nightly
def test_worth_has_a_gradient_in_the_commands() -> None:
    """Against differences, also where some windows tell nothing of a constant."""
    e = experiment(delayed())
    z = 0.3 * jnp.ones_like(e.belief.mean)

    @jax.jit
    def worth(U):
        states = d.trajectory(e, e.belief.at(z), U)
        return by_gradients._worth_at(e, d.DOptimal(), z, U, states)[0]

    U = commands(2).at[: STEPS // 2].set(0.0)
    V = commands(3)
    slope = float(jnp.sum(jax.jit(jax.grad(worth))(U) * V))
    h = 1e-5
    difference = float(worth(U + h * V) - worth(U - h * V)) / (2.0 * h)
    assert slope == pytest.approx(difference, rel=1e-5)


@pytest.mark.nightly
def test_a_search_on_longer_periods_sees_the_same() -> None:
    """Fewer samples of as much less noise; an experiment of few periods stays whole."""
    fine = dataclasses.replace(experiment(), period=0.002, steps=500, window=50)
    coarse, signal = by_gradients._coarser(fine, d.MultisineCommands(0.002, 500))
    assert (coarse.period, coarse.steps, coarse.window) == (0.01, 100, 10)
    box, nowhere = limits(fine.system), jnp.zeros((1, 3))
    C = 0.1 * jax.random.normal(jax.random.key(1), (signal.coefficients, 1))
    answer = [
        float(by_gradients._worth(e, d.DOptimal(), nowhere, s.commands(C, box))[0])
        for e, s in ((fine, d.MultisineCommands(0.002, 500)), (coarse, signal))
    ]
    assert answer[1] == pytest.approx(answer[0], abs=0.1)
    short = dataclasses.replace(fine, steps=3, window=3)
    kept, _ = by_gradients._coarser(short, d.MultisineCommands(0.002, 3))
    assert (kept.period, kept.steps, kept.window) == (0.002, 3, 3)


@pytest.mark.nightly
def test_commands_are_made_no_smaller_than_they_must_be() -> None:
    e = experiment()
    box, draws = limits(e.system), jax.random.normal(jax.random.key(1), (100, 3))

    def check(U):
        return by_gradients._plausible_states(e, box, U, draws)

    U, states, bad = search._kept(check, commands(4, 5.0))
    share = float(jnp.max(jnp.abs(U)) / jnp.max(jnp.abs(commands(4, 5.0))))
    assert 0.0 < share < 1.0
    assert bad <= 0.01
    assert np.mean([float(excess(box, S)) > 0.0 for S in states]) == pytest.approx(bad)
    _, larger = check(U / search.SMALLER)
    assert float(jnp.mean(larger > 0.0)) > 0.01


class Away:
    """A climb that always ends far outside."""

    def compile_for(self, *args) -> None:
        pass

    def __call__(self, *args):
        C, state = args[7:9]
        return 0.0 * C + 1.0, state


@pytest.mark.nightly
def test_a_climb_that_ends_far_outside_is_given_up(monkeypatch) -> None:
    e = experiment()
    box, signal = limits(e.system), d.MultisineCommands(PERIOD, STEPS)
    draws = jax.random.normal(jax.random.key(1), (50, 3))
    monkeypatch.setattr(by_gradients, "_climb", Away())
    improve = by_gradients._climber(e, signal, d.DOptimal(), box, draws[:2], draws)
    start = improve(jax.random.key(3))
    assert float(jnp.max(jnp.abs(start))) < 1.0
    # It begins nearly within its limits.
    U = signal.commands(start.astype(float), box)
    _, beyond = by_gradients._plausible_states(
        e, by_gradients.narrow_limits(box), U, draws
    )
    assert float(jnp.mean(beyond > 0.0)) <= by_gradients.LEAVING + 0.05


@pytest.fixture(scope="module")
def found():
    """A short search."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        for name, value in QUICK.items():
            patch.setattr(by_gradients, name, value)
        e = experiment()
        box = limits(e.system, LIMITS, {"voltage": 100.0})
        signal = d.MultisineCommands(PERIOD, STEPS)
        key, goal = jax.random.key(0), d.DOptimal()
        best = d.optimise_commands(e, goal, box, signal, key=key)
        assert (
            d.optimise_commands(e, goal, box, signal, key=key, starts=3).nats
            > best.nats
        )
        return e, box, signal, best


@pytest.mark.nightly
def test_a_designed_experiment_beats_random_ones(found) -> None:
    e, box, signal, best = found
    assert best.violations <= 0.01
    assert float(excess(box, jnp.asarray(best.states))) <= 0.0
    draws = jax.random.normal(jax.random.key(5), (12, signal.coefficients, 1))
    nowhere = jnp.zeros(3)

    @jax.jit
    def random(c):
        U = signal.commands(0.05 * c, box)
        states = d.trajectory(e, e.belief.mean, U)
        scale = d.posterior_scale(e.belief, d.information(e, nowhere, U, states))
        return d.DOptimal().nats(e.belief.scale, scale), excess(box, states)

    answer = [random(c) for c in draws]
    nats = [float(n) for n, beyond in answer if float(beyond) <= 0.0]
    assert nats
    assert best.nats > max(nats) + 0.3
    # The scale that is returned is that of its own commands.
    U = jnp.asarray(best.commands)
    states = eqx.filter_jit(d.trajectory)(e, e.belief.mean, U)
    A = np.asarray(eqx.filter_jit(d.information)(e, nowhere, U, states))
    np.testing.assert_allclose(best.states, states, atol=1e-9)
    np.testing.assert_allclose(
        best.scale, d.posterior_scale(e.belief, jnp.asarray(A)), rtol=1e-9
    )


@pytest.mark.nightly
def test_a_refused_start_does_not_end_the_search(found, monkeypatch) -> None:
    """The second of two is returned; the first one's refusal is not."""
    e, box, signal, _ = found
    for name, value in QUICK.items():
        monkeypatch.setattr(by_gradients, name, value)
    kept, calls = search._kept, []

    def refused_once(*args: object) -> object:
        calls.append(args)
        if len(calls) == 1:
            raise InputError("E150", "no commands keep the limits")
        return kept(*args)

    monkeypatch.setattr(search, "_kept", refused_once)
    key = jax.random.key(0)
    second = d.optimise_commands(e, d.DOptimal(), box, signal, key=key, starts=2)
    assert len(calls) == 2
    assert second.violations <= search.ALLOWED


@pytest.mark.nightly
def test_no_commands_keep_limits_that_nothing_can(found) -> None:
    """A pole that starts beside its limit swings beyond it whatever is done."""
    e, _, signal, _ = found
    box = limits(e.system, {"alpha": (-0.2, 0.401)})
    with pytest.MonkeyPatch.context() as patch:
        for name, value in QUICK.items():
            patch.setattr(by_gradients, name, value)
        with pytest.raises(InputError, match="E150 no commands keep the limits"):
            d.optimise_commands(e, d.DOptimal(), box, signal, key=jax.random.key(0))


@pytest.fixture(scope="module")
def on_a_rail():
    """A short search of a small machine: by day the only one from end to end."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        for name, value in {**QUICK, "BLOCK": 5}.items():
            patch.setattr(by_gradients, name, value)
        e, signal = rail_experiment(), d.MultisineCommands(0.1, 20)
        box = limits(e.system, {"x": (-0.5, 0.5)}, start=(0.0, 0.0))
        key = jax.random.key(0)
        best = d.optimise_commands(e, d.DOptimal(), box, signal, key=key, draws=1)
        return e, box, signal, best


def test_a_search_ends_within_limits_and_says_what_its_commands_are_worth(
    on_a_rail,
) -> None:
    e, box, signal, best = on_a_rail
    assert best.violations <= search.ALLOWED
    assert np.abs(best.states[:, 0]).max() <= 0.5
    U = jnp.asarray(best.commands)
    assert float(jnp.max(jnp.abs(U))) <= 1.0

    draws = jax.random.normal(jax.random.key(5), (20, signal.coefficients, 1))
    smaller, here = 0.1 * jnp.max(jnp.abs(U)), jnp.zeros((1, 2))
    nats = [
        float(by_gradients._worth(e, d.DOptimal(), here, V)[0])
        for V in (U, *(smaller * signal.commands(c, box) for c in draws))
    ]
    assert best.nats == pytest.approx(nats[0], rel=1e-9)
    assert best.nats > max(nats[1:])
    ahead = d.prediction_rows(e, box, 0.5, jax.random.key(1))
    assert ahead.shape == (4, 2)
    assert float(jnp.min(jnp.linalg.norm(ahead, axis=0))) > 0.0


def test_limits_hold_for_the_corrected_posterior_and_nats_are_of_the_plain(
    on_a_rail,
) -> None:
    """Machines, their extent and the middle against single simulations."""
    wide, box, _, best = on_a_rail
    e, goal = dataclasses.replace(wide, corrected=wide.belief), d.DOptimal()
    shifted, U = wide.corrected, 2.0 * jnp.asarray(best.commands)
    draws = jax.random.normal(jax.random.key(2), (QUICK["CHECKED"], 2))
    states, beyond = by_gradients._plausible_states(wide, box, U, draws)
    one = eqx.filter_jit(d.trajectory)
    for z, S, far in zip(draws[:5], states[:5], beyond[:5], strict=True):
        tt = shifted.mean + shifted.scale @ z
        alone = one(e, tt, U)
        np.testing.assert_allclose(S, alone, rtol=1e-6, atol=1e-8)
        assert float(far) == pytest.approx(float(excess(box, alone)), rel=1e-6)
    here = jnp.zeros((1, 2))
    nats, scale, middle = by_gradients._worth(wide, goal, here, U)
    expected = by_gradients._worth(e, goal, here, U)
    assert float(nats) == pytest.approx(float(expected[0]), rel=1e-12)
    np.testing.assert_allclose(scale, expected[1], rtol=1e-12)
    np.testing.assert_allclose(middle, one(e, shifted.mean, U), rtol=1e-6, atol=1e-8)
