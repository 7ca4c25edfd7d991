"""The sections of a report that hold data against the model."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from markupsafe import Markup

from sim2gp.reports import svg
from sim2gp.reports.numbers import (
    MISSING,
    format_number,
    format_percent,
    is_number,
    power_of_ten,
    unit_text,
)
from sim2gp.reports.parameters import Arrays, Section, Summary
from sim2gp.reports.tables import (
    SHARES,
    ReportTable,
    TableCell,
    format_value,
    make_table,
    records,
)
from sim2gp.reports.traces import forecasts, unit_of

NARROW = 3  # columns that a telephone shows side by side
COLOURS = ("c0", "c1", "c2", "c3", "c4", "c5")


def colour(index: int) -> str:
    """The class of the colour of a line; after six they begin again."""
    return COLOURS[index % len(COLOURS)]


def _item_text(item: object) -> object:
    if isinstance(item, Mapping):
        return item.get("text") or ", ".join(
            f"{key.replace('_', ' ')} {format_value(key, value)}"
            for key, value in item.items()
        )
    return item


_LEAST = 1e-99  # p-value that is written out
#: What each misfit test asks.
_TESTS = {
    "chi2": "reduced chi-squared: as large as the noise?",
    "ljung_box": "Ljung-Box: correlated from row to row?",
    "f_test": "F test: do state and input explain them?",
    "split_half": "split-half distance: do two halves agree?",
}


def _p_value(p: object) -> str:
    """Two digits; what is next to nothing has none."""
    tiny = is_number(p) and float(p) < _LEAST  # type: ignore[arg-type]
    return f"< {power_of_ten(-99)}" if tiny else format_number(p, 2)


def _tests(tests: Mapping[str, Any]) -> ReportTable:
    """What the residuals say of the model, test by test."""

    def row(name: str, test: Mapping[str, Any]) -> list[object]:
        chip = ("bad", "alarm") if test.get("alarm") else ("good", "passed")
        statistic, p = format_number(test.get("statistic")), _p_value(test.get("p"))
        tested = TableCell(chip=chip) if is_number(test.get("p")) else MISSING
        return [_TESTS.get(name, name), statistic, p, tested, test.get("text") or ""]

    return make_table(
        ["what is asked of the residuals", "statistic", "p", "verdict", "in words"],
        [row(name, test) for name, test in tests.items()],
        words=(0, 3, 4),
        cards=True,
    )


def noise_and_misfit(summary: Summary) -> Section:
    """The noise of every channel, and what the model leaves unexplained."""
    noise, misfit = summary.get("noise"), summary.get("misfit")
    stated = {}
    if isinstance(noise, Mapping):
        stated = {
            name: sd
            if isinstance(sd, Mapping)
            else {"sd": sd, "unit": unit_text(unit_of(summary, name)) or "1"}
            for name, sd in noise.items()
        }
    if not stated and not misfit:
        return None
    about = misfit if isinstance(misfit, Mapping) else {"noise": misfit}
    explains = summary.get("command") == "explain"  # its headline says it
    tests: Mapping[str, Any] = about.get("tests") or {}
    return {
        "noise": records(stated, "channel") if stated else None,
        "asked": bool(misfit),
        "verdict": None if explains else about.get("verdict"),
        "tests": _tests(tests) if tests else None,
        "notes": list(map(_item_text, about.get("noise") or ())),
    }


def calibration_section(summary: Summary, arrays: Arrays) -> Section:
    """How many held-out measurements lie in the bands, level by level."""
    prefix = "calibration/share/"
    names = [key[len(prefix) :] for key in arrays if key.startswith(prefix)]
    if not names:
        return None
    about = (summary.get("held_out") or summary).get("calibration") or {}
    counted = (
        f"{format_number(about.get('windows'))} forecasts over "
        f"{format_number(about.get('horizon'))} s, "
        f"judged by {about.get('blocks') or 'none'}"
    )
    drawings = [_curve_of_shares(arrays, name, i) for i, name in enumerate(names)]
    return {"text": about.get("text"), "curves": drawings, "counted": counted}


def _curve_of_shares(arrays: Arrays, name: str, index: int) -> Markup:
    """One channel's calibration curve, with its simultaneous band and the diagonal."""
    levels = np.asarray(arrays["calibration/level"], float)
    share = np.asarray(arrays[f"calibration/share/{name}"], float)
    low, high = (arrays.get(f"calibration/{end}/{name}") for end in ("low", "high"))
    ends, css = (0.0, 1.0), colour(index)
    axes = svg.Axes(ends, ends, 440.0, 340.0, x_label="stated share")
    marks = [svg.line(axes, np.array(ends), np.array(ends), "quiet")]
    if low is not None and high is not None:
        marks.insert(0, svg.band(axes, levels, low, high, "quiet"))
        outside = (share < low) | (share > high)
        marks.append(svg.dots(axes, levels[outside], share[outside], css))
    marks.append(svg.line(axes, levels, share, css))
    said = ", ".join(
        f"the {format_percent(a)} band holds {format_percent(b)}"
        for a, b in zip(levels, share, strict=True)
        if a in (levels[0], levels[-1])
    )
    said = said or "no bands"
    return svg.chart(axes, marks, title=name, said=said, unit="share inside the band")


