"""What a fit with missing forces costs: the first one, a later one, and the plain fit.

    python benchmarks/first_fit.py [--episodes N] [--repeat N] [--earlier CHECKOUT]
        [--out FILE]

Both machines with a strong spring, strong dry friction, and nothing missing; the data
are an episode of the plain simulator's planner. A run has room for so many episodes.
Median seconds of compiled fits on one core, and their ratio to the plain fit's: of this
source, and of an earlier one in CHECKOUT.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from dataclasses import fields
from pathlib import Path
from typing import Any

import jax
import numpy as np

from plain_fit import seconds
from sim2gp.data.transitions import Transitions
from sim2gp.planning import MarkovObjective
from sim2gp.planning.loop import SamplingRun
from sim2gp.studies.learners import task_and_model
from sim2gp.studies.swingup import Cell

SETTINGS = ("nominal", "spring strong", "coulomb strong")
SEED = 300


def earlier_seconds(
    checkout: Path, machine: str, data: Transitions, repeat: int
) -> float:
    """Of the plain first fit to these rows, by another source."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "rows.npz")
        arrays = {f.name: getattr(data, f.name) for f in fields(data)}
        np.savez(file, **{k: x for k, x in arrays.items() if x is not None})
        script = Path(__file__).with_name("plain_fit.py")
        words = [sys.executable, str(script), str(file), machine, str(repeat)]
        path = {"PYTHONPATH": str(checkout / "src")}
        done = subprocess.run(
            words, env=os.environ | path, check=True, capture_output=True, text=True
        )
    return float(done.stdout)


def row(
    machine: str, setting: str, episodes: int, repeat: int, earlier: Path | None
) -> dict[str, Any]:
    """Of one machine and what it has."""
    key = jax.random.key(0)
    cell = Cell(machine, setting, "SIM2GP", SEED, episodes, quick=True)
    task, plain = task_and_model(cell, "SIM2GP", 0)
    objective = MarkovObjective(task.reward)
    run = SamplingRun(
        task, plain, cell.planner, lambda _: objective, episodes, jax.random.key(SEED)
    )
    run.next()
    _, wider = task_and_model(cell, "MissingForces", 0)
    belief = wider.fit(wider.init(key), run.data, key=key)
    found = {
        "plain": seconds(lambda: plain.fit(run.belief, run.data, key=key), repeat),
        "first": seconds(lambda: wider.fit(wider.init(key), run.data, key=key), repeat),
        "later": seconds(lambda: wider.fit(belief, run.data, key=key), repeat),
    }
    ratios = {f"{k}_ratio": found[k] / found["plain"] for k in ("first", "later")}
    if earlier is not None:
        found["earlier"] = earlier_seconds(earlier, machine, run.data, repeat)
        ratios["first_to_earlier"] = found["first"] / found["earlier"]
    return {"machine": machine, "setting": setting, **found, **ratios}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--earlier", type=Path)
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    rows = []
    for machine in ("furuta", "cartpole"):
        for setting in SETTINGS:
            how = asked.episodes, asked.repeat, asked.earlier
            rows.append(row(machine, setting, *how))
            print(json.dumps(rows[-1]), flush=True)
    medians = {
        name: float(np.median([r[name] for r in rows]))
        for name in rows[0]
        if isinstance(rows[0][name], float)
    }
    print(json.dumps(medians))
    if asked.out is not None:
        text = json.dumps({"rows": rows, "medians": medians}, indent=1)
        asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
