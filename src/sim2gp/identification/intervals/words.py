"""Which intervals the parameters of a run have, and which effects they allow for."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.identification.intervals import scatter as intervals
from sim2gp.identification.intervals.scatter import NOTHING, CorrectedFit
from sim2gp.identification.words import digits
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.registry import smooth_effects
from sim2gp.types import in_float64


@in_float64
def interval_entry(
    system: AbstractSystem,
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
        "missing": honest.missing if honest.effects else None,
        "allowed_for": _effects(system, honest),
    }


def _effects(system: AbstractSystem, honest: CorrectedFit) -> dict[str, dict[str, Any]]:
    if honest.lacking is None:
        return {}
    table = free_parts(system, smooth_effects(system)).parameters
    mean, sd = (np.asarray(x) for x in (honest.lacking.mean, honest.lacking.sd()))
    return {
        name: {
            "meaning": table[name].meaning,
            "unit": table[name].unit,
            "mean": float(mean[k]),
            "sd": float(sd[k]),
        }
        for k, name in enumerate(honest.effects)
    }


def missing_physics_table(told: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What the simulator may lack, clearest first, where something is probable."""
    if not told["allowed_for"] or told["missing"] <= NOTHING:
        return []

    def clear(entry: Mapping[str, Any]) -> float:
        return abs(entry["mean"]) / entry["sd"] if entry["sd"] > 0.0 else 0.0

    found = sorted(told["allowed_for"].items(), key=lambda x: -clear(x[1]))
    rows = [
        [
            name,
            entry["meaning"],
            f"{digits(entry['mean'], 2)} +- {digits(entry['sd'], 2)}",
            entry["unit"],
        ]
        for name, entry in found
    ]
    note = (
        "All at once, as the intervals of the parameters allow for them. Effects that "
        "act alike share what is missing, and are uncertain for it; sim2gp explain "
        "asks for the one that explains it alone."
    )
    return [
        {
            "title": "What the simulator may lack",
            "columns": ["effect", "meaning", "size", "unit"],
            "rows": rows,
            "note": note,
        }
    ]
