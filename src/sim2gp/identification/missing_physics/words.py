"""What `explain` found, in the words of a control engineer."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from sim2gp.identification.misfit.tests import Misfit
from sim2gp.identification.missing_physics.explain import Explanation
from sim2gp.identification.missing_physics.search import (
    FittedCandidate,
    ScoredCandidate,
)
from sim2gp.identification.words import digits, join_names, quantity
from sim2gp.systems.base import AbstractSystem

NO_NAME = "none of these"


def candidate_rows(found: Explanation) -> list[dict[str, Any]]:
    """One entry for each candidate, by falling evidence; aliases last.

    ``evidence_gain`` is None where the data cannot decide; ``value`` and ``sd`` are
    those of a fit (``fitted``), else of a linearisation, and None without.
    """
    fitted = {r.scored.candidate.name: r for r in found.search.refitted}
    rows = [
        _candidate_row(s, fitted.get(s.candidate.name), found)
        for s in found.search.scored
    ]

    def order(row: Mapping[str, Any]) -> tuple[bool, bool, float]:
        gain = row["evidence_gain"]
        return gain is None, not row["fitted"], -(gain or 0.0)

    return sorted(rows, key=order)


def _candidate_row(
    s: ScoredCandidate, refit: FittedCandidate | None, found: Explanation
) -> dict[str, Any]:
    where, what = s.candidate.name.rsplit(".", 1)
    table, name = s.system.parameters, s.candidate.name
    j = table.names.index(name)
    gain: float | None = s.gain if refit is None else refit.gain
    constant = table[name]
    value: float | None = constant.constrain(
        constant.mean + constant.sd * float(s.starts[0, j])
    )
    if s.alias or not math.isfinite(s.gain):
        gain = value = None
    elif refit is not None:
        value = refit.value
    return {
        "effect": what,
        "where": where,
        "parameter": name,
        "meaning": s.candidate.effect.meaning,
        "unit": constant.unit,
        "evidence_gain": gain,
        "value": value,
        "sd": None if refit is None else refit.sd,
        "fitted": refit is not None,
        "like": list(s.partners) if s.alias else [],
        "verdict": _verdict(s, refit, found),
    }


def _verdict(
    s: ScoredCandidate, refit: FittedCandidate | None, found: Explanation
) -> str:
    best = found.search.best
    if s.alias:
        same = join_names(s.partners) if s.partners else "no motion in these data"
        return f"not distinguishable from {same}"
    if s.candidate.name in found.search.failed:
        return "no fit"
    if refit is None:
        return "not fitted"
    if refit is best:
        return "missing" if found.effect else "best, but not enough"
    if refit in found.search.tied:
        return "not separable from the best"
    if refit.gain > found.search.threshold:
        return "behind the best" if refit.physical else "impossible sign"
    return "no evidence"


def missing_physics_headline(found: Explanation) -> str:
    """The answer in one or two sentences."""
    best, tests = found.search.best, found.best
    reasons = _reasons(tests)
    if found.answer == "nothing missing":
        top = found.search.refitted[0] if found.search.refitted else None
        text = "Nothing is missing that these data could show: no effect of the library"
        text += f" is worth the {found.search.threshold:.1f} nats that it would take"
        if top is not None:
            text += f" (the best, {top.scored.candidate.name}, {top.gain:+.1f})"
        return text + ", and what the fit leaves over looks like noise."
    if best is None:
        return (
            "None of these: no effect of the library is worth its parameter, and yet "
            f"the simulator does not fit. {reasons}"
        )
    said = _describe_candidate(best)
    if found.answer == "none of these":
        return (
            f"None of these. The best effect of the library is {said}, but with it "
            f"the simulator still does not fit. {reasons}"
        )
    text = f"Missing: {said}. With it what is left over looks like noise."
    if found.search.tied:
        names = join_names([r.scored.candidate.name for r in found.search.tied])
        text += f" These data cannot separate it from {names}."
    return text


def force_rows(found: Explanation, system: AbstractSystem) -> dict[str, dict[str, Any]]:
    """The entry "forces" of a summary: each force that is drawn, with its name."""
    names, best = found.names(system), found.search.best
    rows: dict[str, dict[str, Any]] = {}
    for curve in found.drawn:
        name = names.get(curve.name)
        said = NO_NAME if name is None else name.text
        if found.effect and best is not None:
            said = _size_of(best)
        probability = found.forces.probability(curve)
        rows[curve.name] = curve.entry() | {"name": said, "probability": probability}
    return rows


def forces_text(forces: Mapping[str, Mapping[str, Any]]) -> str:
    """One sentence of the forces that were found where no effect is the answer."""
    if not forces:
        return ""
    each = [
        f"on {x['where']} by {x['of']} "
        f"({'of no known shape' if x['name'] == NO_NAME else x['name']})"
        for x in forces.values()
    ]
    return f" Forces were found {join_names(each)}."


def force_table(forces: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Forces where they are clearest, and their names."""
    if not forces:
        return []
    rows = [
        [
            x["where"],
            x["of"],
            f"{digits(x['mean'], 2)} ± {quantity(_two(x['sd']), x['unit'])}",
            x["name"],
        ]
        for x in forces.values()
    ]
    note = (
        "The size is where the force is clearest. A name is a shape of the library "
        "that lies within the 95 % band of the curve."
    )
    return [
        {
            "title": "Forces, as curves",
            "columns": ["on", "by", "size", "name"],
            "rows": rows,
            "note": note,
        }
    ]


def _size_of(best: FittedCandidate) -> str:
    candidate = best.scored.candidate
    unit = best.scored.system.parameters[candidate.name].unit
    size = f"{quantity(best.value, '')} ± {quantity(_two(best.sd), unit)}"
    return f"{candidate.effect.meaning} of {size}"


def _describe_candidate(best: FittedCandidate) -> str:
    candidate = best.scored.candidate
    unit = best.scored.system.parameters[candidate.name].unit
    size = f"{quantity(best.value, '')} ± {quantity(_two(best.sd), unit)}"
    text = f"{candidate.effect.meaning} ({candidate.name} = {size}, "
    text += f"{best.gain:.0f} nats of evidence"
    if best.inflation > 1.0:
        text += f", errors taken as correlated over {best.inflation:.0f} samples"
    return text + ")"


def _two(x: float) -> float:
    """Two digits are enough for a standard deviation."""
    return float(f"{x:.2g}")


def _reasons(tests: Misfit | None) -> str:
    if tests is None:
        return ""
    return " ".join(t.text for t in tests.tests.values() if t.alarm)


def candidate_table(
    found: Explanation, rows: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Candidates by evidence."""
    cells = [
        [
            row["parameter"],
            row["meaning"],
            "-" if row["evidence_gain"] is None else f"{row['evidence_gain']:+.1f}",
            _magnitude_text(row),
            row["verdict"],
        ]
        for row in rows
    ]
    return {
        "title": "Candidates, by evidence gained over the machine as it is",
        "columns": ["parameter", "what it is", "nats", "value", "verdict"],
        "rows": cells,
        "note": "Nats: the gain in log-likelihood, minus a price for one more "
        "parameter; 3 nats are 20 times more probable than without the effect. To be "
        f"named, an effect needs {found.search.threshold:.1f}. Fitted candidates "
        "first, then those that a linearisation ranked behind.",
    }


def _magnitude_text(row: Mapping[str, Any]) -> str:
    if row["value"] is None:
        return "-"
    if row["sd"] is None:
        return f"about {quantity(_two(row['value']), row['unit'])}"
    size = quantity(_two(row["sd"]), row["unit"])
    return f"{digits(row['value'], 3)} ± {size}"
