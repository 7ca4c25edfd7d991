"""Loops: one trace, one draw per episode, keys by purpose, faults that speak."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array

from sim2gp import loops, tasks
from sim2gp.errors import NotFinite, Sim2GPError, Sim2GPWarning
from sim2gp.gaussian import Gaussian
from sim2gp.loops import Trajectory, episode, fly, key_for, oracle_world, world_of
from sim2gp.models.base import AbstractBelief, AbstractModel
from sim2gp.planning import ICEM, MPC, AbstractPlanner, MarkovObjective, World
from sim2gp.systems import Furuta, InputDelay
from sim2gp.tasks import Task
from sim2gp.transitions import Transitions
from sim2gp.types import Box, Dynamics, Key, State

KEY = jax.random.key(0)
DT = 0.1
traces: list[str] = []


class Mass(eqx.Module):
    """A double integrator of unknown gain; counts how often it is traced."""

    gain: Array

    def __call__(self, s: State, a: Array) -> State:
        traces.append("Mass")
        return jnp.stack([s[0] + DT * s[1], s[1] + DT * self.gain * a[0]])


class Reach(eqx.Module):
    def __call__(self, s: State, a: Array, s2: State) -> Array:
        return -((s2[0] - 1.0) ** 2) - 0.1 * s2[1] ** 2 - 1e-3 * a[0] ** 2


def single(*values: float) -> Array:
    return jnp.asarray(values, jnp.float32)


def mass_task(gain: float = 2.0, dynamics: Dynamics | None = None) -> Task:
    return Task(
        dynamics=Mass(jnp.asarray(gain, jnp.float32)) if dynamics is None else dynamics,
        reward=Reach(),
        noise=single(1e-3, 1e-2),
        start=single(0.0, 0.0),
        start_sd=single(0.01, 0.01),
        state_bound=single(10.0, 10.0),
        actions=Box(single(-1.0), single(1.0)),
        truth={"gain": jnp.asarray(gain, jnp.float32)},
        name="mass",
        horizon=20,
        dt=DT,
        planning_horizon=8,
        planning_iterations=2,
    )


SMALL = MPC(ICEM(samples=32, elites=6))


class GainBelief(AbstractBelief):
    """``gain ~ N(mean, sd^2)``: conjugate, so the whole loop has a closed form."""

    mean: Array
    sd: Array

    def latent(self, s: State, a: Array) -> Gaussian:
        raise NotImplementedError

    def predict(self, s: State, a: Array) -> Gaussian:
        raise NotImplementedError

    def sample(self, key: Key) -> Mass:
        draws.append("draw")
        gain = self.mean + self.sd * jax.random.normal(key)
        return Mass(gain.astype(jnp.float32))

    def point(self) -> Mass:
        return Mass(self.mean)

    def information_gain(self, s: State, a: Array) -> Array:
        raise NotImplementedError

    def trajectory_information_gain(self, S: Array, A: Array) -> Array:
        raise NotImplementedError

    def parameters(self) -> tuple[Array, Array]:
        return self.mean[None], self.sd[None]


draws: list[str] = []


class GainModel(AbstractModel):
    def init(self, key: Key) -> GainBelief:
        return GainBelief(single(1.0)[0], single(1.0)[0])

    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> AbstractBelief:
        fits.append((data.count, len(data.mask)))
        x = DT * np.asarray(data.action)[:, 0] * np.asarray(data.mask)
        y = (np.asarray(data.next_state) - np.asarray(data.state))[:, 1]
        precision = 1.0 + x @ x / 1e-4
        mean = (1.0 + x @ y / 1e-4) / precision
        return GainBelief(*single(mean, 1.0 / np.sqrt(precision)))

    def update(
        self, belief: AbstractBelief, s: State, a: Array, s2: State
    ) -> AbstractBelief:
        raise NotImplementedError


fits: list[tuple[int, int]] = []


@pytest.fixture(autouse=True)
def fresh_counters() -> None:
    traces.clear()
    draws.clear()
    fits.clear()


def start(task: Task, planner: AbstractPlanner, world: World) -> Any:
    return planner.init(world, key=KEY)


def fly_mass(gain: float = 2.0, key: Key = KEY) -> Trajectory:
    task = mass_task(gain)
    world = oracle_world(task)
    return episode(task, SMALL, start(task, SMALL, world), world, key=key)[0]


def same(one: Any, two: Any) -> bool:
    return bool(eqx.tree_equal(one, two))


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
    batch, _ = jax.vmap(lambda key: fly(task, SMALL, state, world, key=key))(keys)
    for i, key in enumerate(keys):
        one = episode(task, SMALL, state, world, key=key)[0]
        np.testing.assert_allclose(batch.state[i], one.state, atol=1e-4)
        np.testing.assert_allclose(batch.reward[i], one.reward, atol=1e-4)


def test_rows_chain_and_rewards_are_the_tasks() -> None:
    task, flown = mass_task(), fly_mass()
    s, a, s2 = flown.transitions()
    np.testing.assert_array_equal(s[1:], s2[:-1])
    rewards = jax.vmap(task.reward)(jnp.asarray(s), jnp.asarray(a), jnp.asarray(s2))
    np.testing.assert_allclose(rewards, flown.reward, rtol=1e-5, atol=1e-6)
    residual = s2 - np.asarray(jax.vmap(task.dynamics)(jnp.asarray(s), jnp.asarray(a)))
    assert np.all(np.abs(residual) < 5 * np.asarray(task.noise))
    assert np.all(residual.std(axis=0) > 0.4 * np.asarray(task.noise))


def test_transitions_with_history_are_newest_first() -> None:
    S, A = np.arange(10.0).reshape(5, 2), np.arange(1.0, 9.0).reshape(4, 2)
    flown = Trajectory(S, A, np.zeros(4), np.zeros(4, bool))
    s, a, s2 = flown.transitions(history=2)
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
    task = tasks.furuta_swingup(effects=[InputDelay("voltage", 0.03)])
    task = eqx.tree_at(lambda t: t.noise, task, jnp.zeros(4))
    assert task.history == 2
    world, planner = oracle_world(task), Scripted(single(9.0))
    state = start(task, planner, world)
    flown, _ = episode(task, planner, state, world, key=KEY)
    assert not np.any(flown.failed)  # the seen state predicts the next seen state
    assert np.max(np.abs(flown.action)) == 5.0  # what was done, not what was asked
    assert flown.state.shape == (251, 4)
    # A world without the delay sees the same machine, and mispredicts it.
    bare = tasks.furuta_swingup()
    blind = world_of(task, bare.dynamics, MarkovObjective(task.reward))
    with pytest.warns(Sim2GPWarning, match="W203"):
        other, _ = episode(task, planner, start(task, planner, blind), blind, key=KEY)
    np.testing.assert_allclose(other.state, flown.state, atol=1e-4)


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
        flown, _ = episode(task, SMALL, start(task, SMALL, world), world, key=KEY)
    assert np.all(flown.failed)
    assert np.isfinite(np.asarray(flown.state)).all()


# ------------------------------------------------------------------- the loop
def run(episodes: int = 3, key: Key = KEY, **more: Any) -> loops.History:
    return loops.psrl(
        mass_task(), GainModel(), SMALL, episodes=episodes, key=key, **more
    )


def test_posterior_sampling_learns_the_gain_and_reaches_the_oracle() -> None:
    history = run()
    assert draws == ["draw"] * 3  # one draw holds for a whole episode
    assert fits == [(20, 60), (40, 60), (60, 60)]  # all of the data, one capacity
    assert history.state.shape == (3, 21, 2)
    assert history.returns.shape == (3,)
    np.testing.assert_array_equal(history.parameter_mean[0], [1.0])
    assert np.all(np.diff(history.parameter_sd[:, 0]) < 0.0)
    z = (history.parameter_mean[-1] - 2.0) / history.parameter_sd[-1]
    assert np.abs(z).max() < 4.0
    oracle = float(fly_mass().total)
    assert history.returns[-1] > oracle - 0.5
    assert history.data.count == 60


def test_the_closed_form_posterior_is_what_the_loop_reports() -> None:
    history = run()
    x = DT * history.action[..., 0].ravel().astype(float)
    y = np.diff(history.state[..., 1], axis=1).ravel().astype(float)
    precision = 1.0 + x @ x / 1e-4
    mean = (1.0 + x @ y / 1e-4) / precision
    assert history.parameter_mean[-1, 0] == pytest.approx(mean, rel=1e-5)
    assert history.parameter_sd[-1, 0] == pytest.approx(precision**-0.5, rel=1e-5)


def test_what_is_added_to_a_run_changes_nothing() -> None:
    plain = run()
    assert same(plain, run())
    seen: list[int] = []

    def evaluate(report: loops.Episode) -> None:
        seen.append(report.index)
        task = mass_task()
        loops.fly_oracle(task, SMALL, key=KEY, episodes=1)
        assert report.belief.parameters()[0].shape == (1,)

    assert same(plain, run(on_episode=evaluate))
    assert seen == [1, 2, 3]
    longer = run(episodes=4)
    np.testing.assert_array_equal(longer.state[:3], plain.state)
    assert not same(plain, run(key=jax.random.key(1)))


def test_the_whole_run_is_one_trace() -> None:
    run(episodes=2)
    count = len(traces)
    run(episodes=5, key=jax.random.key(7))
    assert len(traces) == count


def test_keys_differ_by_episode_and_purpose() -> None:
    keys = {
        tuple(jax.random.key_data(key_for(KEY, e, purpose)).tolist())
        for e in range(20)
        for purpose in loops.Purpose
    }
    assert len(keys) == 20 * len(loops.Purpose)


# ------------------------------------------------------------------- oracles
@pytest.mark.parametrize(
    ("preset", "least"),
    [(tasks.furuta_swingup, 140.0 / 200.0), (tasks.cartpole_swingup, 190.0 / 250.0)],
)
def test_the_oracle_swings_up_the_published_machine(
    preset: Callable[[], Task], least: float
) -> None:
    oracle = loops.fly_oracle(preset(), MPC(), key=KEY)
    assert len(oracle.returns) == 5
    assert oracle.swings_up
    assert oracle.oracle_return == np.median(oracle.returns)
    assert oracle.oracle_return >= least * 250


def test_truths_are_redrawn_until_the_oracle_swings_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Task] = []

    def judge(task: Task, planner: AbstractPlanner, *, key: Key) -> loops.OracleRun:
        asked.append(task)
        return loops.OracleRun(np.asarray([1.0, 3.0, 2.0]), len(asked) == 3)

    monkeypatch.setattr(loops, "fly_oracle", judge)
    arguments = (tasks.furuta_swingup, Furuta(), MPC())
    accepted = loops.accept_truth(*arguments, key=KEY)
    assert accepted.redrawn == 2
    assert accepted.oracle.oracle_return == 2.0
    assert accepted.task is asked[2]
    masses = {float(task.truth["arm_mass"]) for task in asked}
    assert len(masses) == 3
    asked.clear()
    with pytest.raises(Sim2GPError, match="E204 no truth that MPC can swing up"):
        loops.accept_truth(*arguments, key=KEY, attempts=2)
