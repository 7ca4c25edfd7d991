"""Which forces are found, and how soon: scores by episode, on seeds of their own.

    python benchmarks/missing_forces.py [--machine M] [--settings S...]
        [--learners L...] [--seeds N...] [--episodes N] [--every STEPS] [--out FILE]

Each setting is an effect of the mismatch map with its strength ("spring strong"), or
``nominal`` or ``mismatch`` of figure 2. Scores are those of the study's own cells.
"""

import argparse
import json
import sys
from pathlib import Path

from sim2gp.studies.learners import WITH_TERM
from sim2gp.studies.swingup import Cell, learner_cell, oracle_cell, reference, scores

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
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = []
    for setting in asked.settings:
        for seed in asked.seeds:
            about = asked.machine, setting
            first = Cell(*about, "SIM2GP", seed, asked.episodes)
            oracle = oracle_cell(reference(first))
            for learner in asked.learners:
                cell = Cell(*about, learner, seed, asked.episodes, asked.every)
                found = learner_cell(cell, int(oracle["redrawn"]))
                each = scores([found], [oracle], asked.episodes)[0]
                row = {
                    "setting": setting,
                    "learner": learner,
                    "seed": seed,
                    "scores": [round(float(x), 3) for x in each],
                    "seconds": round(found["seconds"], 1),
                    "failure": found["failure"],
                }
                rows.append(row)
                told = " ".join(f"{x:5.2f}" for x in each)
                print(f"{setting:20} {learner:20} {seed} {told}", flush=True)
    if asked.out is not None:
        command = " ".join(["python", *sys.argv])
        text = json.dumps({"command": command, "rows": rows}, indent=1)
        asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
