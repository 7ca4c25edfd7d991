"""Many environments of one machine as one compiled program, for `gymnasium.make_vec`.

Each is what it is alone (`sim2gp.robot.gymnasium`), with the next seed, but for the
last bits of its numbers. After its last step it starts again in the next one, whose
action and reward do not count (Gymnasium's ``NEXT_STEP``).
"""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.errors import error, missing_extra
from sim2gp.planning.episode import Purpose, key_for
from sim2gp.planning.tasks import Task
from sim2gp.robot.gymnasium import (
    PUBLISHED,
    SEEDS,
    MachineSpec,
    StepOutcome,
    bound_of,
    check_met,
    key_of,
    make_machine_spec,
    reset_task,
    step_task,
    validate_action,
)
from sim2gp.systems import AbstractPart
from sim2gp.types import AnyArray, Key


def make_environments(
    machine: str,
    num_envs: int = 1,
    *,
    truth: str = PUBLISHED,
    params: Mapping[str, float] | None = None,
    effects: Sequence[AbstractPart | str] = (),
    max_episode_steps: int = Task.horizon,
    render_mode: None = None,
) -> Any:
    """So many swing-ups of a machine as a `gymnasium.vector.VectorEnv`.

    Options and errors are those of `sim2gp.robot.gymnasium.make_environment`.
    """
    made = make_machine_spec(machine, truth, params or {}, effects)
    try:
        return _vector_class()(made, num_envs, max_episode_steps)
    except ImportError as error:
        what = "environments cannot be made"
        raise missing_extra(what, error, "gym") from error


class Batch(eqx.Module):
    """Where each environment is: its state, the number of its episode and step."""

    state: Float[Array, "N k"]
    episode: Int[AnyArray, " N"]
    step: Int[AnyArray, " N"]


@eqx.filter_jit
def reset_batch(
    tasks: Task, bound: AnyArray, keys: Array, episode: Int[AnyArray, " N"]
) -> tuple[Array, Array]:
    """The starts of these episodes, and what is seen of them."""
    arrays, rest = eqx.partition(tasks, eqx.is_array)

    def one(arrays: Task, key: Key, e: Array) -> tuple[Array, Array]:
        flying = key_for(key, e, Purpose.EPISODE)
        return reset_task(eqx.combine(arrays, rest), bound, flying)

    return jax.vmap(one)(arrays, keys, episode)


@eqx.filter_jit
def step_batch(
    tasks: Task, bound: AnyArray, keys: Array, now: Batch, U: AnyArray
) -> StepOutcome:
    """One step of each."""
    arrays, rest = eqx.partition(tasks, eqx.is_array)

    def one(
        arrays: Task, key: Key, s: Array, e: Array, t: Array, u: Array
    ) -> StepOutcome:
        flying = key_for(key, e, Purpose.EPISODE)
        return step_task(eqx.combine(arrays, rest), bound, s, u, t, flying)

    return jax.vmap(one)(arrays, keys, now.state, now.episode, now.step, U)


class Fleet:
    """The machines and where they are, without Gymnasium."""

    def __init__(self, made: MachineSpec, count: int, longest: int) -> None:
        self.made, self.count = made, count
        self.task = made.published()
        self.bound = bound_of(self.task, made.machine)
        self.longest = min(longest, self.task.horizon)
        self.each: list[Task] = [self.task] * count
        self.keys: list[Key | None] = [None] * count
        self.episode: Int[np.ndarray, " N"] = np.zeros(count, np.int32)
        self.over: Bool[np.ndarray, " N"] = np.zeros(count, bool)
        self.now: Batch | None = None

    def reset(
        self, seeds: Sequence[int | None], rng: np.random.Generator
    ) -> np.ndarray:
        """The next episodes; the first of its machine where there is a seed."""
        for i, given in enumerate(seeds):
            if given is None and self.keys[i] is not None:
                continue
            key = key_of(int(rng.integers(SEEDS)) if given is None else given)
            self.keys[i], self.each[i] = key, self.made.task(key)
            self.episode[i] = 0
        self.episode = self.episode + np.int32(1)
        self.tasks = stack_tasks(self.each)
        self.key = jnp.stack([key for key in self.keys if key is not None])
        state, seen = reset_batch(self.tasks, self.bound, self.key, self.episode)
        self.now = Batch(state, self.episode, np.zeros(self.count, np.int32))
        self.over = np.zeros(self.count, bool)
        return np.array(seen)

    def step(self, now: Batch, U: np.ndarray) -> Any:
        """One period of each; a new start where an episode was over."""
        again = self.over
        met = step_batch(self.tasks, self.bound, self.key, now, U)
        state, seen = met.state, met.observation
        self.episode = self.episode + again.astype(np.int32)
        step = np.where(again, 0, np.asarray(now.step) + 1).astype(np.int32)
        if again.any():
            fresh = reset_batch(self.tasks, self.bound, self.key, self.episode)
            state, seen = (
                jnp.where(again[:, None], new, old)
                for new, old in zip(fresh, (state, seen), strict=True)
            )
        self.now = Batch(state, self.episode, step)
        ended = np.asarray(met.outside) & ~again
        late = (step == self.longest) & ~again
        self.over = ended | late
        return batch_step_result(met, np.array(seen), again, ended, late)


