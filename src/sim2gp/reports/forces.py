"""The section of a report that shows forces which the simulator lacks."""

import numpy as np

from sim2gp.reports import svg
from sim2gp.reports.parameters import Arrays, Section, Summary

_SIZE = 420.0, 190.0


def missing_forces(summary: Summary, arrays: Arrays) -> Section:
    """Each force against its variable, with its 95 % band."""
    known = summary.get("forces") or {}
    charts = []
    for name, about in known.items():
        if f"forces/{name}" not in arrays:
            continue
        at, mean, _, half = np.asarray(arrays[f"forces/{name}"], float)
        ends = mean - half, mean + half
        x = float(at[0]), float(at[-1])
        axes = svg.Axes(
            x, svg.span(*ends, np.zeros(1)), *_SIZE, x_label=about["of_unit"]
        )
        marks = [
            svg.level(axes, 0.0, "quiet", ""),
            svg.band(axes, at, *ends, "c1"),
            svg.line(axes, at, mean, "c1"),
        ]
        said = f"{svg.extent(mean)}, {about['of']} {svg.extent(at, about['of_unit'])}"
        title = f"on {about['where']}, by {about['of']}"
        charts.append(
            svg.chart(axes, marks, title=title, said=said, unit=about["unit"])
        )
    return {"charts": charts} if charts else None
