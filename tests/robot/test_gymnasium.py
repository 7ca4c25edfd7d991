"""Gymnasium environments: the task to the last bit, one program, Gymnasium's checks."""

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from jaxtyping import Array, Bool

from sim2gp.errors import InputError
from sim2gp.planning import AbstractPlanner, World
from sim2gp.planning.episode import Purpose, key_for, oracle_world, run_episode
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.tasks import MACHINES, Task, draw_truth, furuta_swingup
from sim2gp.robot.gymnasium import NAMES, register, step_task
from sim2gp.systems import Delay, Furuta
from sim2gp.types import Key, State

SEED = 7
WRONG = {"effects": ["coulomb mild", Delay("voltage", 0.01)]}


class Played(AbstractPlanner):
    """Plays a recording, whatever it sees."""

    shares: Array

    def init(self, world: World, *, key: Key) -> Array:
        return jnp.zeros((), int)

    def prepare(self, state: Any, world: World, data: Any, *, key: Key) -> Any:
        return state

    def act(self, state: Any, world: World, s: State, *, key: Key) -> Any:
        return from_unit(self.shares[state][None], world.actions)[0], state + 1

    def failed(self, state: Any) -> Bool[Array, ""]:
        return jnp.asarray(False)


def rollout(env: Any, shares: np.ndarray) -> tuple[np.ndarray, list[Any]]:
    """Observations of one episode, its start first, and what each step returned."""
    seen, steps = [env.reset()[0]], []
    for u in shares:
        steps.append(env.step(u))
        seen.append(steps[-1][0])
    return np.stack(seen), steps


@pytest.fixture(scope="module")
def env() -> Iterator[Any]:
    with gymnasium.make("sim2gp/Furuta-v0", truth="prior", **WRONG) as made:
        yield made


@pytest.fixture(scope="module")
def shares() -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform(-0.4, 0.4, (Task.horizon, 1)).astype(np.float32)


@pytest.mark.parametrize("name", NAMES)
def test_gymnasium_finds_no_fault(name: str) -> None:
    """Its warnings are errors here; `make` by the module's name registers it too."""
    check_env(gymnasium.make(f"sim2gp.robot.gymnasium:sim2gp/{name}-v0").unwrapped)
    register()
    spec = gymnasium.spec(f"sim2gp/{name}-v0")
    assert spec.max_episode_steps == MACHINES[NAMES[name]][1]().horizon


def test_an_episode_is_the_flights_to_the_last_bit(
    env: Any, shares: np.ndarray
) -> None:
    """The second of a seed: constants, start, noise, delay, effect, reward, clock."""
    key = jax.random.key(SEED)
    env.reset(seed=SEED)
    found, steps = rollout(env, shares)
    truth = draw_truth(Furuta(), key_for(key, 0, Purpose.TRUTH))
    task = furuta_swingup(truth, env.unwrapped.made.effects)
    assert eqx.tree_equal(task, env.unwrapped.task)
    world = oracle_world(task)
    planner = Played(jnp.asarray(shares))
    state = planner.init(world, key=key)
    flying = key_for(key, 2, Purpose.EPISODE)
    expected, _ = jax.jit(run_episode)(task, planner, state, world, key=flying)
    np.testing.assert_array_equal(found, expected.state)
    rewards = np.asarray([reward for _, reward, *_ in steps], np.float32)
    np.testing.assert_array_equal(rewards, expected.reward)
    inputs = np.stack([info["input"] for *_, info in steps])
    np.testing.assert_array_equal(inputs, expected.action)
    assert not any(ended for *_, ended, _, _ in steps)
    over = [over for *_, over, _ in steps]
    assert over == [False] * (Task.horizon - 1) + [True]
    status = [info["status"] for *_, info in steps]
    assert status == ["running"] * (Task.horizon - 1) + ["horizon"]


def test_the_terms_make_the_reward(env: Any, shares: np.ndarray) -> None:
    _, reward, _, _, info = rollout(env, shares[:3])[1][-1]
    assert reward == pytest.approx(np.exp(sum(info["reward_terms"].values())), rel=1e-6)
    cart = gymnasium.make("sim2gp/CartPole-v0")
    _, reward, _, _, info = rollout(cart, shares[:3])[1][-1]
    assert reward == pytest.approx(sum(info["reward_terms"].values()), rel=1e-6)


def test_a_seed_says_everything(env: Any, shares: np.ndarray) -> None:
    """Same bits for the same seed; episodes of one seed share their machine."""
    env.reset(seed=SEED)
    first, machine = rollout(env, shares[:5])[0], env.unwrapped.task
    again = gymnasium.make("sim2gp/Furuta-v0", truth="prior", **WRONG)
    again.reset(seed=SEED)
    np.testing.assert_array_equal(rollout(again, shares[:5])[0], first)
    assert not np.array_equal(rollout(env, shares[:5])[0], first)
    assert env.unwrapped.task is machine
    env.reset(seed=SEED + 1)
    assert not eqx.tree_equal(env.unwrapped.task, machine)
    one, two = (gymnasium.make("sim2gp/Furuta-v0") for _ in range(2))
    assert not np.array_equal(one.reset()[0], two.reset()[0])


