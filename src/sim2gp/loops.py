"""The loop: believe, draw one world, act in it for an episode, learn, repeat.

Posterior sampling (Thompson 1933; Osband et al. 2013, arXiv 1306.0940): each episode
is planned in ONE draw from the belief, held fixed until the episode ends. With the
task's reward it is posterior-sampling reinforcement learning, with information gain
it is active learning. Every key is ``fold_in(fold_in(key, episode), purpose)``: what
is added to a run changes nothing that was in it.
"""

import enum
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.errors import NotFinite, Sim2GPError, warn
from sim2gp.models.base import AbstractBelief, AbstractModel
from sim2gp.planning import AbstractObjective, AbstractPlanner, MarkovObjective, World
from sim2gp.systems import AbstractSystem
from sim2gp.tasks import Task, draw_truth
from sim2gp.transitions import Transitions
from sim2gp.types import Dynamics, Key, Scalar


class Purpose(enum.IntEnum):
    """What a key is for. Numbers are never reused or changed: runs depend on them."""

    INIT = 0
    DRAW = 1
    PREPARE = 2
    EPISODE = 3
    FIT = 4
    ORACLE = 5
    TRUTH = 6
    RESET = 7
    NOISE = 8
    PLAN = 9


def key_for(key: Key, episode: int, purpose: Purpose) -> Key:
    """The key of one purpose in one episode of one run."""
    return jax.random.fold_in(jax.random.fold_in(key, episode), purpose)


class Trajectory(eqx.Module):
    """One episode on the real machine: T + 1 states seen, T actions and rewards.

    ``failed`` marks steps whose action rests on no valid prediction.
    """

    state: Float[Array | np.ndarray, "times n"]
    action: Float[Array | np.ndarray, "T m"]
    reward: Float[Array | np.ndarray, " T"]
    failed: Bool[Array | np.ndarray, " T"]

    @property
    def total(self) -> Scalar:
        """The return of the episode."""
        return jnp.sum(self.reward)

    def transitions(
        self, history: int = 0
    ) -> tuple[
        Float[np.ndarray, "T k"], Float[np.ndarray, "T m"], Float[np.ndarray, "T k"]
    ]:
        """``(s, a, s')`` of every step; states carry ``history`` past actions."""
        S, A = np.asarray(self.state), np.asarray(self.action)
        T, m = A.shape
        # Row history + t of `done` is the action of step t.
        done = np.concatenate([np.zeros((history, m), A.dtype), A])
        past = [done[history - k : history - k + T + 1] for k in range(1, history + 1)]
        full = np.concatenate([S, *past], axis=1)
        return full[:-1], A, full[1:]


def world_of(
    task: Task, dynamics: Dynamics, objective: AbstractObjective, *, history: int = 0
) -> World:
    """A draw and an objective, within what the task lets a planner know.

    ``history`` is the number of past actions in the state of ``dynamics``.
    """
    free = jnp.full(history * task.actions.low.size, jnp.inf, task.state_bound.dtype)
    return World(
        dynamics,
        objective,
        task.reset,
        task.actions,
        task.horizon,
        state_bound=jnp.concatenate([task.state_bound, free]),
        history=history,
        planning_horizon=task.planning_horizon,
        planning_iterations=task.planning_iterations,
        noise_colour=task.noise_colour,
    )


def oracle_world(task: Task) -> World:
    """The task's own noise-free dynamics and reward: the upper reference line."""
    objective = MarkovObjective(task.reward)
    return world_of(task, task.dynamics, objective, history=task.history)


def fly(
    task: Task, planner: AbstractPlanner, planner_state: Any, world: World, *, key: Key
) -> tuple[Trajectory, Any]:
    """One episode as one scan: pure, for `jit` and `vmap`; nothing is checked.

    The planner sees the physical state and as much of the past actions as its world
    carries; the machine gets exactly the planned action, clipped to its box.
    """
    reset, noise, plan = (
        jax.random.fold_in(key, purpose)
        for purpose in (Purpose.RESET, Purpose.NOISE, Purpose.PLAN)
    )
    past = jnp.zeros(world.history * task.actions.low.size, task.start.dtype)

    def step(carry: Any, t: Array) -> tuple[Any, Any]:
        s, past, planner_state = carry
        seen = jnp.concatenate([s[: task.size], past])
        planned, planner_state = planner.act(
            planner_state, world, seen, key=jax.random.fold_in(plan, t)
        )
        a = task.limit(planned)
        s2 = task.step(s, a, key=jax.random.fold_in(noise, t))
        reward, failed = task.reward(s, a, s2), planner.failed(planner_state)
        past = jnp.concatenate([a, past])[: past.size]
        return (s2, past, planner_state), (s2[: task.size], a, reward, failed)

    s0 = task.reset(reset)
    (_, _, planner_state), (states, actions, rewards, failed) = jax.lax.scan(
        step, (s0, past, planner_state), jnp.arange(task.horizon)
    )
    states = jnp.concatenate([s0[None, : task.size], states])
    return Trajectory(states, actions, rewards, failed), planner_state


