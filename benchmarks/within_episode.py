"""Learning within an episode and between episodes, under mismatch.

    python benchmarks/within_episode.py [--seeds N] [--episodes N] [--every STEPS]
        [--refresh | --keep-old]

The Furuta with figure 2's cable spring. Each learner is run as the paper has it (one
world per episode) and with a belief that is conditioned, and drawn from again, every
second. Seeds are paired: the same machine, the same noise. Finished cells are kept.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

from sim2gp.planning.tasks import SOLVED
from sim2gp.runs import Progress
from sim2gp.runs.cells import add_options
from sim2gp.runs.executors import cores
from sim2gp.studies.claims import bootstrap_interval
from sim2gp.studies.study import run_cells
from sim2gp.studies.swingup import (
    Cell,
    best_seen,
    first_at,
    median_episode,
    scores_of,
)

LEARNERS = ("SIM2GP", "NLM", "RES", "FS", "RES-FS", "SIM2GP with the term")
CONDITIONS = ("nominal", "mismatch")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--every", type=int, default=50)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("results/within_episode"))
    add_options(parser)
    arguments = parser.parse_args()
    rows = {
        (condition, learner, every): [
            Cell("furuta", condition, learner, seed, arguments.episodes, every)
            for seed in range(arguments.seeds)
        ]
        for learner in LEARNERS
        for condition in CONDITIONS
        for every in (None, arguments.every)
    }
    values, details = run_cells(
        rows,
        arguments.out,
        workers=arguments.workers,
        progress=Progress(),
        old=arguments.old,
    )
    table = scores_of(rows, values)
    text = "\n".join(_lines(table, arguments.every))
    print(text)
    arguments.out.mkdir(parents=True, exist_ok=True)
    (arguments.out / "table.txt").write_text(text + "\n")
    plain = {
        f"{c}, {learner}, {every or 'episode'}": score.tolist()
        for (c, learner, every), score in table.items()
    }
    about = {name: details[name] for name in ("source", "cells_of_other_source")}
    summary = {"command": " ".join(["python", *sys.argv]), **about, "scores": plain}
    (arguments.out / "scores.json").write_text(json.dumps(summary, indent=1) + "\n")


def _lines(table: dict, every: int) -> list[str]:
    """A row for each learner: median scores, episodes to 95 %, paired difference."""
    rng = np.random.default_rng(0)
    E = next(iter(table.values())).shape[1]
    out = [f"median best score after episodes 1 to {E}, and episodes to 95 %"]
    for condition in CONDITIONS:
        out += ["", f"furuta, {condition}"]
        for learner in LEARNERS:
            early = []
            for how in (None, every):
                score = table[condition, learner, how]
                best = best_seen(score)
                early.append(best.mean(axis=1))
                soon = median_episode(first_at(score, SOLVED))
                name = "between" if how is None else f"every {how}"
                curve = " ".join(f"{x:5.2f}" for x in np.median(best, axis=0))
                out.append(f"{learner:21s} {name:9s} {curve}   {soon:4g}")
            difference = early[1] - early[0]
            low, high = bootstrap_interval(difference, rng)
            out.append(
                f"{'':21s} difference of the mean {difference.mean():+.3f} "
                f"[{low:+.3f}, {high:+.3f}]"
            )
    return out


if __name__ == "__main__":
    main()
