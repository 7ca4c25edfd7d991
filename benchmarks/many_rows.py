"""Very many rows: how long `identify` takes, in how much memory, and what comes out.

    python benchmarks/many_rows.py [--rows N ...] [--compare N] [--out DIR]

Recordings of 20 s at 100 Hz of one two-link arm, each under its own torques
(`interval_arms.py`), in memory; the windows' length, forecasts and intervals are the
defaults, without a held-out fit. Each size is a process of its own that finds nothing
compiled. Memory is the largest that it had, where glibc gives back what is free
(`GIVE_BACK`). Of ``--compare`` rows the posterior is also computed with all windows at
once, and the largest difference reported: of means in sd, of sd as a share.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from interval_arms import (
    CONDITIONS,
    NOISE,
    PERIOD,
    Recordings,
    motion_of,
    multisine,
    physical,
)
from sim2gp.data.logs import Log

ROOT = Path(__file__).resolve().parents[1]
#: Of glibc: large arrays are given back when they are freed, not kept for others.
GIVE_BACK = {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_ARENA_MAX": "2"}
EACH, AT_ONCE = 2_000, 50  # rows of a log; logs that are simulated at a time


def logs_of(rows: int) -> tuple[np.ndarray, list[Log]]:
    """True virtual values, and recordings of so many rows together."""
    rng, found = np.random.default_rng(0), []
    truth = rng.standard_normal(4)
    while len(found) * EACH < rows:
        count = min(AT_ONCE, rows // EACH - len(found))
        values = np.repeat(truth[None], count, axis=0)
        torque = multisine(rng, EACH * PERIOD, count)
        angles = motion_of(physical(values), torque, CONDITIONS["white"])[..., :2]
        angles = angles + NOISE * rng.standard_normal(angles.shape)
        some = Recordings(values, torque, angles)
        found += [_own(some.log(s), len(found) + s) for s in range(count)]
    return truth, found


def _own(log: Log, number: int) -> Log:
    """With its own arrays: views would keep all that was simulated."""
    channels, inputs = (
        {name: np.array(x) for name, x in columns.items()}
        for columns in (log.channels, log.inputs)
    )
    name = f"log{number}"
    return Log(name, f"{name}.csv", log.time, channels, inputs, log.mask)


def identified(rows: int, *, at_once: bool = False) -> dict[str, Any]:
    """Seconds, memory in MiB, and the posterior; ``at_once``: never in parts."""
    import sim2gp as sg
    from sim2gp.project import training_windows

    if at_once:
        training_windows.MANY = sys.maxsize
    truth, logs = logs_of(rows)
    arm, started = sg.systems.UniformRodArm(), time.perf_counter()
    found = sg.identify(arm, logs, held_out=False)
    seconds = time.perf_counter() - started
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    plain = {name: np.asarray(found.arrays[f"belief/{name}"]) for name in _KEPT}
    sd = np.sqrt(np.sum(np.square(found.arrays["intervals/scale"]), axis=1))
    away = np.abs(found.arrays["intervals/mean"] - truth) / sd
    return {
        "rows": rows,
        "windows": found.summary["n_windows"],
        "window": found.summary["window"],
        "seconds": seconds,
        "memory": memory,
        "steps": found.summary["convergence"]["steps"],
        "away": away.tolist(),
        "alarm": found.summary["misfit"]["alarm"],
        **{name: x.tolist() for name, x in plain.items()},
    }


_KEPT = ("mean", "scale")


def difference(one: dict[str, Any], other: dict[str, Any]) -> dict[str, float]:
    """Of two posteriors of the same data, without corrections."""
    (mean, scale), (mean2, scale2) = (
        [np.asarray(x[name]) for name in _KEPT] for x in (one, other)
    )
    sd, sd2 = (np.linalg.norm(x, axis=1) for x in (scale, scale2))
    apart = np.max(np.abs(mean - mean2) / sd2), np.max(np.abs(sd / sd2 - 1.0))
    return dict(zip(("means_in_sd", "sd"), map(float, apart), strict=True))


def main() -> None:
    """Each size in a process of its own, then the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, nargs="*", default=[100_000, 1_000_000])
    parser.add_argument("--compare", type=int, default=100_000)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--at-once", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(identified(given.one, at_once=given.at_once)))
        return
    given.out.mkdir(parents=True, exist_ok=True)
    target = given.out / "many_rows.json"
    found = json.loads(target.read_text()) if target.exists() else {}
    for rows in given.rows:
        found[str(rows)] = _process(rows)
        target.write_text(json.dumps(found, indent=1) + "\n")
        row = found[str(rows)]
        print(f"{rows} rows: {row['seconds']:.0f} s, {row['memory']:.0f} MiB")
    if given.compare:
        pair = _process(given.compare), _process(given.compare, "--at-once")
        found["in parts, and at once"] = difference(*pair)
        target.write_text(json.dumps(found, indent=1) + "\n")
        print(found["in parts, and at once"])


def _process(rows: int, *more: str) -> dict[str, Any]:
    command = [sys.executable, __file__, "--one", str(rows), *more]
    how = os.environ | GIVE_BACK
    how.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        command, check=True, stdout=subprocess.PIPE, text=True, env=how
    )
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


if __name__ == "__main__":
    main()
