"""The section of a report that tells how well episodes went."""

from collections.abc import Mapping

import numpy as np

from sim2gp.reports import svg
from sim2gp.reports.data import _COLOURS
from sim2gp.reports.markup import (
    Raw,
    esc,
    is_number,
    legend,
    number,
    paragraph,
    section,
    table,
)
from sim2gp.reports.parameters import Arrays, Summary


def _series(summary: Summary, arrays: Arrays) -> dict[str, np.ndarray]:
    """Returns of each method as (seeds, episodes)."""
    found = {
        key.removeprefix("returns/"): np.atleast_2d(np.asarray(value, dtype=float))
        for key, value in arrays.items()
        if key.startswith("returns/")
    }
    listed = summary.get("returns")
    if not found and listed:
        named = listed if isinstance(listed, Mapping) else {"this run": listed}
        found = {
            name: np.atleast_2d(np.asarray(values, dtype=float))
            for name, values in named.items()
        }
    return {name: value for name, value in found.items() if value.size}


def _lines(axes: svg.Axes, values: np.ndarray, css: str) -> list[str]:
    """One seed: its line. Many: the median, the quartiles, every seed as a dot."""
    episodes = np.arange(1.0, values.shape[1] + 1)
    if len(values) == 1:
        return [
            svg.line(axes, episodes, values[0], css),
            svg.dots(axes, episodes, values[0], css),
        ]
    low, middle, high = np.nanquantile(values, [0.25, 0.5, 0.75], axis=0)
    seeds = "".join(svg.dots(axes, episodes, row, css) for row in values)
    return [
        svg.band(axes, episodes, low, high, css),
        f'<g class="faint">{seeds}</g>',
        svg.line(axes, episodes, middle, css),
        svg.dots(axes, episodes, middle, css),
    ]


def _episodes_to_95(summary: Summary, method: str, alone: bool) -> str:
    value = summary.get("episodes_to_95")
    if isinstance(value, Mapping):
        value = value.get(method)
    elif not alone:
        return ""
    if isinstance(value, list | tuple):
        reached = [v for v in value if v is not None]
        if not reached:
            return "never"
        middle = f"{float(np.median(reached)):g}"
        return f"{middle} ({len(reached)} of {len(value)} seeds)"
    return number(value) if is_number(value) else "never"


def _scores(summary: Summary, values: np.ndarray) -> tuple[str, str]:
    """Median return of the last episode and its share of the oracle's."""
    last = float(np.nanmedian(values[:, -1]))
    oracle, hang = summary.get("oracle_return"), summary.get("hang_return")
    if not (is_number(oracle) and is_number(hang)) or oracle == hang:
        return number(last), ""
    score = (last - float(hang)) / (float(oracle) - float(hang))  # type: ignore[arg-type]
    return number(last), f"{score:.2f}"


def _methods(summary: Summary, series: Mapping[str, np.ndarray]) -> Raw:
    rows = []
    for method, values in series.items():
        last, score = _scores(summary, values)
        best = number(float(np.nanmedian(np.nanmax(values, axis=1))))
        reached = _episodes_to_95(summary, method, len(series) == 1)
        rows.append((Raw(f"<b>{method_name(method)}</b>"), reached, best, last, score))
    columns = ["method", "episodes to 95 %", "best return", "last return", "score"]
    return table(columns, rows, words=(0,), cards=True)


def method_name(method: str) -> str:
    """The words for a method's key."""
    return esc(method.replace("_", " "))


def returns(summary: Summary, arrays: Arrays) -> Raw:
    """Return of every episode, beside the oracle and doing nothing."""
    series = _series(summary, arrays)
    if not series:
        return Raw("")
    references = {
        words: float(summary[key])
        for key, words in (("oracle_return", "oracle"), ("hang_return", "hanging"))
        if is_number(summary.get(key))
    }
    most = max(values.shape[1] for values in series.values())
    levels = np.array(list(references.values()))
    axes = svg.Axes(
        (0.75, most + 0.5), svg.span(*series.values(), levels), 480.0, 270.0,
        whole=True, x_label="episode",
    )  # fmt: skip
    marks = [
        svg.level(axes, value, "quiet", words) for words, value in references.items()
    ]
    for index, values in enumerate(series.values()):
        marks += _lines(axes, values, _COLOURS[index % len(_COLOURS)])
    drawing = svg.chart(axes, marks, title="return")
    keys = [(_COLOURS[i % 6], name.replace("_", " ")) for i, name in enumerate(series)]
    seeds = max(len(values) for values in series.values())
    text = (
        f"{seeds} seeds: the line is their median, the shade their quartiles. "
        if seeds > 1
        else ""
    )
    if "oracle" in references and "hanging" in references:
        text += "Score: 0 is hanging still, 1 is the planner that knows the truth."
    return section(
        "returns",
        "Returns",
        legend(keys) if len(keys) > 1 else "",
        Raw(f'<figure class="solo">{drawing}</figure>\n'),
        _methods(summary, series),
        paragraph(text, "soft") if text else "",
    )
