"""Recorded signals over what the model made of them, log by log."""

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from sim2gp.reports import svg
from sim2gp.reports.numbers import format_number
from sim2gp.reports.parameters import Arrays, Section, Summary

#: Drawings; more would make the page heavy, not clearer.
_MOST = {"trace": 40, "unseen": 16}
_ROOM = 0.4  # of the signal's own range: that much of the band is shown beyond it
_CLOSE = 1.5  # s of the closer look


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


def unit_of(summary: Summary, channel: str) -> str:
    """The unit of a channel, where the summary gives it."""
    units = summary.get("units") or {}
    if channel in units:
        return str(units[channel])
    noise = (summary.get("noise") or {}).get(channel)
    return str(noise.get("unit") or "") if isinstance(noise, Mapping) else ""


def _trace(
    arrays: Arrays, base: str, channel: str, unit: str, rows: slice, title: str
) -> Markup:
    time = arrays[f"{base}/time"][rows]
    curves = {
        kind: np.asarray(arrays[f"{base}/{kind}/{channel}"][rows], dtype=float)
        for kind in ("measured", "predicted", "low", "high")
        if f"{base}/{kind}/{channel}" in arrays
    }
    # The band may be far wider than the signal: it must not set the scale alone.
    lines = [curves[k] for k in ("measured", "predicted") if k in curves]
    low, high = svg.span(*lines)
    wide = svg.span(*curves.values())
    room = low - _ROOM * (high - low), high + _ROOM * (high - low)
    ends = max(wide[0], room[0]), min(wide[1], room[1])
    axes = svg.Axes(svg.span(time, margin=0.0), ends, 440.0, x_label="s")
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
            remark = (
                f"rms difference {format_number(float(np.sqrt(np.nanmean(gap**2))))}"
            )
    kinds = " and ".join(kind for kind in ("measured", "predicted") if kind in curves)
    said = f"{kinds}, time {svg.extent(time, 's')}" + (f"; {remark}" if remark else "")
    return svg.chart(
        axes, marks, title=title, said=said, unit=unit, remark=f"{remark} {unit}"
    )


def _closest_look(arrays: Arrays, base: str, channels: list[str]) -> slice | None:
    """The rows of the short stretch in which the simulation is worst, if long."""
    time = np.asarray(arrays[f"{base}/time"], dtype=float)
    if time.size < 10 or np.nanmax(time) - np.nanmin(time) < 4 * _CLOSE:
        return None
    score = np.zeros(time.size)
    for channel in channels:
        both = [arrays.get(f"{base}/{k}/{channel}") for k in ("measured", "predicted")]
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


def forecasts(summary: Summary, arrays: Arrays, prefix: str) -> Section:
    """Every log below a prefix, and a closer look where it differs most."""
    parts: list[tuple[str, list[Markup]]] = []
    drawn, left = 0, 0
    banded = False
    for log in _under(arrays, f"{prefix}/"):
        base = f"{prefix}/{log}"
        if f"{base}/time" not in arrays:
            continue
        measured = f"{base}/measured/"
        channels = [k[len(measured) :] for k in arrays if k.startswith(measured)]
        close = _closest_look(arrays, base, channels)
        looks = [(slice(None), "")] + ([] if close is None else [(close, ", closer")])
        if drawn + len(looks) * len(channels) > _MOST[prefix] and drawn:
            left += 1
            continue
        drawn += len(looks) * len(channels)
        banded = banded or any(key.startswith(f"{base}/low/") for key in arrays)
        figures = [
            _trace(arrays, base, c, unit_of(summary, c), rows, c + suffix)
            for c in channels
            for rows, suffix in looks
        ]
        parts.append((log, figures))
    return {"logs": parts, "banded": banded, "left": left} if parts else None


def traces(summary: Summary, arrays: Arrays) -> Section:
    """Every log against the simulation, and a closer look where they differ most."""
    drawn = forecasts(summary, arrays, "trace")
    return drawn and {"forecasts": drawn, "note": summary.get("trace_note")}
