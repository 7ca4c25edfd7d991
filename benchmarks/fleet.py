"""Do intervals of a fleet hold? Twenty arms of one kind, which differ in two of four.

    python benchmarks/fleet.py [--fleets N] [--workers N] [--out DIR]
        [--refresh | --keep-old]

Hidden two-link arms (`interval_arms.py`), three seconds of each. In virtual units a
kind is drawn from N(0, 1), where the prior's sd is 1.5; dampings of its arms differ by
sd of .3 and .6, masses not at all (an interval of a spread is above zero: its upper end
is reported). Coverage of nominal 95 % (with its Clopper-Pearson
interval) of the kind, of each arm, of an arm without logs, and of the spreads; widths
of an arm's interval over that of its own fit alone. A cell is a fleet.
"""

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from coverage95 import Z, binomial_interval
from interval_arms import (
    CONDITIONS,
    NAMES,
    NOISE,
    Recordings,
    motion_of,
    multisine,
    physical,
)
from sim2gp.commands.fleet import fit_machines
from sim2gp.inference.gaussian import Gaussian
from sim2gp.project.in_memory import project_and_logs
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import AbstractCell, Values, compute_cells
from sim2gp.runs.cells import Cells, add_options
from sim2gp.runs.executors import Processes, cores
from sim2gp.systems import UniformRodArm
from sim2gp.types import in_float64

ARMS, SECONDS = 20, 3.0
SPREAD = np.asarray([0.0, 0.3, 0.0, 0.6])  # of `NAMES`


@dataclass(frozen=True)
class FleetCell(AbstractCell):
    """A kind, its arms and one more."""

    seed: int

    @property
    def name(self) -> str:
        return f"fleet_{self.seed}"

    @property
    def arguments(self) -> Values:
        return {"seed": self.seed, "arms": ARMS, "seconds": SECONDS}

    @in_float64
    def compute(self, needed: Values | None) -> Values:
        """Whether each interval holds; widths over those alone."""
        del needed
        rng = np.random.default_rng([33, self.seed])
        kind = rng.standard_normal(len(NAMES))
        arms = kind + SPREAD * rng.standard_normal((ARMS + 1, len(NAMES)))
        data, system = recorded(arms[:ARMS], rng), UniformRodArm()
        project, logs = project_and_logs(system, [data.log(r) for r in range(ARMS)])
        machines = {f"arm{r:02d}": (log,) for r, log in enumerate(logs)}
        quiet = Progress(quiet=True)
        used, _, fleet, alone, moved = fit_machines(project, machines, progress=quiet)
        low, high = np.quantile(fleet.spread, (0.025, 0.975), axis=0)
        pairs = zip(fleet.machines, arms, strict=False)
        widths = [
            np.asarray(a.sd()) / np.asarray(b.sd())
            for a, b in zip(fleet.machines, alone, strict=True)
        ]
        return {
            "kind": holds(fleet.kind, kind),
            "arms": [holds(*pair) for pair in pairs],
            "another": holds(fleet.another, arms[ARMS]),
            "spread": ((low <= SPREAD) & (high >= SPREAD)).tolist(),
            "spread_high": high.tolist(),
            "widths": np.median(widths, axis=0).tolist(),
            "window": used.window,
            "agreement": fleet.agreement,
            "moved": moved,
        }


def holds(known: Gaussian, truth: np.ndarray) -> list[bool]:
    """Whether the 95 % interval of each parameter has its true value."""
    away = np.abs(np.asarray(known.mean - jnp.asarray(truth)))
    return [bool(x) for x in away <= Z * np.asarray(known.sd())]


def recorded(virtual: np.ndarray, rng: np.random.Generator) -> Recordings:
    """Three seconds of each arm, under torques of its own."""
    torque = multisine(rng, SECONDS, len(virtual))
    angles = motion_of(physical(virtual), torque, CONDITIONS["white"])[..., :2]
    noise = NOISE * rng.standard_normal(angles.shape)
    return Recordings(virtual, torque, angles + noise)


def share(held: Any) -> dict[str, dict[str, float]]:
    """Of each parameter, with the interval of Clopper and Pearson."""
    held = np.asarray(held).reshape(-1, len(NAMES))
    n, out = len(held), {}
    for j, name in enumerate(NAMES):
        k = int(held[:, j].sum())
        low, high = binomial_interval(k, n)
        out[name] = {"share": k / n, "low": low, "high": high, "of": n}
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fleets", type=int, default=20)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("runs/fleet"))
    add_options(parser)
    asked = parser.parse_args()
    cells = [FleetCell(seed) for seed in range(asked.fleets)]
    store = Cells(asked.out, __file__, asked.old)
    with Progress().task("fleets", len(cells)) as task:
        values = compute_cells(cells, store, Processes(asked.workers), task)
    each = [values[cell] for cell in cells]
    summary: dict[str, Any] = {
        name: share([x[name] for x in each])
        for name in ("kind", "arms", "another", "spread")
    }
    widths = np.median([x["widths"] for x in each], axis=0)
    summary["widths"] = dict(zip(NAMES, widths.tolist(), strict=True))
    for j, name in enumerate(NAMES):
        if not SPREAD[j]:
            del summary["spread"][name]
    high = np.median([x["spread_high"] for x in each], axis=0)
    summary["spread_high"] = dict(zip(NAMES, high.tolist(), strict=True))
    summary["true_spread"] = dict(zip(NAMES, SPREAD.tolist(), strict=True))
    lengths, counts = np.unique([x["window"] for x in each], return_counts=True)
    summary["windows"] = dict(zip(map(str, lengths), counts.tolist(), strict=True))
    summary["agreement"] = sorted(x["agreement"] for x in each)
    summary["moved"] = sorted(x["moved"][-1] for x in each)
    summary["rounds"] = sorted(1 + len(x["moved"]) for x in each)
    for name in ("kind", "arms", "another", "spread"):
        words = [f"{n} {x['share']:.3f}" for n, x in summary[name].items()]
        print(f"{name:8}", "  ".join(words))
    print("widths  ", summary["widths"])
    asked.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(
        summary | {"fleets": asked.fleets, "arms_of_each": ARMS}, indent=1
    )
    (asked.out / "summary.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
