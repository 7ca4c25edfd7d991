"""Episodes of every learner of figures 2 to 5, frozen: returns, and errors of a test.

Ten seeds of quick cells: fewer plans and less training than in the figures. Record what
is not recorded yet with ``python tests/frozen/episodes.py`` (an hour on a core).
"""

import json
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from frozen.cases import VALUES
from sim2gp.runs.cell_work import run_cell
from sim2gp.studies import exploring, swingup
from sim2gp.studies.learners import METHODS

RECORD = VALUES / "episodes.json"
SEEDS = range(10)
#: Machine, condition, learner, planner, episodes: figures 2, 4 (SAC) and 5 (Auto).
ACTING = [
    *(("furuta", "mismatch", name, "mpc", 2) for name in METHODS),
    ("cartpole", "nominal", "SIM2GP", "mpc", 2),
    ("furuta", "nominal", "SIM2GP", "sac", 2),
]
#: Figure 3: explorers, judged by the error of their predictions.
EXPLORING = [("cartpole", "nominal", name, 1) for name in ("SIM2GP", "RES-FS")]


def label(*words: Any) -> str:
    """The name of one learner's row."""
    return " ".join(map(str, words))


def rows(wanted: Callable[[str], bool]) -> Iterator[tuple[str, list[list[float]]]]:
    """Numbers of each learner that is wanted, a list per seed: returns, or errors."""
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        for machine, condition, method, planning, episodes in ACTING:
            if not wanted(label(machine, condition, method, planning)):
                continue
            found = [
                run_cell(
                    swingup.Cell(
                        machine, condition, method, seed, episodes, None, True, planning
                    ),
                    out,
                )["returns"]
                for seed in SEEDS
            ]
            yield label(machine, condition, method, planning), found
        for machine, condition, method, episodes in EXPLORING:
            if not wanted(label(machine, condition, method, "exploring")):
                continue
            found = [
                run_cell(
                    exploring.Cell(machine, condition, method, seed, episodes, True),
                    out / "exploring",
                )["rmse"]
                for seed in SEEDS
            ]
            yield label(machine, condition, method, "exploring"), found


def main() -> None:
    """Record the rows that are not recorded yet."""
    record = json.loads(RECORD.read_text()) if RECORD.exists() else {}
    for name, found in rows(lambda name: name not in record):
        print(name, found, flush=True)
        record[name] = found
        RECORD.write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    main()
