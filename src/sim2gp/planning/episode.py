"""One episode: a planner acts on a task, and the world it plans in is one draw.

Every key is ``fold_in(fold_in(key, episode), purpose)``: what is added to a run changes
nothing that was in it.
"""

import enum
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.data.transitions import with_history
from sim2gp.errors import NotFinite, error, of_callbacks, warn
from sim2gp.inference.gaussian import Gaussian
from sim2gp.planning.tasks import Task
from sim2gp.planning.world import (
    AbstractObjective,
    AbstractPlanner,
    MarkovObjective,
    Observation,
    Resumed,
    World,
)
from sim2gp.types import Dynamics, Key, Scalar, State


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
    TEST = 10


def key_for(key: Key, episode: int | Int[Array, ""], purpose: Purpose) -> Key:
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
        return with_history(S, A, history)


class Reset(eqx.Module):
    """A task's start, with as many past actions as the state of a world carries."""

    task: Task
    past: int = eqx.field(static=True)

    def __call__(self, key: Key) -> State:
        start = self.task.reset(key)[: self.task.size]
        return jnp.concatenate([start, jnp.zeros(self.past, start.dtype)])


class DrawnReset(eqx.Module):
    """A start, and parameters drawn for it."""

    start: Callable[[Key], State]
    constants: Gaussian

    def __call__(self, key: Key) -> State:
        where, which = jax.random.split(key)
        return jnp.concatenate([self.start(where), self.constants.sample(which)])


def world_of(
    task: Task,
    dynamics: Dynamics,
    objective: AbstractObjective,
    *,
    history: int = 0,
    constants: Gaussian | None = None,
) -> World:
    """A draw and an objective, within what the task lets a planner know.

    ``history`` is the number of past actions in the state of ``dynamics``. Where the
    state ends in ``constants``, every reset draws them.
    """
    m = task.actions.low.size
    start: Callable[[Key], State] = Reset(task, history * m)
    more = history * m
    if constants is not None:
        start, more = DrawnReset(start, constants), more + constants.mean.size
    free = jnp.full(more, jnp.inf, task.state_bound.dtype)
    past = jnp.tile(0.5 * (task.actions.high - task.actions.low), history)
    return World(
        dynamics,
        objective,
        start,
        task.actions,
        task.horizon,
        state_bound=jnp.concatenate([task.state_bound, free]),
        history=history,
        planning_horizon=task.planning_horizon,
        planning_iterations=task.planning_iterations,
        noise_colour=task.noise_colour,
        seen=Observation(jnp.concatenate([task.trusted, past]), task.angle),
    )


def oracle_world(task: Task) -> World:
    """The task's own noise-free dynamics and reward: the upper reference line."""
    objective = MarkovObjective(task.reward)
    return world_of(task, task.dynamics, objective, history=task.history)


class Moment(eqx.Module):
    """Everything that an episode carries from one step to the next.

    ``memory`` is the objective's: what was done in this world counts where it plans.
    """

    state: State
    past: Float[Array, " history"]
    planner: Any
    memory: Any


def begin(
    task: Task, planner_state: Any, world: World, *, key: Key
) -> tuple[Moment, Any]:
    """The episode's first moment, and its start as it is seen."""
    start = task.reset(jax.random.fold_in(key, Purpose.RESET))
    past = jnp.zeros(world.history * task.actions.low.size, task.start.dtype)
    memory = world.objective.init()
    return Moment(start, past, planner_state, memory), start[: task.size]