@functools.cache
def _vector_class() -> Any:
    """The one class of vectors of environments."""
    import gymnasium
    from gymnasium.spaces import Box
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    class TaskVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
        """Tasks of one kind, a step of all at a time."""

        metadata = {  # noqa: RUF012
            "render_modes": [],
            "render_fps": round(1.0 / Task.dt),
            "autoreset_mode": AutoresetMode.NEXT_STEP,
        }
        render_mode = None

        def __init__(self, made: MachineSpec, count: int, longest: int) -> None:
            self.fleet = Fleet(made, count, longest)
            self.num_envs = count
            m, bound = self.fleet.task.actions.low.size, self.fleet.bound
            self.single_action_space = Box(-1.0, 1.0, (m,), np.float32)
            self.single_observation_space = Box(-bound, bound, dtype=np.float32)
            self.action_space = batch_space(self.single_action_space, count)
            self.observation_space = batch_space(self.single_observation_space, count)

        def reset(
            self,
            *,
            seed: int | Sequence[int | None] | None = None,
            options: dict[str, Any] | None = None,
        ) -> tuple[np.ndarray, dict[str, Any]]:
            """The next episodes; of one seed, each environment has the next one."""
            super().reset(seed=seed if isinstance(seed, int) else None)
            if options:
                got = ", ".join(map(str, options))
                raise error("unknown_option_of_reset", got=got)
            seeds = seeds_of(seed, self.num_envs)
            seen = self.fleet.reset(seeds, self.np_random)
            return seen, {"status": np.full(self.num_envs, "running", object)}

        def step(self, actions: np.ndarray) -> Any:
            """One period of each, or a new start. Raises E140, E101, E203."""
            if self.fleet.now is None:
                raise gymnasium.error.ResetNeeded("call reset before step")
            m = self.fleet.task.actions.low.size
            U = validate_action(actions, (self.num_envs, m))
            return self.fleet.step(self.fleet.now, U)

    return TaskVectorEnv


def seeds_of(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
    """One for each environment (E140 for another number of them)."""
    if seed is None:
        return [None] * count
    if isinstance(seed, int):
        return [seed + i for i in range(count)]
    if len(seed) != count:
        raise error("seeds_of_reset", got=f"{len(seed)} seeds", count=count)
    return list(seed)


def stack_tasks(tasks: Sequence[Task]) -> Task:
    """Tasks of one kind as one, whose arrays have another axis in front."""
    rest = eqx.filter(tasks[0], eqx.is_array, inverse=True)
    arrays = [eqx.filter(task, eqx.is_array) for task in tasks]
    return eqx.combine(jax.tree.map(lambda *x: jnp.stack(x), *arrays), rest)


def batch_step_result(
    met: StepOutcome,
    seen: np.ndarray,
    again: Bool[np.ndarray, " N"],
    ended: Bool[np.ndarray, " N"],
    late: Bool[np.ndarray, " N"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
    """A step as Gymnasium returns it; a new start has no reward, and no terms."""
    met = jax.device_get(met)
    check_met(met.state[~again], met.reward[~again])
    status = np.full(len(again), "running", object)
    status[late], status[ended] = "horizon", "limits"
    info = {
        "status": status,
        "reward_terms": {name: np.array(x) for name, x in met.terms.items()},
        "_reward_terms": ~again,
        "input": np.array(met.action),
        "_input": ~again,
    }
    reward = np.where(again, np.float32(0.0), met.reward).astype(np.float64)
    return seen, reward, ended, late, info
