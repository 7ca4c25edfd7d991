"""A session that designs its own experiments and stops, and a tuned multisine.

    python benchmarks/session.py [--truths N] [--rounds N] [--workers N] [--out DIR]
        [--refresh | --keep-old]

Hidden two-link arms from CAD priors, as in `design.py`. The session designs ten
seconds, runs them, fits all logs, and designs again, until `sim2gp design` says that
another run is not worth it. The multisine was optimised once, for the middle of the
prior, and is run again and again. Both keep the same limits; each design is the best of
as many searches as the multisine had. Compared is the held-out error that the session
stops with and that of the multisine after twice the seconds: a ratio of at most 1 where
the session needs half of the robot's time. As in `design.py` an error is the root mean
square over recordings of the same motions, each with noise of its own.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from design import (
    LIMITS,
    NOISE,
    PERIOD,
    RATES,
    STARTS,
    arm,
    fitted,
    motion_error,
    recorded,
    setting,
    stored,
)
from sim2gp.commands.design import expectation
from sim2gp.data.logs import Log
from sim2gp.experiment_design import (
    DOptimal,
    FreeCommands,
    MultisineCommands,
    optimise_commands,
)
from sim2gp.experiment_design.verdict import DesignOptions, experiment_verdict
from sim2gp.inference.gaussian import Gaussian
from sim2gp.runs.cells import Cells, Old, add_options
from sim2gp.runs.executors import Processes, cores
from sim2gp.studies.claims import bootstrap_median
from sim2gp.types import in_float64

SECONDS = 10.0
#: What `sim2gp design` asks by default.
ASKED = DesignOptions(SECONDS, "free", (), None, 2.0, {}, {}, {}, PERIOD)
#: Of the same motions; the session itself learns from the first.
RECORDINGS = 5
MULTISINE = "multisine"  # the cell of its commands
#: The project's goal: as good as the multisine in so many times the seconds.
TIMES = 2


class Job(NamedTuple):
    seed: int
    rounds: int
    out: Path
    old: Old

    @property
    def name(self) -> str:
        """Of its cell."""
        return f"arm{self.seed}"

    @property
    def arguments(self) -> dict[str, Any]:
        """What its cell rests on."""
        settings = {
            "rounds": self.rounds,
            "noise": NOISE,
            "limits": LIMITS,
            "rates": RATES,
        }
        return settings | {"starts": STARTS, "recordings": RECORDINGS, "times": TIMES}

    @property
    def cells(self) -> Cells:
        return Cells(self.out, __file__, self.old)


@in_float64
def session(seed: int, rounds: int) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Design, run, learn, until it is not worth it; what it said, and its commands."""
    experiment, limits = setting(SECONDS)
    signal = FreeCommands(PERIOD, experiment.steps)
    belief: Gaussian = arm().parameters.prior()
    logs: list[Log] = []
    commands: list[np.ndarray] = []
    errors: list[float] = []
    said, stopped = "", False
    while not stopped and len(logs) < rounds:
        now = eqx.tree_at(lambda e: e.belief, experiment, belief)
        key = jax.random.key(100 * seed + len(logs))
        found = optimise_commands(
            now, DOptimal(), limits, signal, key=key, starts=STARTS
        )
        worth, said = experiment_verdict(ASKED, expectation(now, found), found.nats)
        stopped = not worth
        if worth:
            logs.append(recorded(seed, len(logs), found.commands)[0])
            commands.append(found.commands)
            belief = fitted(logs, seed)
            errors.append(motion_error(belief, seed))
    return {"errors": errors, "stopped": stopped, "said": said}, commands


@in_float64
def tuned() -> np.ndarray:
    """The multisine, optimised for the middle of the prior."""
    experiment, limits = setting(SECONDS)
    signal, key = MultisineCommands(PERIOD, experiment.steps), jax.random.key(0)
    found = optimise_commands(
        experiment, DOptimal(), limits, signal, key=key, draws=1, starts=STARTS
    )
    return found.commands


@in_float64
def judged(seed: int, commands: list[np.ndarray], first: int) -> list[float]:
    """The held-out error of each recording of these runs, numbered from ``first``."""
    errors = []
    for again in range(RECORDINGS):
        number = first + 1000 * again
        logs = [recorded(seed, number + k, U)[0] for k, U in enumerate(commands)]
        errors.append(motion_error(fitted(logs, seed), seed))
    return errors


def work(job: Job) -> dict[str, Any]:
    """Both on one arm; from the disk if they were run."""
    cells = job.cells
    U = stored(cells, MULTISINE, tuned)
    found = cells.load(job.name, job.arguments)
    if found is None:
        said, commands = session(job.seed, job.rounds)
        np.savez(cells.folder / f"{job.name}.npz", *commands)
        n = len(commands)
        values = {
            "session": judged(job.seed, commands, 0),
            "as_many": judged(job.seed, n * [U], 100),
            "more": judged(job.seed, TIMES * n * [U], 100),
        }
        found = cells.save(job.name, job.arguments, said | values)
    return found


def error(row: dict[str, Any], which: str) -> float:
    """Root mean square over the recordings."""
    return float(np.sqrt(np.mean(np.square(row[which]))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--truths", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("results/session"))
    add_options(parser)
    options = parser.parse_args()
    seeds, rest = range(options.truths), (options.rounds, options.out, options.old)
    jobs = [Job(seed, *rest) for seed in seeds]
    cells = Cells(options.out, __file__, options.old)
    cells.check([(MULTISINE, {}), *((job.name, job.arguments) for job in jobs)])
    stored(cells, MULTISINE, tuned)
    groups = [jobs[i :: options.workers] for i in range(options.workers)]
    rows: list[Any] = [None] * len(jobs)
    for job, row in Processes(options.workers).spread(work, groups):
        rows[job.seed] = row
        print(f"arm {job.seed}: {len(row['errors'])} runs", file=sys.stderr)
    text = "\n".join(lines(rows))
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.txt").write_text(text + "\n")
    (options.out / "arms.json").write_text(json.dumps(rows, indent=1) + "\n")


def lines(rows: list[dict[str, Any]]) -> list[str]:
    """Arm by arm, and the goal."""
    out = [
        f"{'arm':4s}{'runs':>6s}{'error, rad':>12s}{'multisine after as many':>26s}"
        f"{'after ' + str(TIMES) + ' times as many':>24s}"
    ]
    for i, row in enumerate(rows):
        each = [error(row, which) for which in ("session", "as_many", "more")]
        errors = f"{each[0]:12.2e}{each[1]:26.2e}{each[2]:24.2e}"
        out.append(f"{i:<4d}{len(row['errors']):6d}{errors}")
    each = np.asarray([error(r, "session") / error(r, "more") for r in rows])
    middle, low, high = bootstrap_median(each, np.random.default_rng(0))
    held = "holds" if middle <= 1.0 else "does not hold"
    stopped = sum(row["stopped"] for row in rows)
    seconds = SECONDS * np.median([len(row["errors"]) for row in rows])
    return [
        *out,
        f"stopped by itself: {stopped} of {len(rows)}, after {seconds:g} s (median)",
        f"as good as the multisine in {TIMES} times the seconds: {held} (its error is "
        f"{middle:.2f} [{low:.2f}, {high:.2f}] of the multisine's, median over arms)",
    ]


if __name__ == "__main__":
    main()
