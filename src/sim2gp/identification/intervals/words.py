"""Which intervals the parameters of a run have, and what forces they allow for."""

import math
from collections.abc import Mapping
from typing import Any

from sim2gp.identification.intervals import scatter as intervals
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.identification.words import digits
from sim2gp.types import in_float64


@in_float64
def interval_entry(
    honest: CorrectedFit,
    parameters: Mapping[str, Mapping[str, Any]],
    windows: int,
) -> dict[str, Any]:
    """The entry "intervals" of a summary, given the entries of its parameters."""
    widened = [entry["widened"] or 1.0 for entry in parameters.values()]
    return {
        "which": "corrected" if honest.enough else "plain",
        "text": intervals.describe_intervals(honest, widened, windows),
        "why": intervals.explain_widening(honest, widened, windows),
        "pulls_times_white": math.sqrt(honest.inflation) if honest.enough else None,
        "windows_at_once": honest.lag,
        "freedom": honest.freedom,
        "missing": honest.missing if honest.kinds else None,
        "allowed_for": {name: honest.each[name] for name in honest.kinds},
    }


def force_entries(honest: CorrectedFit) -> dict[str, Any]:
    """The entry "forces" of a summary: those that are rather there than not."""
    each = honest.each
    return {
        c.name: c.entry() | {"probability": max(each.get(k, 0.0) for k in c.kinds)}
        for c in honest.found
    }


def missing_forces_table(honest: CorrectedFit) -> list[dict[str, Any]]:
    """What the simulator may lack, clearest first."""
    forces = force_entries(honest)
    if not forces:
        return []

    def clear(entry: Mapping[str, Any]) -> float:
        return abs(entry["mean"]) / entry["sd"] if entry["sd"] > 0.0 else 0.0

    found = sorted(forces.values(), key=lambda entry: -clear(entry))
    rows = [
        [
            entry["where"],
            entry["of"],
            f"{digits(entry['mean'], 2)} +- {digits(entry['sd'], 2)}",
            entry["unit"],
            f"{100.0 * entry['probability']:.0f} %",
        ]
        for entry in found
    ]
    note = (
        "All at once, as the intervals of the parameters allow for them; the size is "
        "where the force is clearest. sim2gp explain asks which effect by name it is."
    )
    return [
        {
            "title": "Forces that the simulator may lack",
            "columns": ["on", "by", "size", "unit", "probability"],
            "rows": rows,
            "note": note,
        }
    ]
