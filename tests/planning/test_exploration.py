"""What explorers maximise, step by step and along a plan, and the loops around it."""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from mass_task import (
    DT,
    KEY,
    NOISE,
    SMALL,
    GainBelief,
    GainModel,
    fresh_counters,
    mass_task,
    single,
)
from sim2gp.belief import AbstractBelief
from sim2gp.inference.information import joint
from sim2gp.planning import (
    AbstractObjective,
    AbstractPlanner,
    Chirp,
    MarkovObjective,
    Multisine,
    RandomInput,
    World,
)
from sim2gp.planning import loop as loops
from sim2gp.planning.episode import episode, world_of
from sim2gp.planning.exploration import InformationGain, Optimistic, Restrained
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.world import rollout
from sim2gp.types import Action, State

assert fresh_counters  # applies to this file

T, D, P, M = 6, 2, 3, 4


class Known(AbstractBelief):
    """Sensitivities that are linear in the state."""

    common: Array  # (D, P, n)
    each: Array  # (D, M, n)

    @property
    def noise(self) -> Array:
        return jnp.ones(D)

    def sensitivity(self, s: State, a: Action) -> tuple[Array, Array]:
        return self.common @ s, self.each @ s

    @property
    def coordinates(self) -> tuple[int, int, int]:
        return D, P, M

    def latent(self, s: Any, a: Any) -> Any:
        raise AssertionError("not of interest here")

    predict = sample = point = latent


def known() -> tuple[Known, Array, Array]:
    """A belief, and states and actions to be visited."""
    a, b, c = jax.random.split(jax.random.key(1), 3)
    belief = Known(jax.random.normal(a, (D, P, 3)), jax.random.normal(b, (D, M, 3)))
    return belief, jax.random.normal(c, (T, 3)), jnp.zeros((T, 1))


@eqx.filter_jit
def _information(belief: Known, S: Array) -> Array:
    return joint(*jax.vmap(lambda s: belief.sensitivity(s, s))(S))


def information_of(belief: Known, S: Array) -> float:
    """Nats that the visited states give together."""
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(x, float), (belief, S))
        return float(_information(*exact))


@pytest.mark.nightly
def test_what_is_done_counts_no_more() -> None:
    """Steps made, then steps planned: each adds to the log determinant of all."""
    belief, S, A = known()
    gain = InformationGain(belief)
    expected = np.diff([0.0, *(information_of(belief, S[: t + 1]) for t in range(T))])
    step, along = eqx.filter_jit(gain.step), eqx.filter_jit(gain.along)
    carry, steps = gain.init(), []
    for t in range(T):
        if t in (0, 3):
            ahead = along(carry, S[t:], A[t:], S[t:])
            np.testing.assert_allclose(ahead, expected[t:], rtol=1e-3)
        carry, nats = step(carry, S[t], A[t], S[t])
        steps.append(float(nats))
    np.testing.assert_allclose(steps, expected, rtol=1e-3)


def test_step_by_step_everything_is_new() -> None:
    belief, S, A = known()
    gain = InformationGain(belief, together=False)
    alone = [information_of(belief, S[t : t + 1]) for t in range(T)]
    step = eqx.filter_jit(gain.step)
    carry, first = step(gain.init(), S[0], A[0], S[0])
    _, again = step(carry, S[0], A[0], S[0])
    assert float(first) == float(again) == pytest.approx(alone[0], rel=1e-4)
    np.testing.assert_allclose(gain.along(carry, S, A, S), alone, rtol=1e-4)


def test_optimism_adds_the_epistemic_sd() -> None:
    belief, S, A = known()

    def reward(s: State, a: Action, s2: State) -> Array:
        return s2[0]

    objective = MarkovObjective(Optimistic(reward, belief, jnp.asarray(0.3)))
    sd = [
        np.sqrt(sum(float(jnp.sum(x**2)) for x in belief.sensitivity(s, s))) for s in S
    ]
    expected = np.asarray(S)[:, 0] + 0.3 * np.asarray(sd)
    np.testing.assert_allclose(objective.along((), S, A, S), expected, rtol=1e-5)
    _, one = objective.step((), S[0], A[0], S[0])
    assert float(one) == pytest.approx(expected[0], rel=1e-5)


def test_going_beyond_a_limit_costs() -> None:
    plain = MarkovObjective(lambda s, a, s2: jnp.zeros(()))
    objective = Restrained(plain, jnp.asarray([2.0, jnp.inf]), jnp.asarray(10.0))
    S2 = jnp.asarray([[1.9, 50.0], [2.0, 0.0], [3.0, 0.0], [-2.2, 0.0]])
    costs = objective.along((), S2, S2[:, :1], S2)
    np.testing.assert_allclose(costs, [0.0, 0.0, -5.0, -1.0], atol=1e-5)
    _, one = objective.step((), S2[2], S2[2, :1], S2[2])
    assert float(one) == pytest.approx(-5.0)


class Counted(AbstractObjective):
    """How many steps were made: what an episode must keep for it."""

    def init(self) -> Array:
        return jnp.zeros(())

    def step(self, carry: Array, s: Array, a: Array, s2: Array) -> tuple[Array, Array]:
        return carry + 1.0, carry

    def along(self, carry: Array, S: Array, A: Array, S2: Array) -> Array:
        return carry + jnp.arange(len(A), dtype=carry.dtype)


