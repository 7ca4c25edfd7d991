"""Many runs at once: an episode of all of them is one program.

A device with many cores takes about as long for hundreds of planned episodes as for
one (`benchmarks/batched_episodes.py`). Runs whose worlds differ in numbers alone share
a program, on the first device of JAX's default backend. All else happens on the default
device, which a study sets to the host (`host`): small programs and float64 are slow on
a GPU. Keys are those of `psrl` and `accept_truth`: a run is the same as alone, up to
the rounding of float32.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.planning.episode import (
    Purpose,
    Trajectory,
    check_finite,
    key_for,
    oracle_world,
    run_episode,
)
from sim2gp.planning.loop import SamplingRun
from sim2gp.planning.mpc import MPC
from sim2gp.planning.oracle import AcceptedTruth, OracleRun, no_truth
from sim2gp.planning.tasks import Task, draw_truth
from sim2gp.planning.world import AbstractPlanner, World
from sim2gp.systems import AbstractSystem
from sim2gp.types import Key

#: Of one run: its episodes, and what ended it early (empty for nothing).
Ended = tuple[list[Trajectory], str]


class Start(NamedTuple):
    """An episode that is about to begin."""

    task: Task
    planner: AbstractPlanner
    planner_state: Any
    world: World
    key: Key


def learn_together(runs: Sequence[SamplingRun], episodes: int) -> list[Ended]:
    """So many episodes of each run, the last one not fitted.

    A run goes on no more after a fit that failed, or an episode that is not finite.
    """
    failed = [""] * len(runs)
    for e in range(1, episodes + 1):
        left = [k for k, why in enumerate(failed) if not why]
        found = run_together([_begun(runs[k]) for k in left])
        for k, (seen, state) in zip(left, found, strict=True):
            failed[k] = _kept(runs[k], seen, state, fit=e < episodes)
    return [(run.trajectories, why) for run, why in zip(runs, failed, strict=True)]


def _begun(run: SamplingRun) -> Start:
    world = run.begin(shared=True)
    key = run.key_for(Purpose.EPISODE)
    return Start(run.task, run.planner, run.planner_state, world, key)


def _kept(run: SamplingRun, seen: Trajectory, state: Any, *, fit: bool) -> str:
    """Why a run ends here; empty if it does not. Its episode counts if it is finite."""
    try:
        check_finite(seen, run.task.name)
        run.keep(seen, state)
        if fit:
            run.fit()
    except (NotConverged, NotFinite) as error:
        return str(error)
    return ""


def accept_together(
    presets: Sequence[Callable[[Any], Task]],
    system: AbstractSystem,
    planner: MPC,
    *,
    keys: Sequence[Key],
    episodes: int = 5,
    attempts: int = 100,
) -> list[AcceptedTruth]:
    """`accept_truth` of each preset with its key.

    All episodes of an oracle are one program with those of the others: model-predictive
    control remembers nothing of an episode before. Raises as `accept_truth`.
    """
    found: dict[int, AcceptedTruth] = {}
    for attempt in range(attempts):
        left = [k for k in range(len(keys)) if k not in found]
        if not left:
            break
        drawing = [key_for(keys[k], attempt, Purpose.TRUTH) for k in left]
        tasks = [
            presets[k](draw_truth(system, key))
            for k, key in zip(left, drawing, strict=True)
        ]
        flying = [jax.random.fold_in(keys[k], attempt) for k in left]
        oracles = _oracles(tasks, planner, flying, episodes)
        for k, task, oracle in zip(left, tasks, oracles, strict=True):
            if oracle.reached:
                found[k] = AcceptedTruth(task, oracle, attempt)
    if len(found) < len(keys):
        raise no_truth(f"{attempts} draws", planner)
    return [found[k] for k in range(len(keys))]


def _oracles(
    tasks: Sequence[Task], planner: MPC, keys: Sequence[Key], episodes: int
) -> list[OracleRun]:
    """Each task's oracle; one that diverges has not reached its goal."""
    starts = []
    for task, key in zip(tasks, keys, strict=True):
        world = oracle_world(task)
        state = planner.init(world, key=key)
        numbers = range(1, episodes + 1)
        each = [key_for(key, e, Purpose.ORACLE) for e in numbers]
        starts += [Start(task, planner, state, world, one) for one in each]
    seen = [trajectory for trajectory, _ in run_together(starts)]
    parts = [seen[k : k + episodes] for k in range(0, len(seen), episodes)]
    return [_oracle(*pair) for pair in zip(tasks, parts, strict=True)]


def _oracle(task: Task, seen: Sequence[Trajectory]) -> OracleRun:
    try:
        for trajectory in seen:
            check_finite(trajectory, task.name)
        reached = all(bool(task.reached(jnp.asarray(t.state))) for t in seen)
    except NotFinite:
        reached = False
    return OracleRun(np.asarray([float(t.total) for t in seen]), reached)


def run_together(starts: Sequence[Start]) -> list[tuple[Trajectory, Any]]:
    """The episode of each, and its planner's state after it; nothing is checked."""
    found: dict[int, tuple[Trajectory, Any]] = {}
    for group in _alike(starts):
        members = [starts[k] for k in group]
        found |= dict(zip(group, _episodes(members), strict=True))
    return [found[k] for k in range(len(starts))]


def _alike(starts: Sequence[Start]) -> list[list[int]]:
    """Episodes that share a program, by their numbers: only their arrays differ."""
    groups: dict[Any, list[int]] = {}
    for k, start in enumerate(starts):
        arrays, rest = eqx.partition(start, eqx.is_array)
        shapes = tuple((x.shape, x.dtype) for x in jax.tree.leaves(arrays))
        program = jax.tree.structure(start), shapes, tuple(jax.tree.leaves(rest))
        groups.setdefault(program, []).append(k)
    return list(groups.values())


def _episodes(starts: Sequence[Start]) -> list[tuple[Trajectory, Any]]:
    """Those of one program."""
    arrays, rest = eqx.partition(starts[0], eqx.is_array)
    arrays = [arrays, *(eqx.filter(start, eqx.is_array) for start in starts[1:])]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *arrays)
    found, states = _run_all(jax.device_put(stacked, jax.devices()[0]), rest)
    found, states = jax.tree.map(np.asarray, found), jax.device_put(states, _cpu())
    return [
        jax.tree.map(lambda x, k=k: x[k], (found, states)) for k in range(len(starts))
    ]


def host() -> AbstractContextManager[Any]:
    """Within it, what names no device is computed on the CPU."""
    return jax.default_device(_cpu())


def _cpu() -> jax.Device:
    return jax.devices("cpu")[0]


@eqx.filter_jit
def _run_all(stacked: Any, rest: Any) -> Any:
    def one(arrays: Any) -> Any:
        task, planner, state, world, key = eqx.combine(arrays, rest)
        return run_episode(task, planner, state, world, key=key)

    return jax.vmap(one)(stacked)