_fly = eqx.filter_jit(fly)


def episode(
    task: Task, planner: AbstractPlanner, planner_state: Any, world: World, *, key: Key
) -> tuple[Trajectory, Any]:
    """One checked episode, compiled once for all draws, truths and keys.

    Raises `NotFinite` E203 at the first state, action or reward that is not finite;
    warns W203 where the draw predicted nothing valid and the last plan was kept.
    """
    trajectory, planner_state = _fly(task, planner, planner_state, world, key=key)
    check_finite(trajectory, task.name)
    blind = int(np.sum(np.asarray(trajectory.failed)))
    if blind:
        warn(
            "W203",
            f"{blind} of {task.horizon} plans had no valid rollout: the drawn dynamics "
            "diverge there, and the last plan was kept",
        )
    return trajectory, planner_state


def check_finite(trajectory: Trajectory, where: str) -> None:
    """Raise `NotFinite` E203 at the first step that holds a non-finite number."""
    for what, values in (
        ("action", trajectory.action),
        ("state", trajectory.state),
        ("reward", trajectory.reward),
    ):
        rows = np.asarray(values).reshape(len(values), -1)
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise NotFinite(
                "E203",
                f"{what} {bad[0]} of an episode",
                where=where,
                got=str(rows[bad[0]].tolist()),
                expected="finite numbers",
                fix="check the truth's constants and the integration step",
            )


class Episode(eqx.Module):
    """What `posterior_sampling` reports after each episode; ``index`` counts from 1."""

    index: int
    trajectory: Trajectory
    belief: AbstractBelief


class History(eqx.Module):
    """A whole run, as numpy arrays: E episodes of T steps.

    ``parameter_mean`` and ``parameter_sd`` (virtual) have E + 1 rows, the prior first;
    they are None for beliefs without parameters. ``belief`` has seen all episodes.
    """

    state: Float[np.ndarray, "E times n"]
    action: Float[np.ndarray, "E T m"]
    reward: Float[np.ndarray, "E T"]
    failed: Bool[np.ndarray, "E T"]
    parameter_mean: Float[np.ndarray, "rounds p"] | None
    parameter_sd: Float[np.ndarray, "rounds p"] | None
    belief: AbstractBelief
    data: Transitions

    @property
    def returns(self) -> Float[np.ndarray, " E"]:
        """The sum of rewards of each episode."""
        return self.reward.sum(axis=1, dtype=np.float64)


def posterior_sampling(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    objective: Callable[[AbstractBelief], AbstractObjective],
    episodes: int,
    key: Key,
    history: int = 0,
    on_episode: Callable[[Episode], None] | None = None,
) -> History:
    """``episodes`` rounds of: draw a world, act in it on ``task``, fit all data.

    ``objective`` makes what is maximised out of the belief at the episode's start.
    The first episode is flown on a draw from the prior. ``history`` is the number of
    past actions that the model's state carries. ``on_episode`` is called after each
    fit. Raises what the fit raises, and `NotFinite`.
    """
    m = task.actions.low.size
    data = Transitions.empty(episodes * task.horizon, task.size + history * m, m)
    belief = model.init(key_for(key, 0, Purpose.INIT))
    summaries, trajectories = [_parameters(belief)], []
    planner_state = None
    for e in range(1, episodes + 1):
        draw = belief.sample(key_for(key, e, Purpose.DRAW))
        world = world_of(task, draw, objective(belief), history=history)
        if planner_state is None:
            planner_state = planner.init(world, key=key_for(key, 0, Purpose.PREPARE))
        planner_state = planner.prepare(
            planner_state, world, data, key=key_for(key, e, Purpose.PREPARE)
        )
        trajectory, planner_state = episode(
            task, planner, planner_state, world, key=key_for(key, e, Purpose.EPISODE)
        )
        data = data.extend(*trajectory.transitions(history))
        belief = model.fit(belief, data, key=key_for(key, e, Purpose.FIT))
        trajectories.append(jax.tree.map(np.asarray, trajectory))
        summaries.append(_parameters(belief))
        if on_episode is not None:
            on_episode(Episode(e, trajectories[-1], belief))
    return _history(trajectories, summaries, belief, data)


