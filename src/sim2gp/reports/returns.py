"""The section of a report that says how well episodes went."""

from collections.abc import Mapping

import numpy as np

from sim2gp.reports import svg
from sim2gp.reports.data import COLOURS, colour
from sim2gp.reports.numbers import MISSING, format_number, is_number
from sim2gp.reports.parameters import Arrays, Section, Summary
from sim2gp.reports.tables import ReportTable, TableCell, make_table


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
    known = {name: x[np.isfinite(x).any(axis=1)] for name, x in found.items()}
    return {name: value for name, value in known.items() if value.size}


def _return_marks(axes: svg.Axes, values: np.ndarray, css: str) -> list[str]:
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
    return format_number(value) if is_number(value) else "never"


def _scores(summary: Summary, values: np.ndarray) -> tuple[str, str]:
    """Median return of the last episode and its share of the oracle's."""
    last = float(np.nanmedian(values[:, -1]))
    oracle, hang = summary.get("oracle_return"), summary.get("hang_return")
    if not (is_number(oracle) and is_number(hang)) or oracle == hang:
        return format_number(last), ""
    score = (last - float(hang)) / (float(oracle) - float(hang))  # type: ignore[arg-type]
    return format_number(last), f"{score:.2f}"


def _methods(summary: Summary, series: Mapping[str, np.ndarray]) -> ReportTable:
    rows = []
    for method, values in series.items():
        last, score = _scores(summary, values)
        best = format_number(float(np.nanmedian(np.nanmax(values, axis=1))))
        reached = _episodes_to_95(summary, method, len(series) == 1)
        rows.append([TableCell(name=method_name(method)), reached, best, last, score])
    columns = ["method", "episodes to 95 %", "best return", "last return", "score"]
    return make_table(columns, rows, words=(0,), cards=True)


def _median(values: np.ndarray) -> str:
    """The median of what is known."""
    known = values[np.isfinite(values)]
    return format_number(float(np.median(known))) if known.size else MISSING


def method_name(method: str) -> str:
    """The words for a method's key."""
    return method.replace("_", " ")


def returns_section(summary: Summary, arrays: Arrays) -> Section:
    """Return of every episode, with the oracle's and that of doing nothing.

    A study has hundreds of them, and figures and tables of its own.
    """
    series = _series(summary, arrays)
    if len(series) > len(COLOURS):
        return {"many": len(series)}
    if not series:
        return None
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
        marks += _return_marks(axes, values, colour(index))
    said = "; ".join(
        f"{method_name(name)} {_median(values[:, 0])} in the first episode, "
        f"{_median(values[:, -1])} in the last"
        for name, values in series.items()
    )
    keys = [(colour(i), method_name(name)) for i, name in enumerate(series)]
    scored = {"oracle", "hanging"} <= references.keys()
    return {
        "many": 0,
        "legend": keys if len(keys) > 1 else [],
        "drawing": svg.chart(axes, marks, title="return", said=said),
        "methods": _methods(summary, series),
        "seeds": max(len(values) for values in series.values()),
        "scored": scored,
    }