def _by_channel(summary: Summary) -> ReportTable:
    """Errors and coverage with a row per channel and a line for the pooled ones."""
    known = {
        "open_loop_rmse": "error at the horizon",
        "hold_rmse": "of holding still",
        "regression_rmse": "of a linear regression",
        "one_step_rmse": "one-step error",
        "nll": "negative log-likelihood",
        "coverage90": "inside the 90 % band",
        "coverage95": "inside the 95 % band",
    }
    rows: dict[str, dict[str, object]] = {}
    for key, words in known.items():
        value = summary.get(key)
        per_channel = value if isinstance(value, Mapping) else {"all": value}
        for channel, x in per_channel.items():
            if is_number(x):
                text = format_percent(x) if key in SHARES else format_number(x)
                rows.setdefault(str(channel), {})[words] = text
    used = [w for w in known.values() if any(w in row for row in rows.values())]
    units = {channel: unit_text(unit_of(summary, channel)) for channel in rows}
    named = [
        [TableCell(name=channel, unit=units[channel]), *(row.get(w, "") for w in used)]
        for channel, row in rows.items()
    ]
    return make_table(["channel", *used], named, words=(0,), cards=True)


def _curve(
    summary: Summary, arrays: Arrays, channel: str, methods: list[str]
) -> Markup:
    """Each method's error of one channel against the horizon."""
    horizon = np.asarray(arrays["curve/horizon"], dtype=float)
    curves = {
        method: np.asarray(arrays[f"curve/{method}/{channel}"], dtype=float)
        for method in methods
        if f"curve/{method}/{channel}" in arrays
    }
    top = svg.span(*curves.values())[1]
    axes = svg.Axes(
        svg.span(horizon, margin=0.0), (0.0, top), 440.0, 230.0, x_label="horizon, s"
    )
    marks = [
        svg.line(axes, horizon, curve, colour(methods.index(method)))
        for method, curve in reversed(curves.items())
    ]
    unit, last = unit_of(summary, channel), horizon[-1:]
    said = ", ".join(f"{m} {format_number(c[-1])}" for m, c in curves.items() if len(c))
    said = (
        f"errors after {format_number(last[0])} s: {said}" if len(last) else "no errors"
    )
    return svg.chart(axes, marks, title=channel, said=said, unit=unit)


def held_out_section(summary: Summary, arrays: Arrays) -> Section:
    """Prediction of what the model was not shown.

    Of a run that was fitted, its own section "held_out"; else the run is about nothing
    else.
    """
    about = summary.get("held_out") or summary
    pairs = [
        key.split("/", 2)[1:]
        for key in (arrays if "curve/horizon" in arrays else ())
        if key.startswith("curve/") and key.count("/") >= 2
    ]
    methods = list(dict.fromkeys(method for method, _ in pairs))
    channels = list(dict.fromkeys(channel for _, channel in pairs))
    numbers = _by_channel({"units": summary.get("units")} | dict(about))
    facts = []
    if is_number(about.get("horizon")):
        facts.append(f"horizon {format_number(about['horizon'])} s")
    if is_number(about.get("windows")):
        facts.append(f"{format_number(about['windows'])} windows")
    found = {
        "text": about.get("text"),
        "facts": ", ".join(facts) if numbers.rows else "",
        "channels": numbers if numbers.rows else None,
        "curves": [_curve(summary, arrays, channel, methods) for channel in channels],
        "forecasts": forecasts(summary, arrays, "unseen"),
    }
    keys = [(colour(i), m) for i, m in enumerate(methods)]
    return found | {"legend": keys} if any(found.values()) else None


def extra_tables(summary: Summary) -> list[dict[str, Any]]:
    """Further tables of a run: a list of {title, columns, rows, note}."""
    parts = []
    for entry in summary.get("tables") or ():
        rows = entry.get("rows") or ()
        words = [
            i
            for i in range(len(entry["columns"]))
            if any(isinstance(row[i], str) for row in rows)
        ]
        cells = [[format_value("", cell) for cell in row] for row in rows]
        many = len(entry["columns"]) > NARROW
        drawn = make_table(
            entry["columns"], cells, words=words, cards=many, prose=False
        )
        title = entry.get("title", "")
        parts.append({"title": title, "table": drawn, "note": entry.get("note")})
    return parts


def claims_section(summary: Summary) -> ReportTable | None:
    """What a reproduction claims, and whether it holds here."""
    rows = [
        [
            TableCell(name=name.replace("_", " ")),
            TableCell(
                chip=("good", "holds")
                if entry.get("holds")
                else ("bad", "does not hold")
            ),
            format_value("", entry.get("figure")),
            TableCell(why=entry.get("text") or ""),
        ]
        for name, entry in (summary.get("claims") or {}).items()
    ]
    columns = ["claim", "", "figure", ""]
    return make_table(columns, rows, words=(0, 1, 2, 3), cards=True) if rows else None


def claims_in_a_sentence(summary: Summary) -> str:
    """How many claims hold; nothing where there are none."""
    holds = [bool(e.get("holds")) for e in (summary.get("claims") or {}).values()]
    return f"{sum(holds)} of {len(holds)} claims hold." if holds else ""
