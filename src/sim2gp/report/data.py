"""The sections of a report that hold data against the model."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sim2gp.report import svg
from sim2gp.report.markup import (
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
)
from sim2gp.report.parameters import Arrays, Summary

_COLOURS = ("c0", "c1", "c2", "c3", "c4", "c5")
_MOST_TRACES = 40  # drawings; more would make the page heavy, not clearer
_CLOSE = 1.5  # s of the closer look
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
    )


def noise_and_misfit(summary: Summary) -> Raw:
    """The noise of every channel, and what the model leaves unexplained."""
    noise, misfit = summary.get("noise"), summary.get("misfit")
    parts: list[str] = []
    if isinstance(noise, Mapping) and noise:
        parts += [Raw("<h3>Noise</h3>\n"), records(noise, "channel")]
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


def _under(arrays: Arrays, prefix: str) -> list[str]:
    """The next parts of all keys below a prefix, each once, in their order.

    A log's name may be a path, so it is everything up to the part that names what
    is stored.
    """
    stems = ("/time", "/measured/", "/predicted/", "/low/", "/high/")
    found: dict[str, None] = {}
    for key in arrays:
        if not key.startswith(prefix):
            continue
        rest = key[len(prefix) :]
        ends = [rest.find(stem) for stem in stems if stem in rest]
        if ends:
            found[rest[: min(ends)]] = None
    return list(found)


def _unit(summary: Summary, channel: str) -> str:
    """The unit of a channel, where the summary tells it."""
    units = summary.get("units") or {}
    if channel in units:
        return str(units[channel])
    noise = (summary.get("noise") or {}).get(channel)
    return str(noise.get("unit") or "") if isinstance(noise, Mapping) else ""


def _trace(
    arrays: Arrays, log: str, channel: str, unit: str, rows: slice, title: str
) -> Raw:
    base = f"trace/{log}"
    time = arrays[f"{base}/time"][rows]
    curves = {
        kind: np.asarray(arrays[f"{base}/{kind}/{channel}"][rows], dtype=float)
        for kind in ("measured", "predicted", "low", "high")
        if f"{base}/{kind}/{channel}" in arrays
    }
    # The band may be far wider than the signal: it must not set the scale alone.
    lines = [curves[k] for k in ("measured", "predicted") if k in curves]
    axes = svg.Axes(svg.span(time, margin=0.0), svg.span(*lines), 440.0, x_label="s")
    marks = []
    if "low" in curves and "high" in curves:
        marks.append(svg.band(axes, time, curves["low"], curves["high"], "c1"))
    if "measured" in curves:
        marks.append(svg.line(axes, time, curves["measured"], "quiet"))
    if "predicted" in curves:
        marks.append(svg.line(axes, time, curves["predicted"], "c1"))
    remark = ""
    if {"measured", "predicted"} <= curves.keys():
        gap = curves["predicted"] - curves["measured"]
        if np.isfinite(gap).any():
            remark = f"rms difference {number(float(np.sqrt(np.nanmean(gap**2))))}"
    return svg.chart(axes, marks, title=title, unit=unit, remark=f"{remark} {unit}")


def _closest_look(arrays: Arrays, log: str, channels: list[str]) -> slice | None:
    """The rows of the short stretch in which the simulation is worst, if long."""
    time = np.asarray(arrays[f"trace/{log}/time"], dtype=float)
    if time.size < 10 or np.nanmax(time) - np.nanmin(time) < 4 * _CLOSE:
        return None
    score = np.zeros(time.size)
    for channel in channels:
        both = [
            arrays.get(f"trace/{log}/{k}/{channel}") for k in ("measured", "predicted")
        ]
        if both[0] is None or both[1] is None:
            return None
        scale = float(np.nanstd(both[0])) or 1.0
        # A gap between windows has no error; it must not end the sum.
        gap = ((both[1] - both[0]) / scale) ** 2
        score += np.where(np.isfinite(gap), gap, 0.0)
    total = np.concatenate([[0.0], np.cumsum(score)])
    filled = np.interp(
        np.arange(time.size),
        np.flatnonzero(np.isfinite(time)),
        time[np.isfinite(time)],
    )
    ends = np.searchsorted(filled, filled + _CLOSE)
    inside = filled + _CLOSE <= filled[-1]
    start = int(np.argmax(np.where(inside, total[ends] - total[:-1], -1.0)))
    return slice(start, int(ends[start]))


def traces(summary: Summary, arrays: Arrays) -> Raw:
    """Every log against the simulation, and a closer look where they differ most."""
    parts: list[str] = []
    drawn, left = 0, 0
    banded = False
    for log in _under(arrays, "trace/"):
        if f"trace/{log}/time" not in arrays:
            continue
        prefix = f"trace/{log}/measured/"
        channels = [key[len(prefix) :] for key in arrays if key.startswith(prefix)]
        close = _closest_look(arrays, log, channels)
        looks = [(slice(None), "")] + ([] if close is None else [(close, ", closer")])
        if drawn + len(looks) * len(channels) > _MOST_TRACES and drawn:
            left += 1
            continue
        drawn += len(looks) * len(channels)
        banded = banded or any(key.startswith(f"trace/{log}/low/") for key in arrays)
        figures = [
            _trace(arrays, log, c, _unit(summary, c), rows, c + suffix)
            for c in channels
            for rows, suffix in looks
        ]
        parts.append(Raw(f"<h3>{esc(log)}</h3>\n"))
        parts.append(cards(figures, "wide"))
    if not parts:
        return Raw("")
    keys = [("quiet", "measured"), ("c1", "simulated")]
    text = f"{left} more logs are in arrays.npz and not drawn." if left else ""
    note = summary.get("trace_note")
    return section(
        "traces",
        "Measured against simulated",
        legend(keys),
        paragraph(note, "soft") if note else "",
        paragraph("The shade is the predicted band.", "soft") if banded else "",
        *parts,
        paragraph(text, "soft") if text else "",
    )


def _by_channel(summary: Summary) -> Raw:
    """Errors and coverage with a row per channel and a line for the pooled ones."""
    known = {
        "open_loop_rmse": "error at the horizon",
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
        [[name_text(c), *(row.get(w, "") for w in used)]
         for c, row in rows.items()],
        words=(0,),
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
    unit = _unit(summary, channel)
    return svg.chart(axes, marks, title=channel, unit=unit)


def held_out(summary: Summary, arrays: Arrays) -> Raw:
    """Prediction of what the model was not shown."""
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
    numbers = _by_channel(summary)
    horizon = summary.get("horizon")
    windows = summary.get("windows")
    facts = []
    if is_number(horizon):
        facts.append(f"horizon {number(horizon)} s")
    if is_number(windows):
        facts.append(f"{number(windows)} windows")
    return section(
        "heldout",
        "Prediction of held-out data",
        paragraph(", ".join(facts), "soft") if facts and numbers else "",
        numbers,
        Raw("<h3>Error against horizon</h3>\n" if figures else ""),
        legend([(_COLOURS[i % 6], m) for i, m in enumerate(methods)])
        if figures
        else "",
        cards(figures, "wide"),
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
        "claims", "Claims", table(["claim", "", "figure", ""], rows, words=(0, 1, 3))
    )
