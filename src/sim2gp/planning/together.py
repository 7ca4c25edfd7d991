"""Many runs of posterior sampling at once: an episode of all of them is one program.

A device with many cores takes about as long for hundreds of planned episodes as for
one (`benchmarks/batched_episodes.py`). Runs whose worlds differ in numbers alone share
a program; each is learned from by itself, on the host. Keys are those of `psrl`: a run
is the same as alone, up to the rounding of float32.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.planning.episode import Purpose, Trajectory, check_finite, run_episode
from sim2gp.planning.loop import SamplingRun
from sim2gp.planning.world import World
from sim2gp.types import Key

#: Of one run: its episodes, and what ended it early (empty for nothing).
Ended = tuple[list[Trajectory], str]


def learn_together(runs: Sequence[SamplingRun], episodes: int) -> list[Ended]:
    """So many episodes of each run; one whose fit fails goes on no more.

    The last episode is not fitted.
    """
    failed = [""] * len(runs)
    for e in range(1, episodes + 1):
        left = [k for k, why in enumerate(failed) if not why]
        worlds = {k: runs[k].begin(shared=True) for k in left}
        for group in _alike(runs, worlds):
            members = [(runs[k], worlds[k]) for k in group]
            for k, found in zip(group, _episodes(members), strict=True):
                failed[k] = _learned(runs[k], *found, fit=e < episodes)
    return [(run.trajectories, why) for run, why in zip(runs, failed, strict=True)]


def _learned(run: SamplingRun, seen: Trajectory, state: Any, *, fit: bool) -> str:
    """Why a run ends here; empty if it does not. Its episode counts if it is finite."""
    try:
        check_finite(seen, run.task.name)
        with jax.default_device(jax.devices("cpu")[0]):
            run.learn(seen, state, fit=fit)
    except (NotConverged, NotFinite) as error:
        return str(error)
    return ""


def _alike(runs: Sequence[SamplingRun], worlds: dict[int, World]) -> list[list[int]]:
    """Runs that share a program, by their numbers."""
    groups: dict[Any, list[int]] = {}
    for k, world in worlds.items():
        parts = runs[k].task, runs[k].planner, runs[k].planner_state, world
        numbers = jax.tree.leaves(eqx.filter(parts, eqx.is_array))
        shapes = tuple((x.shape, x.dtype) for x in numbers)
        groups.setdefault((jax.tree.structure(parts), shapes), []).append(k)
    return list(groups.values())


def _episodes(
    members: Sequence[tuple[SamplingRun, World]],
) -> list[tuple[Trajectory, Any]]:
    """An episode of each, in one program, and the planner's state after it."""
    parts = [(run.task, run.planner_state, world) for run, world in members]
    arrays, rest = eqx.partition(parts[0], eqx.is_array)
    arrays = [arrays, *(eqx.filter(x, eqx.is_array) for x in parts[1:])]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *arrays)
    keys = jnp.stack([run.key_for(Purpose.EPISODE) for run, _ in members])
    found, states = _run_all(members[0][0].planner, stacked, rest, keys)
    found = jax.tree.map(np.asarray, found)
    return [
        jax.tree.map(lambda x, k=k: x[k], (found, states)) for k in range(len(members))
    ]


@eqx.filter_jit
def _run_all(planner: Any, stacked: Any, rest: Any, keys: Any) -> Any:
    def one(arrays: Any, key: Key) -> Any:
        task, state, world = eqx.combine(arrays, rest)
        return run_episode(task, planner, state, world, key=key)

    return jax.vmap(one)(stacked, keys)
