"""The section of a report that shows an experiment before it is made."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.report import svg
from sim2gp.report.markup import Raw, cards, paragraph, section
from sim2gp.report.parameters import Arrays, Summary

_SIZE = 420.0, 190.0


def experiment(summary: Summary, arrays: Arrays) -> Raw:
    """Commands, and the states they should lead to, with the draws' 5 % and 95 %."""
    if "design/time" not in arrays:
        return Raw("")
    t = np.asarray(arrays["design/time"], float)
    units: Mapping[str, Any] = summary.get("units") or {}
    commands = [
        _chart(name, units, t[:-1], np.asarray(arrays[f"design/command/{name}"]))
        for name in _names(arrays, "design/command/")
    ]
    states = [
        _chart(
            name,
            units,
            t,
            np.asarray(arrays[f"design/state/{name}"]),
            np.asarray(arrays[f"design/low/{name}"]),
            np.asarray(arrays[f"design/high/{name}"]),
        )
        for name in _names(arrays, "design/state/")
    ]
    share = summary.get("violations")
    checked = summary.get("draws_checked")
    kept = (
        f"{100.0 * float(share):.1f} % of {checked} machines drawn from the belief "
        "leave a limit of position or velocity; the commands keep theirs exactly."
        if isinstance(share, float)
        else ""
    )
    return section(
        "experiment",
        "The experiment",
        paragraph(kept) if kept else "",
        Raw("<h3>Commands</h3>\n"),
        cards(commands, "wide"),
        Raw("<h3>Expected motion</h3>\n"),
        cards(states, "wide"),
        paragraph("Shades hold nine in ten of the machines drawn.", "soft"),
    )


def _names(arrays: Arrays, prefix: str) -> list[str]:
    return [key.removeprefix(prefix) for key in arrays if key.startswith(prefix)]


def _chart(
    name: str,
    units: Mapping[str, Any],
    t: np.ndarray,
    middle: np.ndarray,
    low: np.ndarray | None = None,
    high: np.ndarray | None = None,
) -> str:
    edges = [x for x in (low, high) if x is not None]
    axes = svg.Axes(
        (float(t[0]), float(t[-1])), svg.span(middle, *edges), *_SIZE, x_label="s"
    )
    marks = []
    if low is not None and high is not None:
        marks.append(svg.band(axes, t, low, high, "c1"))
    marks.append(svg.line(axes, t, middle, "c1"))
    return svg.chart(axes, marks, title=name, unit=str(units.get(name, "")))
