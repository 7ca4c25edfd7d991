"""The sections of a report that hold data against the model."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sim2gp.reports import svg
from sim2gp.reports.markup import (
    MISSING,
    Raw,
    cards,
    esc,
    is_number,
    legend,
    listing,
    name_text,
    number,
    paragraph,
    percent,
    section,
    table,
    unit_text,
)
from sim2gp.reports.parameters import Arrays, Summary
from sim2gp.reports.traces import forecasts, unit_of

_COLOURS = ("c0", "c1", "c2", "c3", "c4", "c5")
_SHARES = ("coverage90", "coverage95", "coverage")


def _cell(key: str, value: object) -> object:
    if key in _SHARES:
        return percent(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return number(value) if is_number(value) or value is None else value


def records(entries: Mapping[str, Any], first: str) -> Raw:
    """A table of named entries: one column for every key that any of them has."""
    rows = {
        name: value if isinstance(value, Mapping) else {"value": value}
        for name, value in entries.items()
    }
    keys = list(dict.fromkeys(key for row in rows.values() for key in row))
    words = [
        index + 1
        for index, key in enumerate(keys)
        if any(isinstance(row.get(key), str) for row in rows.values())
    ]
    return table(
        [first, *(key.replace("_", " ") for key in keys)],
        [
            [name_text(name), *(_cell(key, row.get(key)) for key in keys)]
            for name, row in rows.items()
        ],
        words=(0, *words),
    )


def _sentence(item: object) -> object:
    if isinstance(item, Mapping):
        return item.get("text") or ", ".join(
            f"{key.replace('_', ' ')} {_cell(key, value)}"
            for key, value in item.items()
        )
    return item


#: What each misfit test asks.
_TESTS = {
    "chi2": "reduced chi-squared: as large as the noise?",
    "ljung_box": "Ljung-Box: correlated from row to row?",
    "f_test": "F test: do state and input explain them?",
    "split_half": "split-half distance: do two halves agree?",
}


def _tests(tests: Mapping[str, Any]) -> Raw:
    """What the residuals say of the model, test by test."""

    def row(name: str, test: Mapping[str, Any]) -> list[object]:
        tone, word = ("bad", "alarm") if test.get("alarm") else ("good", "passed")
        chip = Raw(f'<span class="chip {tone}">{word}</span>')
        statistic, p = number(test.get("statistic")), number(test.get("p"), 2)
        tested = chip if is_number(test.get("p")) else MISSING
        return [_TESTS.get(name, name), statistic, p, tested, test.get("text")]

    return table(
        ["what is asked of the residuals", "statistic", "p", "verdict", "in words"],
        [row(name, test) for name, test in tests.items()],
        words=(0, 3, 4),
        cards=True,
    )


def noise_and_misfit(summary: Summary) -> Raw:
    """The noise of every channel, and what the model leaves unexplained."""
    noise, misfit = summary.get("noise"), summary.get("misfit")
    parts: list[str] = []
    if isinstance(noise, Mapping) and noise:
        stated = {
            name: sd
            if isinstance(sd, Mapping)
            else {"sd": sd, "unit": unit_text(unit_of(summary, name)) or "1"}
            for name, sd in noise.items()
        }
        parts += [Raw("<h3>Noise</h3>\n"), records(stated, "channel")]
    if isinstance(misfit, Mapping):
        parts.append(Raw("<h3>Misfit</h3>\n"))
        if misfit.get("verdict"):
            parts.append(paragraph(misfit["verdict"]))
        if misfit.get("tests"):
            parts.append(_tests(misfit["tests"]))
        parts.append(listing(map(_sentence, misfit.get("noise") or ())))
    elif misfit:
        parts.append(Raw("<h3>Misfit</h3>\n"))
        parts.append(listing(map(_sentence, misfit)))
    return section("misfit", "Noise and misfit", *parts)


def calibration(summary: Summary, arrays: Arrays) -> Raw:
    """How many held-out measurements lie in the bands, level by level."""
    prefix = "calibration/share/"
    names = [key[len(prefix) :] for key in arrays if key.startswith(prefix)]
    if not names:
        return Raw("")
    about = (summary.get("held_out") or summary).get("calibration") or {}
    counted = (
        f"{number(about.get('windows'))} forecasts over {number(about.get('horizon'))} "
        f"s, judged by {about.get('blocks') or 'none'}"
    )
    drawings = [_curve_of_shares(arrays, name, i) for i, name in enumerate(names)]
    return section(
        "calibration",
        "Calibration",
        paragraph(about.get("text") or ""),
        cards(drawings, "wide"),
        paragraph(
            "How often a band held the measurement, against how often it should: below "
            "the line bands are too narrow, above it too wide. "
            f"{counted}. Of 100 forecasts with the right spread, 95 stay in the shade "
            "at all levels and in all channels; with fewer than eight independent "
            "blocks of windows there is none.",
            "soft",
        ),
    )


def _curve_of_shares(arrays: Arrays, name: str, index: int) -> Raw:
    """One channel's calibration curve, with its simultaneous band and the diagonal."""
    levels = np.asarray(arrays["calibration/level"], float)
    share = np.asarray(arrays[f"calibration/share/{name}"], float)
    low, high = (arrays.get(f"calibration/{end}/{name}") for end in ("low", "high"))
    ends, css = (0.0, 1.0), _COLOURS[index % 6]
    axes = svg.Axes(ends, ends, 440.0, 340.0, x_label="stated share")
    marks = [svg.line(axes, np.array(ends), np.array(ends), "quiet")]
    if low is not None and high is not None:
        marks.insert(0, svg.band(axes, levels, low, high, "quiet"))
        outside = (share < low) | (share > high)
        marks.append(svg.dots(axes, levels[outside], share[outside], css))
    marks.append(svg.line(axes, levels, share, css))
    return svg.chart(axes, marks, title=name, unit="share inside the band")


