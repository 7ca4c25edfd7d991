"""The upper reference: a planner that knows the truth, and truths that it can solve."""

from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp import checks
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotFinite, Sim2GPError, error
from sim2gp.planning.episode import Purpose, Trajectory, episode, key_for, oracle_world
from sim2gp.planning.tasks import Task, draw_truth
from sim2gp.planning.world import AbstractPlanner, World
from sim2gp.systems import AbstractSystem
from sim2gp.types import Key


class OracleRun(eqx.Module):
    """Episodes of a planner that knows the truth; fewer than asked if one fell."""

    returns: Float[np.ndarray, " E"]
    reached: bool = eqx.field(static=True)

    @property
    def oracle_return(self) -> float:
        """Median of the returns."""
        return float(np.median(self.returns))


def run_oracle(
    task: Task, planner: AbstractPlanner, *, key: Key, episodes: int = 5
) -> OracleRun:
    """The upper reference: ``planner`` in a world made of the true dynamics.

    It plans without noise and acts on the noisy task. It has reached the task's goal
    where every episode ends there; the first one that does not ends the run.
    """
    checks.count("run_oracle", episodes=episodes)
    returns, reached = [], True
    world = oracle_world(task)
    for trajectory in episodes_in(task, world, planner, key=key, episodes=episodes):
        returns.append(float(trajectory.total))
        reached = bool(task.reached(jnp.asarray(trajectory.state)))
        if not reached:
            break
    return OracleRun(np.asarray(returns), reached)


def episodes_in(
    task: Task, world: World, planner: AbstractPlanner, *, key: Key, episodes: int
) -> Iterator[Trajectory]:
    """Episodes of a planner that learns nothing of the machine but what its world is.

    It gets ready for the world before each of them: MPC forgets, SAC trains on.
    """
    state = planner.init(world, key=key_for(key, 0, Purpose.PREPARE))
    size = jax.eval_shape(world.reset, key).size
    nothing = Transitions.empty(1, size, task.actions.low.size)
    for e in range(1, episodes + 1):
        preparing = key_for(key, e, Purpose.PREPARE)
        state = planner.prepare(state, world, nothing, key=preparing)
        flying = key_for(key, e, Purpose.ORACLE)
        trajectory, state = episode(task, planner, state, world, key=flying)
        yield trajectory


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

    ``preset`` makes a task of a record of parameters (`tasks.furuta_swingup`). A truth
    that the oracle drives to where its integration diverges is one not swung up (far
    beyond its bounds a machine spins faster than the substeps can follow). Raises
    `Sim2GPError` E204 when ``attempts`` draws all fail.
    """
    checks.count("accept_truth", attempts=attempts)
    diverged = 0
    for attempt in range(attempts):
        record = draw_truth(system, key_for(key, attempt, Purpose.TRUTH), truth)
        task = preset(record)
        key_a = jax.random.fold_in(key, attempt)
        try:
            oracle = run_oracle(task, planner, key=key_a)
        except NotFinite:
            diverged += 1
            continue
        if oracle.reached:
            return AcceptedTruth(task, oracle, attempt)
    raise no_truth(
        f"{attempts} draws ({truth}), {diverged} of them not finite", planner
    )


def no_truth(got: str, planner: AbstractPlanner) -> Sim2GPError:
    """E204: what was tried without success."""
    name = type(planner).__name__
    return error("no_truth_swung_up", Sim2GPError, got=got, planner=name)
