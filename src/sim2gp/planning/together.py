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
from sim2gp.planning.loop import Learning
from sim2gp.planning.world import World
from sim2gp.types import Key

#: Of one run: its episodes, and what ended it early (empty for nothing).
Ended = tuple[list[Trajectory], str]


def learn_together(runs: Sequence[Learning], episodes: int) -> list[Ended]:
    """So many episodes of each run; one whose fit fails goes on no more.

    The last episode is not fitted.
    """
    failed = [""] * len(runs)
    for run in runs:
        run.shared = True
    for e in range(1, episodes + 1):
        left = [k for k, why in enumerate(failed) if not why]
        worlds = {k: runs[k].begin() for k in left}
        for group in _alike(runs, worlds):
            members = [(runs[k], worlds[k]) for k in group]
            for k, found in zip(group, _flown(members), strict=True):
                failed[k] = _learned(runs[k], *found, fit=e < episodes)
    return [(run.trajectories, why) for run, why in zip(runs, failed, strict=True)]


def _learned(run: Learning, flown: Trajectory, state: Any, *, fit: bool) -> str:
    """Why a run ends here; empty if it does not. Its episode counts in either case."""
    try:
        check_finite(flown, run.task.name)
    except NotFinite as error:
        return str(error)
    with jax.default_device(jax.devices("cpu")[0]):
        try:
            run.learn(flown, state, fit=fit)
        except (NotConverged, NotFinite) as error:
            run.trajectories.append(flown)
            return str(error)
    return ""


def _alike(runs: Sequence[Learning], worlds: dict[int, World]) -> list[list[int]]:
    """Runs that share a program, by their numbers."""
    groups: dict[Any, list[int]] = {}
    for k, world in worlds.items():
        parts = runs[k].task, runs[k].planner, runs[k].planner_state, world
        numbers = jax.tree.leaves(eqx.filter(parts, eqx.is_array))
        shapes = tuple((x.shape, x.dtype) for x in numbers)
        groups.setdefault((jax.tree.structure(parts), shapes), []).append(k)
    return list(groups.values())


def _flown(
    members: Sequence[tuple[Learning, World]],
) -> list[tuple[Trajectory, Any]]:
    """An episode of each, in one program."""
    first, planner = members[0][0], members[0][0].planner
    parts = [(run.task, run.planner_state, world) for run, world in members]
    arrays = [eqx.filter(x, eqx.is_array) for x in parts]
    _, rest = eqx.partition((first.task, *parts[0][1:]), eqx.is_array)
    stacked = jax.tree.map(lambda *x: jnp.stack([jnp.asarray(y) for y in x]), *arrays)
    keys = jnp.stack([run.key_for(Purpose.EPISODE) for run, _ in members])
    found, states = _fly_all(planner, stacked, rest, keys)
    host = jax.tree.map(np.asarray, found)
    return [
        (
            jax.tree.map(lambda x, k=k: x[k], host),
            jax.tree.map(lambda x, k=k: x[k] if eqx.is_array(x) else x, states),
        )
        for k in range(len(members))
    ]


@eqx.filter_jit
def _fly_all(planner: Any, stacked: Any, rest: Any, keys: Any) -> Any:
    def one(arrays: Any, key: Key) -> Any:
        task, state, world = eqx.combine(arrays, rest)
        return run_episode(task, planner, state, world, key=key)

    return jax.vmap(one)(stacked, keys)
