"""The sections of a report that tell what is known about the parameters."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sim2gp.reports import densities, svg
from sim2gp.reports.markup import (
    MISSING,
    Raw,
    cards,
    esc,
    interval,
    is_number,
    legend,
    listing,
    name_text,
    number,
    paragraph,
    plus_minus,
    section,
    table,
    unit_text,
)

Summary = Mapping[str, Any]
Arrays = Mapping[str, np.ndarray]

#: What each verdict of contracts.md means, and how serious it is.
VERDICTS = {
    "identified": ("good", "the data determine it"),
    "weak": ("warn", "the data narrow it, but not sharply"),
    "traded_off": ("warn", "only a combination with others is determined"),
    "prior_dominated": ("warn", "mostly what was assumed before the data"),
    "at_bound": ("bad", "pressed against its range: widen it or doubt the model"),
    "dead": ("bad", "has no effect on these data"),
}


def verdict_chip(verdict: object) -> Raw:
    """The verdict in its colour."""
    tone, _ = VERDICTS.get(str(verdict), ("warn", ""))
    words = str(verdict or MISSING).replace("_", " ")
    return Raw(f'<span class="chip {tone}">{esc(words)}</span>')


def _remaining(entry: Mapping[str, Any]) -> Raw:
    """How much of the prior's spread is left, as a bar and a percentage."""
    sd, before = entry.get("sd"), entry.get("prior_sd")
    if not (is_number(sd) and is_number(before)) or not float(before) > 0:  # type: ignore[arg-type]
        return Raw(MISSING)
    share = float(sd) / float(before)  # type: ignore[arg-type]
    text = f"{number(100 * share, 2)} %" if share < 0.1 else f"{100 * share:.0f} %"
    width = f"{100 * min(share, 1.0):.0f}%"
    return Raw(f'<span class="bar"><i style="width:{width}"></i></span>{text}')


def _interval(entry: Mapping[str, Any]) -> Raw:
    """The run's interval; below it the plain one, where that is another."""
    text = esc(interval(entry.get("q025"), entry.get("q975")))
    plain = entry.get("plain")
    if not isinstance(plain, Mapping):
        return Raw(text)
    below = esc(interval(plain.get("q025"), plain.get("q975")))
    return Raw(f'{text}<span class="why">plain: {below}</span>')


def _row(name: str, entry: Mapping[str, Any], truth: bool) -> list[object]:
    verdict = entry.get("verdict")
    why = entry.get("note") or VERDICTS.get(str(verdict), ("", ""))[1]
    if verdict == "identified":  # its note says by how much, as "spread left" does
        why = VERDICTS["identified"][1]
    meaning = entry.get("meaning") or ""
    below = f'<span class="why">{esc(meaning)}</span>' if meaning else ""
    row: list[object] = [
        Raw(f"{name_text(name)}{below}"),
        unit_text(entry.get("unit")) or "1",
        plus_minus(entry.get("prior_mean"), entry.get("prior_sd")),
        plus_minus(entry.get("mean"), entry.get("sd")),
        _interval(entry),
        _remaining(entry),
    ]
    if truth:
        row.append(number(entry.get("truth"), 4))
    return [
        *row,
        Raw(f'{verdict_chip(verdict)}<span class="why">{esc(why)}</span>'),
    ]


