"""The sections of a report that say what is known about the parameters."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from sim2gp.reports import densities, svg
from sim2gp.reports.numbers import (
    MISSING,
    format_interval,
    format_number,
    is_number,
    plus_minus,
    unit_text,
)
from sim2gp.reports.tables import TableCell, make_table

Summary = Mapping[str, Any]
Arrays = Mapping[str, np.ndarray]
#: What the template needs of a section; None where the run has nothing for it.
Section = dict[str, Any] | None

#: What each verdict of contracts.md means, and how serious it is.
VERDICTS = {
    "identified": ("good", "the data determine it"),
    "weak": ("warn", "the data narrow it, but not sharply"),
    "traded_off": ("warn", "only a combination with others is determined"),
    "prior_dominated": ("warn", "mostly what was assumed before the data"),
    "at_bound": ("bad", "pressed against its range: widen it or doubt the model"),
    "dead": ("bad", "has no effect on these data"),
}


def verdict_chip(verdict: object) -> tuple[str, str]:
    """The verdict's tone and its words."""
    tone, _ = VERDICTS.get(str(verdict), ("warn", ""))
    return tone, str(verdict or MISSING).replace("_", " ")


def _remaining(entry: Mapping[str, Any]) -> TableCell:
    """How much of the prior's spread is left, as a bar and a percentage."""
    sd, before = entry.get("sd"), entry.get("prior_sd")
    if not (is_number(sd) and is_number(before)) or not float(before) > 0:  # type: ignore[arg-type]
        return TableCell(MISSING)
    share = float(sd) / float(before)  # type: ignore[arg-type]
    text = (
        f"{format_number(100 * share, 2)} %" if share < 0.1 else f"{100 * share:.0f} %"
    )
    return TableCell(text, share=f"{100 * min(share, 1.0):.0f}%")


def _interval(entry: Mapping[str, Any]) -> TableCell:
    """The run's interval; below it the plain one, where that is another."""
    text, plain = (
        format_interval(entry.get("q025"), entry.get("q975")),
        entry.get("plain"),
    )
    if not isinstance(plain, Mapping):
        return TableCell(text)
    return TableCell(
        text, why=f"plain: {format_interval(plain.get('q025'), plain.get('q975'))}"
    )


def _parameter_row(name: str, entry: Mapping[str, Any], truth: bool) -> list[object]:
    verdict = entry.get("verdict")
    why = entry.get("note") or VERDICTS.get(str(verdict), ("", ""))[1]
    if verdict == "identified":  # its note says by how much, as "spread left" does
        why = VERDICTS["identified"][1]
    row: list[object] = [
        TableCell(name=name, why=entry.get("meaning") or ""),
        unit_text(entry.get("unit")) or "1",
        plus_minus(entry.get("prior_mean"), entry.get("prior_sd")),
        plus_minus(entry.get("mean"), entry.get("sd")),
        _interval(entry),
        _remaining(entry),
    ]
    if truth:
        row.append(format_number(entry.get("truth"), 4))
    return [*row, TableCell(chip=verdict_chip(verdict), why=why)]


def parameter_section(summary: Summary) -> Section:
    """Prior, posterior and verdict of every parameter."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    if not entries:
        return None
    truth = any(is_number(entry.get("truth")) for entry in entries.values())
    columns = ["parameter", "unit", "prior", "posterior", "95 % interval"]
    columns += ["spread left", *(["truth"] if truth else []), "verdict"]
    rows = [_parameter_row(name, entry, truth) for name, entry in entries.items()]
    # Which intervals these are; how long windows are; what --check and --nuts found.
    about = [summary.get(key) for key in ("intervals", "window", "check", "nuts")]
    return {
        "said": [x.get("text") for x in about if isinstance(x, Mapping)],
        "table": make_table(columns, rows, words=(0, 1, len(columns) - 1), cards=True),
    }


def _area(axes: svg.Axes, draws: np.ndarray, axis: densities.View, css: str) -> str:
    x, y = densities.curve(draws, axis)
    px, py = axes.px(x), axes.py(y)
    floor = float(axes.py(0.0))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px, py, strict=True))
    return (
        f'<polygon class="area {css}" points="{px[0]:.1f},{floor:.1f} {points} '
        f'{px[-1]:.1f},{floor:.1f}"/>'
    )


def _density_chart(
    name: str,
    entry: Mapping[str, Any],
    prior: np.ndarray | None,
    posterior: np.ndarray,
) -> Section:
    """One parameter before and after the data."""
    truth = float(entry["truth"]) if is_number(entry.get("truth")) else None
    clouds = [posterior] if prior is None else [prior, posterior]
    axis = densities.view(clouds, entry.get("low"), entry.get("high"), truth)
    if axis is None:
        return None
    axes = svg.Axes(
        (axis.low, axis.high), (0.0, 1.12), height=150.0, log_x=axis.log, y_labels=False
    )
    marks = [] if prior is None else [_area(axes, prior, axis, "quiet")]
    marks.append(_area(axes, posterior, axis, "c0"))
    if truth is not None:
        marks.append(svg.upright(axes, truth, "truth"))
    caption = plus_minus(entry.get("mean"), entry.get("sd"))
    if truth is not None and is_number(entry.get("sd")) and float(entry["sd"]) > 0:
        away = (float(entry["mean"]) - truth) / float(entry["sd"])
        caption += f"; truth {format_number(truth, 4)}, {abs(away):.1f} sd away"
    before = plus_minus(entry.get("prior_mean"), entry.get("prior_sd"))
    said = "" if before == MISSING else f"{before} before the data, "
    said += "a curve" if caption == MISSING else f"{caption} after the data"
    unit = unit_text(entry.get("unit"))
    return {
        "drawing": svg.chart(axes, marks, title=name, said=said, unit=unit),
        "caption": caption,
        "chip": verdict_chip(entry["verdict"]) if entry.get("verdict") else None,
    }


def parameter_densities(summary: Summary, arrays: Arrays) -> Section:
    """A drawing per parameter: the prior, the posterior, the truth where known."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    samples = arrays.get("parameters/samples")
    if samples is None or not entries:
        return None
    before = arrays.get("parameters/prior_samples")
    drawn = [
        _density_chart(
            name, entry, None if before is None else before[:, i], samples[:, i]
        )
        for i, (name, entry) in enumerate(entries.items())
    ]
    keys = [] if before is None else [("quiet", "prior")]
    keys.append(("c0", "posterior"))
    if any(is_number(entry.get("truth")) for entry in entries.values()):
        keys.append(("truth", "truth"))
    return {"legend": keys, "drawn": [each for each in drawn if each]}


