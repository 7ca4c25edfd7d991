"""Flights: one trace, keys by purpose, parts that change nothing, faults that speak."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from mass_task import (
    KEY,
    SMALL,
    Mass,
    Reach,
    fly_mass,
    fresh_counters,  # noqa: F401  (a fixture for every test here)
    mass_task,
    same,
    single,
    start,
    traces,
)
from sim2gp.errors import NotFinite, Sim2GPWarning
from sim2gp.planning import AbstractPlanner, MarkovObjective, World, tasks
from sim2gp.planning.episode import (
    Trajectory,
    episode,
    oracle_world,
    run_episode,
    world_of,
)
from sim2gp.systems import Delay
from sim2gp.types import Key, State


# ------------------------------------------------------------------- one episode
def test_an_episode_is_a_function_of_its_key() -> None:
    first = fly_mass()
    assert same(first, fly_mass())
    assert not same(first, fly_mass(key=jax.random.key(1)))
    assert first.state.shape == (21, 2)
    assert first.action.shape == (20, 1)
    assert float(first.total) == pytest.approx(float(np.sum(first.reward)))
    assert abs(float(first.state[-1, 0]) - 1.0) < 0.1  # it got there


def test_many_draws_truths_and_keys_share_one_trace() -> None:
    fly_mass(gain=2.0)
    count = len(traces)
    for i in range(1, 6):
        task = mass_task(2.0 + i)
        world = world_of(
            task, Mass(jnp.asarray(1.0 * i, jnp.float32)), MarkovObjective(Reach())
        )
        key = jax.random.key(i)
        episode(task, SMALL, start(task, SMALL, world), world, key=key)
    assert len(traces) == count


def test_vmapped_seeds_are_looped_seeds() -> None:
    task = mass_task()
    world = oracle_world(task)
    state = start(task, SMALL, world)
    keys = jax.random.split(KEY, 4)
    batch, _ = jax.vmap(lambda key: run_episode(task, SMALL, state, world, key=key))(
        keys
    )
    for i, key in enumerate(keys):
        one = episode(task, SMALL, state, world, key=key)[0]
        np.testing.assert_allclose(batch.state[i], one.state, atol=1e-4)
        np.testing.assert_allclose(batch.reward[i], one.reward, atol=1e-4)


def test_rows_chain_and_rewards_are_the_tasks() -> None:
    task, rollout = mass_task(), fly_mass()
    s, a, s2 = rollout.transitions()
    np.testing.assert_array_equal(s[1:], s2[:-1])
    rewards = jax.vmap(task.reward)(jnp.asarray(s), jnp.asarray(a), jnp.asarray(s2))
    np.testing.assert_allclose(rewards, rollout.reward, rtol=1e-5, atol=1e-6)
    residual = s2 - np.asarray(jax.vmap(task.dynamics)(jnp.asarray(s), jnp.asarray(a)))
    assert np.all(np.abs(residual) < 5 * np.asarray(task.noise))
    assert np.all(residual.std(axis=0) > 0.4 * np.asarray(task.noise))


def test_transitions_with_history_are_newest_first() -> None:
    S, A = np.arange(10.0).reshape(5, 2), np.arange(1.0, 9.0).reshape(4, 2)
    rollout = Trajectory(S, A, np.zeros(4), np.zeros(4, bool))
    s, a, s2 = rollout.transitions(history=2)
    np.testing.assert_array_equal(a, A)
    np.testing.assert_array_equal(s[0, 2:], [0, 0, 0, 0])
    np.testing.assert_array_equal(s[1, 2:], [1, 2, 0, 0])
    np.testing.assert_array_equal(s[3, 2:], [5, 6, 3, 4])
    np.testing.assert_array_equal(s2[3], [8, 9, 7, 8, 5, 6])


class Scripted(AbstractPlanner):
    """Plays ``action * sin(t)``; fails where the world disagrees with what it sees."""

    action: Array

    def init(self, world: World, *, key: Key) -> Any:
        n = 4 + world.history
        return jnp.zeros(n), jnp.zeros(()), jnp.asarray(False)

    def prepare(self, state: Any, world: World, data: Any, *, key: Key) -> Any:
        return self.init(world, key=key)

    def act(self, state: Any, world: World, s: State, *, key: Key) -> Any:
        predicted, t, _ = state
        wrong = (t > 0) & jnp.any(jnp.abs(predicted - s) > 1e-4)
        a = self.action * jnp.sin(t)
        return a, (world.dynamics(s, world_limit(world, a)), t + 1.0, wrong)

    def failed(self, state: Any) -> Array:
        return state[2]


def world_limit(world: World, a: Array) -> Array:
    return jnp.clip(a, world.actions.low, world.actions.high)


def test_a_planner_sees_the_past_actions_that_its_world_carries() -> None:
    task = tasks.furuta_swingup(effects=[Delay("voltage", 0.03)])
    task = eqx.tree_at(lambda t: t.noise, task, jnp.zeros(4))
    assert task.history == 2
    world, planner = oracle_world(task), Scripted(single(9.0))
    state = start(task, planner, world)
    rollout, _ = episode(task, planner, state, world, key=KEY)
    assert not np.any(rollout.failed)  # the seen state predicts the next seen state
    assert np.max(np.abs(rollout.action)) == 5.0  # what was done, not what was asked
    assert rollout.state.shape == (251, 4)
    # A world without the delay sees the same machine, and mispredicts it.
    bare = tasks.furuta_swingup()
    blind = world_of(task, bare.dynamics, MarkovObjective(task.reward))
    with pytest.warns(Sim2GPWarning, match="W203"):
        other, _ = episode(task, planner, start(task, planner, blind), blind, key=KEY)
    np.testing.assert_allclose(other.state, rollout.state, atol=1e-4)


# ------------------------------------------------------------------- faults
class Explodes(eqx.Module):
    at: Array

    def __call__(self, s: State, a: Array) -> State:
        return jnp.where(s[0] > self.at, jnp.inf, s + 1.0)


def test_a_machine_that_explodes_is_an_error() -> None:
    task = mass_task(dynamics=Explodes(jnp.asarray(5.5)))
    world = world_of(task, Mass(single(1.0)[0]), MarkovObjective(task.reward))
    with pytest.raises(NotFinite, match="E203 state 7 of an episode in mass"):
        episode(task, SMALL, start(task, SMALL, world), world, key=KEY)


def test_an_action_that_is_not_finite_is_an_error() -> None:
    task = tasks.furuta_swingup()
    world, planner = oracle_world(task), Scripted(single(jnp.nan))
    with pytest.raises(NotFinite, match="E203 action 0 of an episode"):
        episode(task, planner, start(task, planner, world), world, key=KEY)


def test_a_draw_that_predicts_nothing_is_said() -> None:
    task = mass_task()
    world = world_of(task, Mass(single(jnp.nan)[0]), MarkovObjective(task.reward))
    with pytest.warns(Sim2GPWarning, match="W203 20 of 20 plans"):
        rollout, _ = episode(task, SMALL, start(task, SMALL, world), world, key=KEY)
    assert np.all(rollout.failed)
    assert np.isfinite(np.asarray(rollout.state)).all()
