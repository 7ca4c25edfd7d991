"""The section of a report that shows an experiment before it is made."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.reports import svg
from sim2gp.reports.parameters import Arrays, Section, Summary

_SIZE = 420.0, 190.0
NEAR = 0.5  # of a chart's height: limits no farther from the motion are drawn


def experiment(summary: Summary, arrays: Arrays) -> Section:
    """Commands, and the states they should lead to, with the draws' 5 % and 95 %."""
    if "design/time" not in arrays:
        return None
    t = np.asarray(arrays["design/time"], float)
    units: Mapping[str, Any] = summary.get("units") or {}

    def drawn(name: str, t: np.ndarray, *kinds: str) -> str:
        values = [np.asarray(arrays[f"design/{kind}/{name}"]) for kind in kinds]
        box = np.asarray(arrays.get(f"design/limit/{name}", ()))
        return _chart(name, str(units.get(name, "")), t, values, box)

    commands = [
        drawn(name, t[:-1], "command")
        for name in _names_under(arrays, "design/command/")
    ]
    states = [
        drawn(name, t, "state", "low", "high")
        for name in _names_under(arrays, "design/state/")
    ]
    share = summary.get("violations")
    checked = summary.get("draws_checked")
    kept = (
        f"{100.0 * float(share):.1f} % of {checked} machines drawn from what is "
        "believed leave a limit of position or velocity; the commands keep theirs "
        "exactly."
        if isinstance(share, float)
        else ""
    )
    kept += _posterior_sentence(summary)
    return {"kept": kept, "commands": commands, "states": states}


def _posterior_sentence(summary: Summary) -> str:
    """Which of two posteriors was used where, and why they differ."""
    which, why = summary.get("posterior"), summary.get("why")
    return f" {which}. {why or ''}" if isinstance(which, str) else ""


def _names_under(arrays: Arrays, prefix: str) -> list[str]:
    return [key.removeprefix(prefix) for key in arrays if key.startswith(prefix)]


def _chart(
    name: str, unit: str, t: np.ndarray, values: list[np.ndarray], box: np.ndarray
) -> str:
    """A line, or one with its band; limits that it comes near to are drawn."""
    low, high = svg.span(*values)
    reach = NEAR * (high - low)
    near = box[(box > low - reach) & (box < high + reach)]
    axes = svg.Axes(
        (float(t[0]), float(t[-1])), svg.span(*values, near), *_SIZE, x_label="s"
    )
    marks = [svg.level(axes, float(x), "quiet", "limit") for x in near]
    if len(values) == 3:
        marks.append(svg.band(axes, t, values[1], values[2], "c1"))
    marks.append(svg.line(axes, t, values[0], "c1"))
    said = f"{svg.extent(values[0])}, time {svg.extent(t, 's')}"
    return svg.chart(axes, marks, title=name, said=said, unit=unit)