def psrl(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    episodes: int,
    key: Key,
    history: int = 0,
    on_episode: Callable[[Episode], None] | None = None,
) -> History:
    """Posterior sampling with the task's own reward."""
    return posterior_sampling(
        task,
        model,
        planner,
        objective=lambda belief: MarkovObjective(task.reward),
        episodes=episodes,
        key=key,
        history=history,
        on_episode=on_episode,
    )


class OracleRun(eqx.Module):
    """Episodes of a planner that knows the truth; fewer than asked if one fell."""

    returns: Float[np.ndarray, " E"]
    swings_up: bool = eqx.field(static=True)

    @property
    def oracle_return(self) -> float:
        """Median of the returns."""
        return float(np.median(self.returns))


def fly_oracle(
    task: Task, planner: AbstractPlanner, *, key: Key, episodes: int = 5
) -> OracleRun:
    """The upper reference: ``planner`` in a world made of the true dynamics.

    It plans without noise and flies the noisy task. It swings up when the pole stands
    over the last second of every episode; the first one that does not ends the run.
    """
    world = oracle_world(task)
    planner_state = planner.init(world, key=key_for(key, 0, Purpose.PREPARE))
    data = Transitions.empty(1, task.size, task.actions.low.size)
    ready = planner.prepare(
        planner_state, world, data, key=key_for(key, 1, Purpose.PREPARE)
    )
    returns, up = [], True
    for e in range(1, episodes + 1):
        key_e = key_for(key, e, Purpose.ORACLE)
        trajectory, _ = episode(task, planner, ready, world, key=key_e)
        returns.append(float(trajectory.total))
        up = bool(task.swung_up(jnp.asarray(trajectory.state)))
        if not up:
            break
    return OracleRun(np.asarray(returns), up)


class AcceptedTruth(eqx.Module):
    """A task that its oracle can solve, and how many draws were thrown away."""

    task: Task
    oracle: OracleRun
    redrawn: int = eqx.field(static=True)


def accept_truth(
    preset: Callable[[Any], Task],
    system: AbstractSystem,
    planner: AbstractPlanner,
    *,
    key: Key,
    truth: str = "prior",
    attempts: int = 100,
) -> AcceptedTruth:
    """Draw truths (`tasks.draw_truth`) until the oracle swings one up.

    ``preset`` makes a task of a record of constants (`tasks.furuta_swingup`). Raises
    `NotFinite` as `episode`, `Sim2GPError` E204 when ``attempts`` draws all fail.
    """
    for attempt in range(attempts):
        record = draw_truth(system, key_for(key, attempt, Purpose.TRUTH), truth)
        task = preset(record)
        key_a = jax.random.fold_in(key, attempt)
        oracle = fly_oracle(task, planner, key=key_a)
        if oracle.swings_up:
            return AcceptedTruth(task, oracle, attempt)
    raise Sim2GPError(
        "E204",
        f"no truth that {type(planner).__name__} can swing up",
        got=f"{attempts} draws ({truth})",
        expected="at least one",
        fix="narrow the prior or give the planner more samples",
    )


def _parameters(belief: AbstractBelief) -> tuple[np.ndarray, np.ndarray] | None:
    """Virtual mean and sd of the constants, where the belief has any."""
    moments = getattr(belief, "parameters", None)
    if moments is None:
        return None
    mean, sd = moments()
    return np.asarray(mean), np.asarray(sd)


def _history(
    trajectories: list[Trajectory],
    summaries: list[tuple[np.ndarray, np.ndarray] | None],
    belief: AbstractBelief,
    data: Transitions,
) -> History:
    flown = jax.tree.map(lambda *leaves: np.stack(leaves), *trajectories)
    known = [summary for summary in summaries if summary is not None]
    complete = len(known) == len(summaries)
    return History(
        flown.state,
        flown.action,
        flown.reward,
        flown.failed,
        np.stack([mean for mean, _ in known]) if complete else None,
        np.stack([sd for _, sd in known]) if complete else None,
        belief,
        data,
    )