def run_steps(
    task: Task,
    planner: AbstractPlanner,
    moment: Moment,
    world: World,
    steps: Int[Array, " T"],
    *,
    key: Key,
) -> tuple[Moment, tuple[Array, Array, Array, Array]]:
    """Some steps of an episode, by their numbers: states, actions, rewards, failures.

    The planner sees the physical state and as much of the past actions as its world
    carries; the machine gets exactly the planned action, clipped to its box.
    """
    noise = jax.random.fold_in(key, Purpose.NOISE)
    plan = jax.random.fold_in(key, Purpose.PLAN)

    def step(now: Moment, t: Array) -> tuple[Moment, Any]:
        seen = jnp.concatenate([now.state[: task.size], now.past])
        objective = Resumed(world.objective, now.memory)
        here = eqx.tree_at(lambda w: w.objective, world, objective)
        planned, planner_state = planner.act(
            now.planner, here, seen, key=jax.random.fold_in(plan, t)
        )
        a = task.limit(planned)
        s2 = task.step(now.state, a, key=jax.random.fold_in(noise, t))
        reward, failed = task.reward(now.state, a, s2), planner.failed(planner_state)
        past = jnp.concatenate([a, now.past])[: now.past.size]
        met = jnp.concatenate([s2[: task.size], past])
        memory, _ = world.objective.step(now.memory, seen, a, met)
        row = s2[: task.size], a, reward, failed
        return Moment(s2, past, planner_state, memory), row

    return jax.lax.scan(step, moment, steps)


def run_episode(
    task: Task, planner: AbstractPlanner, planner_state: Any, world: World, *, key: Key
) -> tuple[Trajectory, Any]:
    """One episode as one scan: pure, for `jit` and `vmap`; nothing is checked."""
    moment, start = begin(task, planner_state, world, key=key)
    steps = jnp.arange(task.horizon)
    moment, (states, *rest) = run_steps(task, planner, moment, world, steps, key=key)
    states = jnp.concatenate([start[None], states])
    return Trajectory(states, *rest), moment.planner


_fly_steps = eqx.filter_jit(run_steps)


@of_callbacks()
def episode(
    task: Task,
    planner: AbstractPlanner,
    planner_state: Any,
    world: World,
    *,
    key: Key,
    part: int | None = None,
    world_at: Callable[[Trajectory], World] | None = None,
) -> tuple[Trajectory, Any]:
    """One checked episode, compiled once for all draws, truths and keys.

    With ``part`` and ``world_at`` the world may change: after every ``part`` steps
    ``world_at`` gets the steps so far and returns the world to plan in from there. The
    plan itself is kept, and a world that stays the same changes nothing.

    Raises `NotFinite` E203 at the first state, action or reward that is not finite;
    warns W203 where the draw predicted nothing valid and the last plan was kept.
    """
    part = task.horizon if part is None else part
    moment, start = begin(task, planner_state, world, key=key)
    past: Trajectory | None = None
    for first in range(0, task.horizon, part):
        if past is not None and world_at is not None:
            world = world_at(past)
            # The steps so far are in the new world's belief.
            memory = world.objective.init()
            moment = eqx.tree_at(lambda m: m.memory, moment, memory)
        steps = jnp.arange(first, min(first + part, task.horizon))
        moment, rows = _fly_steps(task, planner, moment, world, steps, key=key)
        past = extended(past, start, rows)
        check_finite(past, task.name)
    assert past is not None
    blind = int(np.sum(past.failed))
    if blind:
        warn(
            "W203",
            f"{blind} of {task.horizon} plans had no valid rollout: the drawn dynamics "
            "diverge there, and the last plan was kept",
        )
    return past, moment.planner


def extended(past: Trajectory | None, start: Array, rows: Any) -> Trajectory:
    """A trajectory and the steps after it; the first ones follow the ``start``."""
    states, *rest = (np.asarray(x) for x in rows)
    if past is None:
        return Trajectory(np.concatenate([np.asarray(start)[None], states]), *rest)
    more = Trajectory(states, *rest)
    return jax.tree.map(lambda *x: np.concatenate(x), past, more)


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
            raise error(
                "episode_not_finite",
                NotFinite,
                where=where,
                got=str(rows[bad[0]].tolist()),
                what=what,
                step=bad[0],
            )