def alone(i: int, **options: Any) -> Any:
    made = gymnasium.make("sim2gp/Furuta-v0", max_episode_steps=4, **options)
    return made, [made.reset(seed=SEED + i)[0]]


def test_a_vector_is_its_environments(shares: np.ndarray) -> None:
    """Each has the next seed and its own machine; the fifth step begins anew."""
    options = {"truth": "prior", **WRONG}
    name, mode = "sim2gp/Furuta-v0", gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    both = gymnasium.make_vec(name, 2, mode, max_episode_steps=4, **options)
    singles = [alone(i, **options) for i in range(2)]
    seen, info = both.reset(seed=SEED)
    assert list(info["status"]) == ["running"] * 2
    for t in range(7):
        for i, (_, known) in enumerate(singles):
            np.testing.assert_allclose(seen[i], known[-1], rtol=2e-5, atol=1e-6)
        actions = np.stack([shares[t], shares[t + 1]])
        seen, reward, ended, late, info = both.step(actions)
        assert seen in both.observation_space
        assert not ended.any()
        assert late.tolist() == [t == 3] * 2
        for i, (single, known) in enumerate(singles):
            if t == 4:
                known.append(single.reset()[0])
                assert reward[i] == 0.0
                continue
            step = single.step(actions[i])
            known.append(step[0])
            assert reward[i] == pytest.approx(step[1], rel=1e-5)
            np.testing.assert_allclose(info["input"][i], step[4]["input"], rtol=1e-6)
            for name, term in step[4]["reward_terms"].items():
                found = info["reward_terms"][name][i]
                assert found == pytest.approx(term, rel=1e-4, abs=1e-7)


def test_one_vectors_end_is_not_the_others(shares: np.ndarray) -> None:
    """Who goes in circles leaves the task's states; who rests does not."""
    both = gymnasium.make_vec("sim2gp/Furuta-v0", num_envs=2, **WRONG)
    both.reset(seed=[3, 4])
    actions = np.asarray([[1.0], [0.0]], np.float32)
    ended, t = np.zeros(2, bool), 0
    while not ended[0] and t < Task.horizon:
        (seen, _, ended, late, info), t = both.step(actions), t + 1
    assert (ended.tolist(), late.tolist()) == ([True, False], [False, False])
    assert list(info["status"]) == ["limits", "running"]
    before = seen
    seen, reward, ended, _, info = both.step(actions)
    assert np.abs(seen[0]).max() < 0.2
    np.testing.assert_allclose(seen[1], before[1], atol=0.2)
    assert (reward[0], ended.tolist()) == (0.0, [False, False])
    assert info["_input"].tolist() == [False, True]
    now = both.unwrapped.fleet.now
    assert (now.episode.tolist(), now.step.tolist()) == ([2, 1], [0, t + 1])
    seen, _ = both.reset()
    assert both.unwrapped.fleet.now.episode.tolist() == [3, 2]
    assert seen in both.observation_space
    with pytest.raises(InputError, match="E140"):
        both.reset(seed=[1, 2, 3])
    with pytest.raises(InputError, match="E140"):
        both.step(actions[0])


def test_one_program_steps_every_machine_of_a_kind(
    env: Any, shares: np.ndarray
) -> None:
    """Other constants, seeds and times are other data."""
    env.reset(seed=1)
    env.step(shares[0])
    before = step_task._cached._cache_size()
    other = gymnasium.make(
        "sim2gp/Furuta-v0", params={"arm_mass": 0.1}, truth="2sd", **WRONG
    )
    for each in (env, other):
        each.reset(seed=2)
        rollout(each, shares[:3])
    assert before > 0
    assert step_task._cached._cache_size() == before


def test_constants_can_be_set() -> None:
    made = gymnasium.make("sim2gp/Furuta-v0", params={"arm_mass": 0.123}).unwrapped
    expected = Furuta().parameters.nominal() | {"arm_mass": 0.123}
    assert made.task.truth == {k: np.float32(v) for k, v in expected.items()}


def test_an_episode_ends_where_the_tasks_states_end() -> None:
    """A full voltage turns the arm by more than the six radians of the task."""
    env = gymnasium.make("sim2gp/Furuta-v0")
    env.reset(seed=0)
    seen, _, ended, over, info = env.step(np.ones(1, np.float32))
    while not (ended or over):
        assert (np.abs(seen) < furuta_swingup().state_bound).all()
        seen, _, ended, over, info = env.step(np.ones(1, np.float32))
    assert ended
    assert not over
    assert info["status"] == "limits"
    bound = furuta_swingup().state_bound
    assert np.argmax(np.abs(seen) / bound) == 0
    assert seen[0] == bound[0]
    assert abs(env.unwrapped.state[0]) > bound[0]
    assert seen in env.observation_space


def test_wrong_calls_are_refused() -> None:
    env = gymnasium.make("sim2gp/Furuta-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(1, np.float32))
    with pytest.raises(InputError, match="E149"):
        env.reset(seed=2**32)
    with pytest.raises(InputError, match="E145"):
        env.reset(seed=0, options={"start": 0})
    env.reset(seed=0)
    with pytest.raises(InputError, match="E140"):
        env.step(np.zeros(2, np.float32))
    with pytest.raises(InputError, match="E101"):
        env.step(np.full(1, np.nan, np.float32))
