"""Which intervals the parameters of a run have, and what forces they allow for."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim2gp.identification.intervals.averaging import NOTHING
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.identification.words import digits
from sim2gp.types import in_float64

LIKE_WHITE = 1.3  # times as wide: small samples alone make so much of white noise
MUCH = 3.0  # times as wide: a summary says why, wherever it names the interval


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
        "text": describe_intervals(honest, widened, windows),
        "why": explain_widening(honest, widened, windows),
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


def describe_intervals(
    found: CorrectedFit, widened: Sequence[float], windows: int
) -> str:
    """Which intervals these are and why, in some sentences."""
    if not found.enough:
        return (
            f"Intervals count every sample as new: {windows} windows are too few to "
            "see whether errors are correlated in time, and of a real machine they are."
        )
    scatter, most = math.sqrt(found.inflation), max(widened, default=1.0)
    lacks = found.missing > NOTHING
    if most < LIKE_WHITE and not lacks:
        return (
            "Intervals were checked for errors that are correlated in time: those of "
            f"{windows} windows pull the parameters {digits(scatter, 2)} times as far "
            f"as white noise would, and intervals are at most {digits(most, 3)} times "
            f"those of independent samples. {_missing_physics_remark(found)}"
        )
    text = f"Intervals are {_times(widened)} times as wide as if every sample were new"
    if not lacks or scatter > LIKE_WHITE:
        text += f": {_coloured(found, windows)}"
    return f"{text}. {_missing_physics_remark(found)}"


def explain_widening(
    found: CorrectedFit, widened: Sequence[float], windows: int
) -> str | None:
    """In one sentence, where corrected and plain sd differ by more than `MUCH`.

    The reasons are those that the correction has: samples that repeat each other, and
    physics that is missing. None of them is a sum of the others.
    """
    if not found.enough or max(widened, default=1.0) <= MUCH:
        return None
    reasons = []
    if math.sqrt(found.inflation) > LIKE_WHITE:
        reasons.append(_coloured(found, windows))
    if found.missing > NOTHING:
        reasons.append(
            "the simulator is missing physics with a probability of "
            f"{_missing_percent(found)}, which the parameters make up for"
        )
    reason = ", and ".join(reasons) or "windows are few"
    return (
        f"The corrected intervals are {_times(widened)} times as wide as the plain "
        f"ones: {reason}."
    )


def _times(widened: Sequence[float]) -> str:
    ends = [digits(f(widened, default=1.0), 2) for f in (min, max)]
    return ends[0] if ends[0] == ends[1] else " to ".join(ends)


def _coloured(found: CorrectedFit, windows: int) -> str:
    return (
        f"the errors of {windows} windows are coloured and pull the parameters "
        f"{digits(math.sqrt(found.inflation), 2)} times as far as white noise would"
    )


def _missing_percent(found: CorrectedFit) -> str:
    if found.missing >= 0.995:
        return "more than 99 %"
    return (
        f"{100.0 * found.missing:.0f} %" if found.missing >= 0.005 else "less than 1 %"
    )


def _missing_physics_remark(found: CorrectedFit) -> str:
    """Whether physics that is missing is in the intervals."""
    if not found.kinds:
        return (
            "This covers errors that come and go, not physics that the model lacks "
            "(sim2gp explain)."
        )
    if found.missing > NOTHING:
        return (
            f"The model lacks physics with a probability of {_missing_percent(found)}: "
            "intervals allow for forces on its joints and changes of its inputs, and "
            "parameters lie where they would with them. sim2gp explain names them."
        )
    return (
        "Intervals allow for forces that the model may be missing, which has a "
        f"probability of {_missing_percent(found)}; they do not allow for other "
        "physics."
    )
