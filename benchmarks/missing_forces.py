"""Which forces are found, and how soon: scores by episode, on seeds of their own.

    python benchmarks/missing_forces.py [--machine M] [--settings S...]
        [--learners L...] [--seeds N...] [--episodes N] [--every STEPS] [--quick]
        [--workers N] [--out DIR] [--refresh | --keep-old]

Each setting is an effect of the mismatch map with its strength ("spring strong"),
``nominal`` or ``mismatch`` of figure 2, or physics that no force of one variable is;
learners are those of the studies, and the controls (`controls.py`). A first episode in
which the pole stays up for the last second has solved the task, however long that took.
Cells are stored next to ``--out`` and not computed again; on a GPU those of a learner
are one program.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from controls import ControlCell
from sim2gp.planning.tasks import SOLVED
from sim2gp.runs import Progress
from sim2gp.runs.cells import add_options
from sim2gp.runs.executors import cores
from sim2gp.studies.learners import WITH_TERM
from sim2gp.studies.study import run_cells
from sim2gp.studies.swingup import best_seen, scores_of

LEARNERS = ("MissingForces", WITH_TERM, "SIM2GP")
SEEDS = (100, 101, 102)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--machine", default="furuta")
    parser.add_argument("--settings", nargs="+", default=["nominal", "mismatch"])
    parser.add_argument("--learners", nargs="+", default=LEARNERS)
    parser.add_argument("--seeds", nargs="+", type=int, default=SEEDS)
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--every", type=int)
    parser.add_argument(
        "--quick", action="store_true", help="fewer plans, less training"
    )
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("runs/missing_forces"))
    add_options(parser)
    asked = parser.parse_args()
    rows = {
        (asked.machine, setting, learner): [
            ControlCell(
                asked.machine,
                setting,
                learner,
                seed,
                asked.episodes,
                asked.every,
                asked.quick,
            )
            for seed in asked.seeds
        ]
        for setting in asked.settings
        for learner in asked.learners
    }
    values, about = run_cells(
        rows, asked.out, workers=asked.workers, progress=Progress(), old=asked.old
    )
    found = []
    for (_, setting, learner), score in scores_of(rows, values).items():
        best = best_seen(score)
        middle = np.median(best, axis=0)
        solved = int(np.sum(best[:, min(1, asked.episodes - 1)] >= SOLVED))
        cells = [values[cell] for cell in rows[asked.machine, setting, learner]]
        first = sum(cell["reached"][:1] == [True] for cell in cells)
        found.append(
            {
                "setting": setting,
                "learner": learner,
                "solved_in_two": solved,
                "up_in_first": first,
                "median_best": [round(float(x), 3) for x in middle],
                "scores": np.round(score, 3).tolist(),
            }
        )
        each = " ".join(f"{x:5.2f}" for x in middle)
        print(
            f"{setting:20} {learner:20} {solved}/{len(score)} {each} "
            f"up in the first: {first}",
            flush=True,
        )
    asked.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"seeds": list(asked.seeds), "rows": found, **about}, indent=1)
    (asked.out / "summary.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
