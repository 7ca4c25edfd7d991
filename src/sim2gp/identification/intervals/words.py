"""Which intervals the parameters of a run have, and what forces they allow for."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.identification.intervals import scatter as intervals
from sim2gp.identification.intervals.scatter import NOTHING, CorrectedFit
from sim2gp.identification.missing_physics.curves import Curve
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
        "missing": honest.missing if honest.forces else None,
        "allowed_for": {name: honest.each[name] for name in honest.forces},
        "forces": {c.name: _force_entry(c, honest.each) for c in honest.found},
    }


def force_arrays(honest: CorrectedFit) -> dict[str, np.ndarray]:
    """The forces that are probable: ``forces/NAME``, rows of variable, mean and sd."""
    return {f"forces/{c.name}": np.stack([c.at, c.mean, c.sd]) for c in honest.found}


def _force_entry(curve: Curve, each: Mapping[str, float]) -> dict[str, Any]:
    mean, sd = curve.largest
    return {
        "where": curve.where,
        "of": curve.of,
        "unit": curve.unit,
        "of_unit": curve.of_unit,
        "probability": max(each.get(kind, 0.0) for kind in curve.kinds),
        "mean": mean,
        "sd": sd,
    }


def missing_forces_table(told: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What the simulator may lack, clearest first, where something is probable."""
    if not told["forces"] or told["missing"] <= NOTHING:
        return []

    def clear(entry: Mapping[str, Any]) -> float:
        return abs(entry["mean"]) / entry["sd"] if entry["sd"] > 0.0 else 0.0

    found = sorted(told["forces"].values(), key=lambda entry: -clear(entry))
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