def _with_unit(summary: Summary, channel: str) -> Raw:
    """A channel's name and the unit of its errors."""
    unit = unit_text(unit_of(summary, channel))
    return Raw(f'{name_text(channel)} <span class="soft">{esc(unit)}</span>')


def _by_channel(summary: Summary) -> Raw:
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
                shown = percent(x) if key in _SHARES else number(x)
                rows.setdefault(str(channel), {})[words] = shown
    if not rows:
        return Raw("")
    used = [w for w in known.values() if any(w in row for row in rows.values())]
    return table(
        ["channel", *used],
        [[_with_unit(summary, c), *(row.get(w, "") for w in used)]
         for c, row in rows.items()],
        words=(0,),
        cards=True,
    )  # fmt: skip


def _curve(summary: Summary, arrays: Arrays, channel: str, methods: list[str]) -> Raw:
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
        svg.line(axes, horizon, curve, _COLOURS[methods.index(method) % 6])
        for method, curve in reversed(curves.items())
    ]
    unit = unit_of(summary, channel)
    return svg.chart(axes, marks, title=channel, unit=unit)


def held_out(summary: Summary, arrays: Arrays) -> Raw:
    """Prediction of what the model was not shown.

    Of a run that was fitted, its own section "held_out"; else the run is about nothing
    else.
    """
    about = summary.get("held_out") or summary
    figures: list[str] = []
    methods: list[str] = []
    if "curve/horizon" in arrays:
        pairs = [
            key.split("/", 2)[1:] for key in arrays
            if key.startswith("curve/") and key.count("/") >= 2
        ]  # fmt: skip
        methods = list(dict.fromkeys(method for method, _ in pairs))
        channels = list(dict.fromkeys(channel for _, channel in pairs))
        figures = [_curve(summary, arrays, channel, methods) for channel in channels]
    numbers = _by_channel({"units": summary.get("units")} | dict(about))
    horizon = about.get("horizon")
    windows = about.get("windows")
    unseen = forecasts(summary, arrays, "unseen")
    facts = []
    if is_number(horizon):
        facts.append(f"horizon {number(horizon)} s")
    if is_number(windows):
        facts.append(f"{number(windows)} windows")
    return section(
        "heldout",
        "Prediction of held-out data",
        paragraph(about["text"]) if about.get("text") else "",
        paragraph(", ".join(facts), "soft") if facts and numbers else "",
        numbers,
        Raw("<h3>Error against horizon</h3>\n" if figures else ""),
        legend([(_COLOURS[i % 6], m) for i, m in enumerate(methods)])
        if figures
        else "",
        cards(figures, "wide"),
        Raw("<h3>Forecasts</h3>\n") + unseen if unseen else "",
    )


def extra_tables(summary: Summary) -> Raw:
    """Further tables of a run: a list of {title, columns, rows, note}."""
    parts: list[str] = []
    for entry in summary.get("tables") or ():
        rows: Iterable[Sequence[object]] = entry.get("rows") or ()
        shown = [[_cell("", cell) for cell in row] for row in rows]
        words = [
            i
            for i in range(len(entry["columns"]))
            if any(isinstance(row[i], str) for row in entry.get("rows") or ())
        ]
        parts.append(Raw(f"<h3>{esc(entry.get('title', ''))}</h3>\n"))
        parts.append(table(entry["columns"], shown, words=words))
        if entry.get("note"):
            parts.append(paragraph(entry["note"], "soft"))
    return section("tables", "More numbers", *parts)


def claims(summary: Summary) -> Raw:
    """What a reproduction claims, and whether it holds here."""
    rows = [
        (
            Raw(f"<b>{esc(name.replace('_', ' '))}</b>"),
            Raw('<span class="chip good">holds</span>')
            if entry.get("holds")
            else Raw('<span class="chip bad">does not hold</span>'),
            _cell("", entry.get("figure")),
            Raw(f'<span class="why">{esc(entry.get("text") or "")}</span>'),
        )
        for name, entry in (summary.get("claims") or {}).items()
    ]
    if not rows:
        return Raw("")
    return section(
        "claims",
        "Claims",
        table(["claim", "", "figure", ""], rows, words=(0, 1, 3), cards=True),
    )