def parameter_table(summary: Summary) -> Raw:
    """Prior, posterior and verdict of every parameter."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    if not entries:
        return Raw("")
    truth = any(is_number(entry.get("truth")) for entry in entries.values())
    columns = ["parameter", "unit", "prior", "posterior", "95 % interval"]
    columns += ["spread left", *(["truth"] if truth else []), "verdict"]
    rows = [_row(name, entry, truth) for name, entry in entries.items()]
    last = len(columns) - 1
    return section(
        "parameters",
        "Parameters",
        paragraph(
            "Mean ± standard deviation in physical units, before and after the data. "
            "“Spread left” is the posterior's standard deviation as a share of the "
            "prior's.",
            "soft",
        ),
        *(_said(summary.get(key)) for key in ("intervals", "longer", "check", "nuts")),
        table(columns, rows, words=(0, 1, last), cards=True),
    )


def _said(about: object) -> Raw:
    """Which intervals these are; what --longer, --check and --nuts found beside."""
    if not isinstance(about, Mapping) or not about.get("text"):
        return Raw("")
    return paragraph(about["text"])


def _area(axes: svg.Axes, draws: np.ndarray, axis: densities.View, css: str) -> str:
    x, y = densities.curve(draws, axis)
    px, py = axes.px(x), axes.py(y)
    floor = float(axes.py(0.0))
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px, py, strict=True))
    return (
        f'<polygon class="area {css}" points="{px[0]:.1f},{floor:.1f} {points} '
        f'{px[-1]:.1f},{floor:.1f}"/>'
    )


def _density(
    name: str,
    entry: Mapping[str, Any],
    prior: np.ndarray | None,
    posterior: np.ndarray,
) -> Raw:
    """One parameter before and after the data."""
    truth = float(entry["truth"]) if is_number(entry.get("truth")) else None
    clouds = [posterior] if prior is None else [prior, posterior]
    axis = densities.view(clouds, entry.get("low"), entry.get("high"), truth)
    if axis is None:
        return Raw("")
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
        caption += f"; truth {number(truth, 4)}, {abs(away):.1f} sd away"
    unit = unit_text(entry.get("unit"))
    chip = verdict_chip(entry["verdict"]) if entry.get("verdict") else ""
    drawing = svg.chart(axes, marks, title=name, unit=unit)
    return Raw(f"{drawing}<figcaption>{esc(caption)} {chip}</figcaption>")


def parameter_densities(summary: Summary, arrays: Arrays) -> Raw:
    """A drawing per parameter: the prior, the posterior, the truth where known."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    samples = arrays.get("parameters/samples")
    if samples is None or not entries:
        return Raw("")
    before = arrays.get("parameters/prior_samples")
    figures = [
        _density(name, entry, None if before is None else before[:, i], samples[:, i])
        for i, (name, entry) in enumerate(entries.items())
    ]
    keys = [] if before is None else [("quiet", "prior")]
    keys.append(("c0", "posterior"))
    if any(is_number(entry.get("truth")) for entry in entries.values()):
        keys.append(("truth", "truth"))
    return section(
        "densities",
        "Before and after the data",
        legend(keys),
        cards(figure for figure in figures if figure),
        paragraph("Every curve is scaled to its own peak.", "soft"),
    )


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


def _matrix(names: list[str], correlation: np.ndarray) -> Raw:
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
                f'text-anchor="end">{esc(name)}</text>'
            )
        if i < count - 1:
            parts.append(
                f'<text transform="translate({x + cell / 2:.1f} {top - 6:.1f}) '
                f'rotate(-45)">{esc(name)}</text>'
            )
        for j in range(i):
            r = float(correlation[i, j])
            if np.isfinite(r):
                parts.append(_square(side + cell * j, y, cell, r))
    height = top + cell * (count - 1) + 4
    return Raw(
        f'<div class="scroll"><svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" '
        f'style="max-width:{width:.0f}px;min-width:{min(width, 340):.0f}px" '
        f'aria-label="posterior correlations">{"".join(parts)}</svg></div>'
    )


def correlations(summary: Summary, arrays: Arrays) -> Raw:
    """The posterior's correlation matrix."""
    entries: Mapping[str, Any] = summary.get("parameters") or {}
    matrix = arrays.get("parameters/correlation")
    if matrix is None or matrix.shape != (len(entries),) * 2 or len(entries) < 2:
        return Raw("")
    return section(
        "correlation",
        "What moves together",
        paragraph(
            "Posterior correlations in per cent. A strong one means that the data fix "
            "a combination of the two better than either alone.",
            "soft",
        ),
        _matrix(list(entries), matrix),
        legend([("c1", "rise together"), ("c0", "one rises, the other falls")]),
    )


def _direction(entry: Mapping[str, Any]) -> Raw:
    text = entry.get("text") or ""
    combination = entry.get("combination")
    parts = [esc(text)]
    if combination and str(combination) not in str(text):
        parts.append(f"<code>{esc(combination)}</code>")
    if is_number(entry.get("information")):
        parts.append(f'<span class="soft">({number(entry["information"])} nats)</span>')
    if entry.get("flat"):
        parts.append('<span class="chip warn">flat</span>')
    return Raw(" ".join(part for part in parts if part))


def directions(summary: Summary) -> Raw:
    """Which combinations of parameters the data fix, and which they leave open."""
    entries = summary.get("directions") or []
    base = summary.get("base_parameters") or []
    rows = [
        (
            name_text(unit_text(entry.get("text"))),
            plus_minus(entry.get("value"), entry.get("sd")),
            unit_text(entry.get("unit")) or "1",
            verdict_chip(entry.get("verdict")),
        )
        for entry in base
    ]
    columns = ["combination", "value", "unit", "verdict"]
    return section(
        "directions",
        "Combinations",
        listing(_direction(entry) for entry in entries),
        Raw("<h3>Base parameters: what these data do determine</h3>\n" if rows else ""),
        table(columns, rows, words=(0, 2, 3), cards=True) if rows else "",
    )
