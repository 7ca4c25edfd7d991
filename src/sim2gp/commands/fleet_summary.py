"""What an identification of many machines says: of the kind, and of each machine."""

import math
from collections.abc import Mapping, Sequence
from statistics import NormalDist
from typing import Any

import numpy as np

from sim2gp.data.logs import Log, note_lines
from sim2gp.identification.fleet import Fleet
from sim2gp.identification.words import digits
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.project import Project
from sim2gp.types import in_float64

NORMAL95 = NormalDist().inv_cdf(0.975)
AGREE = 1.1  # R-hat of halves of the draws
MOVED = 0.5  # sd: a fleet that still moves so far is not settled


@in_float64
def fleet_summary(
    project: Project,
    machines: Mapping[str, Sequence[Log]],
    fleet: Fleet,
    moved: Sequence[float],
    window: Mapping[str, Any],
) -> dict[str, Any]:
    """Keys of summary.json; ``moved`` by each round after the first, in sd.

    ``window`` is the entry of how long windows are.
    """
    table = project.system.parameters
    entries = {
        p.name: _entry(p, j, fleet, list(machines)) for j, p in enumerate(table.free)
    }
    logs = [log for own in machines.values() for log in own]
    warnings = note_lines(logs)
    if fleet.agreement > AGREE:
        warnings.append(
            f"draws of the spreads have not settled (R-hat {fleet.agreement:.2f}): "
            "their intervals are rough"
        )
    if moved[-1] > MOVED:
        warnings.append(
            f"the last of {len(moved) + 1} rounds of fits has still moved a "
            f"parameter by {digits(moved[-1], 2)} sd: intervals are rough"
        )
    return {
        "command": "identify each",
        "title": f"{project.name}: {len(machines)} machines of a kind",
        "machines": list(machines),
        "logs": {name: len(own) for name, own in machines.items()},
        "kind": entries,
        "agreement": fleet.agreement,
        "moved": list(moved),
        "window": window,
        "warnings": warnings,
        "tables": [
            _kind_table(entries),
            _machine_table(entries, list(machines), window["text"]),
        ],
    }


def _entry(
    p: Parameter, j: int, fleet: Fleet, machines: Sequence[str]
) -> dict[str, Any]:
    """One parameter in its unit: of the kind, its spread, another one, each one."""

    def physical(x: Any) -> np.ndarray:
        return np.asarray(Parameters((p,)).constrain(np.asarray(x)[..., None]))[..., 0]

    def of(known: Gaussian) -> dict[str, float]:
        mean, sd = float(known.mean[j]), float(known.sd()[j])
        ends = mean + NORMAL95 * sd * np.asarray([-1.0, 0.0, 1.0])
        return dict(zip(("low", "value", "high"), physical(ends).tolist(), strict=True))

    middle, spread = float(fleet.kind.mean[j]), fleet.spread[:, j]
    half = 0.5 * (physical(middle + spread) - physical(middle - spread))
    low, value, high = np.quantile(half, (0.025, 0.5, 0.975)).tolist()
    return {
        "unit": p.unit,
        "kind": of(fleet.kind),
        "spread": {"low": low, "value": value, "high": high},
        "another": of(fleet.another),
        "machines": {
            name: of(known)
            for name, known in zip(machines, fleet.machines, strict=True)
        },
    }


def _in_words(x: Mapping[str, float], unit: str = "") -> str:
    """With so many digits that the ends differ in two."""
    half = 0.5 * abs(x["high"] - x["low"])
    large = max(abs(x["value"]), half, 1e-300)
    count = 2 + max(math.ceil(math.log10(large / half)), 0) if half > 0.0 else 3
    low, value, high = (digits(x[k], count) for k in ("low", "value", "high"))
    return f"{value} ({low} to {high}) {unit}".strip()


def _kind_table(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "title": "The kind: its middle, how much machines differ, and another machine",
        "columns": ["parameter", "kind", "machines differ by", "another machine"],
        "rows": [
            [name, *(_in_words(x[k], x["unit"]) for k in ("kind", "spread", "another"))]
            for name, x in entries.items()
        ],
        "note": "With 95 % intervals. Machines differ by one standard deviation; a "
        "machine without logs of its own is as the last column says.",
    }


def _machine_table(
    entries: Mapping[str, Mapping[str, Any]], machines: Sequence[str], note: str
) -> dict[str, Any]:
    heads = [f"{name}, {x['unit']}".removesuffix(", ") for name, x in entries.items()]
    return {
        "title": "Each machine, from its own logs and from those of the others",
        "columns": ["machine", *heads],
        "rows": [
            [one, *(_in_words(x["machines"][one]) for x in entries.values())]
            for one in machines
        ],
        "note": note,
    }
