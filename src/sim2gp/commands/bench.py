"""How fast is it here? What this library does, and what bounds it, timed in turns.

The two calls of a job take turns, so that their ratio holds on a busy machine too.
Ratios of one core need one core: ``taskset -c 0 sim2gp bench``.
"""

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from sim2gp.commands import bench_jobs as jobs
from sim2gp.commands.bench_jobs import Pair
from sim2gp.commands.result import AbstractResult
from sim2gp.runs import Progress
from sim2gp.runs.executors import cores
from sim2gp.runs.provenance import provenance

TURNS, SECONDS = 20, 6.0  # of a job: so many, or as many as fit


@dataclass(frozen=True)
class Job:
    """``what`` takes at most ``target`` times as long as ``against``.

    ``make`` returns both, compiled when they are called for the first time.
    """

    what: str
    against: str
    target: float
    make: Callable[[], Pair]


BARE = "a bare rollout of 1,024 x 50 steps"
JOBS = (
    Job(
        "MPPI plan 1,024 x 50, cart-pole, in the simulator",
        BARE,
        1.3,
        jobs.plan_in_simulator,
    ),
    Job(
        "MPPI plan 1,024 x 50, cart-pole, in a draw of the prior",
        BARE,
        1.6,
        jobs.plan_in_draw,
    ),
    Job(
        "fit of the Furuta's 250 transitions",
        "one evaluation of their Jacobians",
        15.0,
        jobs.fit_and_jacobians,
    ),
    Job("fit with missing forces", "the plain fit", 2.0, jobs.fit_with_missing_forces),
    Job(
        "SAC, 64 episodes, as many updates as steps",
        "the same updates alone",
        1.3,
        jobs.sac_and_updates,
    ),
    Job("C MuJoCo, 100 windows of 200 steps", "bare mj_step", 1.15, jobs.mujoco_steps),
    Job("import sim2gp, a new process", "import jax", 1.3, jobs.imports),
    Job("sim2gp --help, a new process", "0.5 s", 1.0, jobs.command_line_help),
)


@dataclass(frozen=True, repr=False)
class Bench(AbstractResult):
    """Times, their ratios and the targets of all jobs."""


def bench(*, progress: Progress | None = None) -> Bench:
    """Time every job; one whose optional package is not installed says so."""
    progress, started = progress or Progress(), time.perf_counter()
    rows = []
    for job in JOBS:
        rows.append(timed_row(job))
        progress.say(line(rows[-1]))
    return Bench(summary_of(rows, started))


def summary_of(rows: list[dict[str, Any]], started: float) -> dict[str, Any]:
    """What `bench` says of its rows."""
    met = sum(bool(row.get("meets_target")) for row in rows)
    return {
        "command": "bench",
        "headline": f"{met} of {len(rows)} targets met",
        "rows": rows,
        "cores": cores(),
        **provenance(started),
        "tables": [_table(rows)],
    }


def timed_row(job: Job) -> dict[str, Any]:
    """The job's medians in s, and the median ratio of its turns."""
    try:
        return row_of(job.what, job.against, job.target, *timed(job.make()))
    except ImportError as missing:
        none = dict.fromkeys(("ours", "theirs", "ratio", "meets_target"))
        about = {"job": job.what, "against": job.against, "target": job.target}
        return about | none | {"missing": str(missing.name or missing)}


def row_of(
    what: str,
    against: str,
    target: float,
    ours: float,
    theirs: float,
    ratio: float | None = None,
) -> dict[str, Any]:
    """A row of the table; without a ``ratio`` that of these seconds."""
    ratio = ours / theirs if ratio is None else ratio
    row = {"job": what, "against": against, "ours": ours, "theirs": theirs}
    return row | {"ratio": ratio, "target": target, "meets_target": ratio <= target}


def timed(pair: Pair) -> tuple[float, float, float]:
    """Median seconds of both, and of the ratio, after a turn that compiles."""
    ours, theirs = pair
    each: list[tuple[float, float]] = []
    began = time.perf_counter()
    while len(each) <= TURNS and (
        len(each) < 4 or time.perf_counter() - began < SECONDS
    ):
        each.append((_seconds(ours), _seconds(theirs)))
    counted = np.asarray(each[1:])
    ratio = statistics.median(counted[:, 0] / counted[:, 1])
    return *np.median(counted, axis=0).tolist(), float(ratio)


def _seconds(work: Callable[[], object] | float) -> float:
    if isinstance(work, float):
        return work
    started = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - started


def line(row: Mapping[str, Any]) -> str:
    about = f"{row['job']}, against {row['against']}"
    if row["ratio"] is None:
        return f"{about}: {row['missing']} is not installed"
    held = "met" if row["meets_target"] else "not met"
    return f"{about}: {row['ratio']:.3g} (at most {row['target']:g}: {held})"


def _table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    def words(row: Mapping[str, Any]) -> list[str]:
        if row["ratio"] is None:
            return ["", "", f"{row['missing']} is not installed"]
        times = [f"{1e3 * row[name]:.3g} ms" for name in ("ours", "theirs")]
        return [*times, f"{row['ratio']:.3g}"]

    return {
        "title": "Times and their ratios",
        "columns": ["job", "against", "ours", "theirs", "ratio", "at most"],
        "rows": [
            [row["job"], row["against"], *words(row), f"{row['target']:g}"]
            for row in rows
        ],
    }