def _square(x: float, y: float, cell: float, r: float) -> str:
    """One correlation: a square whose colour is its sign, whose depth its size."""
    tone = "plus" if r > 0 else "minus"
    text = f"{100 * r:.0f}".replace("-0", "0").replace("-", "−")
    number_in = (
        f'<text class="in" x="{x + cell / 2 - 1:.1f}" y="{y + cell / 2 + 3:.1f}" '
        f'text-anchor="middle">{text}</text>'
        if cell > 30
        else ""
    )
    return (
        f'<rect class="cell {tone}" x="{x:.1f}" y="{y:.1f}" width="{cell - 2:.1f}" '
        f'height="{cell - 2:.1f}" rx="3" fill-opacity="{0.75 * min(abs(r), 1.0):.2f}"/>'
        f"{number_in}"
    )


def _matrix(names: list[str], correlation: np.ndarray) -> Markup:
    """The correlations as coloured squares with their numbers in per cent."""
    count = len(names)
    cell = 34.0 if count <= 14 else 20.0
    side = 12.0 + 7.0 * max(len(name) for name in names)
    width = side + cell * count + 4
    # The names above the columns lean by 45 degrees and need room on both sides.
    top = 14.0 + 0.72 * (side - 12.0)
    width += 0.72 * (side - 12.0)
    parts = []
    for i, name in enumerate(names):
        x, y = side + cell * i, top + cell * (i - 1)
        if i > 0:
            parts.append(
                f'<text x="{side - 8:.1f}" y="{y + cell / 2 + 4:.1f}" '
                f'text-anchor="end">{escape(name)}</text>'
            )
        if i < count - 1:
            parts.append(
                f'<text transform="translate({x + cell / 2:.1f} {top - 6:.1f}) '
                f'rotate(-45)">{escape(name)}</text>'
            )
        for j in range(i):
            r = float(correlation[i, j])
            if np.isfinite(r):
                parts.append(_square(side + cell * j, y, cell, r))
    height = top + cell * (count - 1) + 4
    return Markup(
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'style="max-width:{width:.0f}px;min-width:{min(width, 340):.0f}px" '
        f'aria-label="{escape(_strongest(names, correlation))}">{"".join(parts)}</svg>'
    )


def _strongest(names: list[str], correlation: np.ndarray) -> str:
    """The largest correlation in words."""
    below = np.tril(np.isfinite(correlation), -1)
    if not below.any():
        return "posterior correlations: none is known"
    off = np.where(below, np.abs(correlation), -1.0)  # what is not known never wins
    i, j = np.unravel_index(int(np.argmax(off)), off.shape)
    r = format_number(float(correlation[i, j]), 2)
    return f"posterior correlations: the strongest is {r}, of {names[i]} and {names[j]}"


def correlations(summary: Summary, arrays: Arrays) -> Section:
    """The posterior's correlation matrix."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    matrix = arrays.get("parameters/correlation")
    if matrix is None or matrix.shape != (len(entries),) * 2 or len(entries) < 2:
        return None
    return {"drawing": _matrix(list(entries), matrix)}


def _direction_row(entry: Mapping[str, Any]) -> dict[str, Any]:
    text, combination = entry.get("text") or "", entry.get("combination")
    repeated, nats = str(combination) in str(text), entry.get("information")
    return {
        "text": text,
        "combination": None if repeated else combination,
        "nats": format_number(nats) if is_number(nats) else None,
        "flat": bool(entry.get("flat")),
    }


def directions_section(summary: Summary) -> Section:
    """Which combinations of parameters the data fix, and which they leave open."""
    entries = summary.get("directions") or []
    base = summary.get("base_parameters") or []
    if not entries and not base:
        return None
    rows = [
        [
            TableCell(name=unit_text(entry.get("text"))),
            plus_minus(entry.get("value"), entry.get("sd")),
            unit_text(entry.get("unit")) or "1",
            TableCell(chip=verdict_chip(entry.get("verdict"))),
        ]
        for entry in base
    ]
    columns = ["combination", "value", "unit", "verdict"]
    return {
        "found": [_direction_row(entry) for entry in entries],
        "base": make_table(columns, rows, words=(0, 2, 3), cards=True),
    }