class Witness(AbstractPlanner):
    """Remembers what its world gave it at each step."""

    def init(self, world: World, *, key: Array) -> Array:
        return jnp.full(40, -1.0)

    def prepare(self, state: Array, world: World, data: Any, *, key: Array) -> Array:
        return state

    def act(
        self, state: Array, world: World, s: State, *, key: Array
    ) -> tuple[Action, Array]:
        seen = jnp.concatenate([state[1:], world.objective.init()[None]])
        return jnp.zeros(1), seen

    def failed(self, state: Array) -> Array:
        return jnp.zeros((), bool)


def test_an_episode_keeps_what_its_objective_has_seen() -> None:
    task, planner = mass_task(), Witness()
    world = world_of(task, task.dynamics, Counted())
    start = planner.init(world, key=KEY)
    _, seen = episode(task, planner, start, world, key=KEY)
    np.testing.assert_array_equal(seen[-20:], np.arange(20.0))
    # In a new world, whose belief has seen the first part, counting starts anew.
    _, seen = episode(
        task, planner, start, world, key=KEY, part=15, world_at=lambda motion: world
    )
    np.testing.assert_array_equal(seen[-20:], [*range(15), *range(5)])


def test_exploring_pushes_where_the_gain_is_felt() -> None:
    history = loops.psal(mass_task(), GainModel(), SMALL, episodes=2, key=KEY)
    assert np.mean(np.abs(history.action)) > 0.9
    x = DT * history.action.ravel() / NOISE[1]
    nats = 0.5 * np.log1p(np.cumsum(x**2))
    sd = history.parameter_sd[:, 0]
    assert np.log(sd[0] / sd[2]) == pytest.approx(nats[-1], rel=1e-4)


def test_exploring_stays_within_limits() -> None:
    """A belief says where it is trusted; left alone, exploring goes further."""
    task = mass_task()
    narrow = eqx.tree_at(lambda t: t.state_bound, task, single(0.6, 30.0))
    free, held = (
        loops.psal(t, GainModel(), SMALL, episodes=2, key=KEY) for t in (task, narrow)
    )
    # The first episode is run on a draw from the prior, which knows no gain.
    assert np.abs(free.state[1, :, 0]).max() > 0.5
    assert np.abs(held.state[1, :, 0]).max() < 0.3


def test_optimism_flies_the_mean_world() -> None:
    task, model = mass_task(), GainModel()
    plain = loops.posterior_sampling(
        task,
        model,
        SMALL,
        objective=lambda belief: MarkovObjective(task.reward),
        episodes=2,
        key=KEY,
        world=loops.expected,
    )
    none = loops.optimism(task, model, SMALL, episodes=2, key=KEY, weight=0.0)
    np.testing.assert_allclose(none.action, plain.action, atol=1e-6)
    curious = loops.optimism(task, model, SMALL, episodes=1, key=KEY, weight=10.0)
    assert np.mean(np.abs(curious.action)) > 0.9


# ---------------------------------------------------------------- signals
def gainful(task: Any) -> World:
    belief = GainBelief(single(2.0)[0], single(1.0)[0])
    return world_of(task, belief.point(), InformationGain(belief))


SIGNALS = [RandomInput(), Chirp(), Multisine()]


@pytest.mark.parametrize("signal", SIGNALS, ids=lambda s: type(s).__name__)
def test_a_signal_is_played_to_its_end_within_the_box(signal: AbstractPlanner) -> None:
    task = mass_task()
    world = gainful(task)
    tape = signal.prepare(signal.init(world, key=KEY), world, None, key=KEY)
    assert tape.signal.shape == (20, 1)
    assert np.abs(tape.signal).max() <= 1.0
    assert np.abs(tape.signal).max() > 0.3
    motion, after = episode(task, signal, tape, world, key=KEY)
    np.testing.assert_allclose(
        motion.action, from_unit(tape.signal, task.actions), atol=1e-6
    )
    assert not motion.failed.any()
    assert int(after.position) == 20
    other = signal.prepare(tape, world, None, key=jax.random.key(9))
    assert np.abs(other.signal - tape.signal).max() > 0.1


def test_a_chirp_rises() -> None:
    world = dataclasses.replace(gainful(mass_task()), horizon=2000)
    tape = Chirp().prepare(Chirp().init(world, key=KEY), world, None, key=KEY)
    up = np.flatnonzero(np.diff(np.sign(np.asarray(tape.signal)[:, 0])) > 0)
    periods = np.diff(up)
    assert periods[0] == pytest.approx(1.0 / 2e-3, rel=0.6)
    assert periods[-1] == pytest.approx(1.0 / 0.1, rel=0.15)
    assert np.all(np.diff(periods) <= 1)


def test_a_multisine_is_chosen_by_what_it_earns() -> None:
    world = gainful(mass_task())
    earned = []
    for signal in (Multisine(), RandomInput()):
        tape = signal.prepare(signal.init(world, key=KEY), world, None, key=KEY)
        start = world.reset(KEY)
        rewards, _ = rollout(world, start, from_unit(tape.signal, world.actions))
        earned.append(float(jnp.sum(rewards)))
    assert earned[0] > earned[1] + 0.3
    # Nothing it tried was valid: it says so.
    lost = eqx.tree_at(
        lambda w: w.dynamics, world, world.dynamics.__class__(single(np.nan)[0])
    )
    signal = Multisine()
    tape = signal.prepare(signal.init(lost, key=KEY), lost, None, key=KEY)
    assert signal.failed(tape)
    assert np.isfinite(np.asarray(tape.signal)).all()
