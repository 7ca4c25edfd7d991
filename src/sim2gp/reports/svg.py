"""Small charts as inline SVG: axes, lines, bands, marks.

Colours are classes (`c0` to `c5`, `quiet`, `truth`), so the page's style sheet
decides them, in the light and in the dark. Coordinates have one decimal: the same
data give the same bytes.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from sim2gp.reports.numbers import format_number, power_of_ten

_TOP, _RIGHT = 26.0, 10.0
_DIGIT_WIDTH = 6.6  # pixels of a digit of the tick labels


@dataclass(frozen=True)
class Axes:
    """The map from data to pixels of a chart of the given size."""

    x: tuple[float, float]
    y: tuple[float, float]
    width: float = 340.0
    height: float = 180.0
    log_x: bool = False
    y_labels: bool = True
    whole: bool = False  # the x axis counts: its ticks are integers
    x_label: str = ""

    @property
    def left(self) -> float:
        """The width of the margin that holds the labels of the y axis, in pixels."""
        if not self.y_labels:
            return 8.0
        widest = max((len(text) for _, text in ticks(*self.y)), default=1)
        return 10.0 + _DIGIT_WIDTH * widest

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the field inside the axes, in pixels."""
        height = self.height - _TOP - self.bottom
        return self.width - self.left - _RIGHT, height

    @property
    def bottom(self) -> float:
        """The height of the margin below the field: a long label has its own line."""
        return 22.0 if len(self.x_label) < 4 else 38.0

    def px(self, x: np.ndarray | float) -> np.ndarray:
        """Pixels from the left edge of the field."""
        low, high = self.x
        value = np.asarray(x, dtype=float)
        if self.log_x:
            low, high = math.log10(low), math.log10(high)
            with np.errstate(invalid="ignore", divide="ignore"):
                value = np.log10(value)
        return np.asarray((value - low) / (high - low) * self.size[0])

    def py(self, y: np.ndarray | float) -> np.ndarray:
        """Pixels from the top edge of the field."""
        low, high = self.y
        share = (high - np.asarray(y, dtype=float)) / (high - low)
        return np.asarray(share * self.size[1])


def span(*values: np.ndarray | float, margin: float = 0.06) -> tuple[float, float]:
    """The range of all finite values, a little widened; never of zero width."""
    flat = np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in values])
    flat = flat[np.isfinite(flat)]
    if flat.size == 0:
        return 0.0, 1.0
    low, high = float(flat.min()), float(flat.max())
    pad = margin * (high - low)
    if high - low <= 1e-9 * max(abs(low), abs(high)):
        pad = 0.05 * max(abs(low), abs(high)) or 1.0
    return low - pad, high + pad


def extent(values: np.ndarray | float, unit: str = "") -> str:
    """The least and the largest finite value in words, with their unit."""
    flat = np.ravel(np.asarray(values, dtype=float))
    flat = flat[np.isfinite(flat)]
    if flat.size == 0:
        return "no values"
    text = (
        f"from {format_number(float(flat.min()))} to {format_number(float(flat.max()))}"
    )
    return f"{text} {unit}".rstrip()


def ticks(
    low: float, high: float, count: int = 4, least: float = 0.0
) -> list[tuple[float, str]]:
    """Round numbers between two others, at least so far apart, with their labels."""
    raw = max((high - low) / count, least)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    values = [index * step for index in range(first, last + 1)]
    exponent = math.floor(math.log10(max(abs(low), abs(high))))
    if -3 <= exponent < 5:
        decimals = max(0, -math.floor(math.log10(step)) + (step / power == 2.5))
        return [(v, f"{v:.{decimals}f}".replace("-", "−")) for v in values]
    return [(v, f"{v:.3g}".replace("-", "−") if v else "0") for v in values]


def log_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Powers of ten between two positive numbers, or round numbers if too few."""
    first, last = math.ceil(math.log10(low)), math.floor(math.log10(high))
    stride = max(1, (last - first) // 4)
    powers = list(range(first, last + 1, stride))
    if len(powers) < 2:
        return [(v, f"{v:g}") for v in _round_numbers(low, high)]
    return [(10.0**p, power_of_ten(p)) for p in powers]


def _round_numbers(low: float, high: float) -> list[float]:
    first = math.floor(math.log10(low))
    steps = [m * 10.0**p for p in range(first, first + 3) for m in (1, 2, 5)]
    return [value for value in steps if low <= value <= high]


def _finite_stretches(*columns: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """The stretches over which every column is finite."""
    good = np.all([np.isfinite(c) for c in columns], axis=0)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        yield tuple(column[start:stop] for column in columns)


def thin(x: np.ndarray, y: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `limit` points that keep the extremes of every stretch and all gaps."""
    if x.size <= limit:
        return x, y
    groups = np.array_split(np.arange(x.size), max(limit // 3, 1))
    keep = []
    for group in groups:
        part = y[group]
        gaps = group[~np.isfinite(part)]
        finite = group[np.isfinite(part)]
        extremes = (
            [finite[np.argmin(y[finite])], finite[np.argmax(y[finite])]]
            if finite.size
            else []
        )
        keep.extend(sorted({*extremes, *gaps[:1]}))
    index = np.asarray(keep, dtype=int)
    return x[index], y[index]


def _points(x: np.ndarray, y: np.ndarray) -> str:
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))


def line(axes: Axes, x: np.ndarray, y: np.ndarray, css: str, limit: int = 600) -> str:
    """A line, broken where the data are; `css` names its colour."""
    x, y = thin(np.asarray(x, dtype=float), np.asarray(y, dtype=float), limit)
    px, py = axes.px(x), axes.py(y)
    parts = []
    for a, b in _finite_stretches(px, py):
        if a.size == 1:
            parts.append(f'<circle class="dot {css}" cx="{a[0]:.1f}" cy="{b[0]:.1f}"/>')
        else:
            parts.append(f'<polyline class="line {css}" points="{_points(a, b)}"/>')
    return "".join(parts)


def dots(axes: Axes, x: np.ndarray, y: np.ndarray, css: str) -> str:
    """A small disc at each finite point."""
    px, py = axes.px(x), axes.py(y)
    return "".join(
        f'<circle class="dot {css}" cx="{a:.1f}" cy="{b:.1f}" r="3.2"/>'
        for a, b in zip(px, py, strict=True)
        if np.isfinite(a) and np.isfinite(b)
    )


def band(
    axes: Axes,
    x: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    css: str,
    limit: int = 300,
) -> str:
    """The area between two curves."""
    stride = max(1, math.ceil(x.size / limit))
    gaps = ~np.isfinite(low) | ~np.isfinite(high)
    keep = np.zeros(x.size, dtype=bool)
    keep[::stride] = True
    keep |= gaps
    columns = axes.px(x[keep]), axes.py(low[keep]), axes.py(high[keep])
    return "".join(
        f'<polygon class="band {css}" points="'
        f'{_points(np.r_[a, a[::-1]], np.r_[b, c[::-1]])}"/>'
        for a, b, c in _finite_stretches(*columns)
    )


def upright(axes: Axes, x: float, css: str) -> str:
    """A vertical line across the field."""
    at = f"{float(axes.px(x)):.1f}"
    return (
        f'<line class="rule {css}" x1="{at}" x2="{at}" y1="0" y2="{axes.size[1]:.1f}"/>'
    )


def level(axes: Axes, y: float, css: str, words: str) -> str:
    """A horizontal line across the field with a few words on it."""
    at, width = float(axes.py(y)), axes.size[0]
    below = at + 14 if at < 16 else at - 5
    return (
        f'<line class="rule {css}" x1="0" x2="{width:.1f}" y1="{at:.1f}" '
        f'y2="{at:.1f}"/>'
        f'<text class="note" x="{width - 4:.1f}" y="{below:.1f}" '
        f'text-anchor="end">{escape(words)}</text>'
    )


def _frame(axes: Axes) -> str:
    """Grid, tick labels and the name of the x axis."""
    width, height = axes.size
    left = axes.left
    parts = []
    if axes.y_labels:
        for value, text in ticks(*axes.y):
            y = _TOP + float(axes.py(value))
            parts.append(
                f'<line class="grid" x1="{left:.1f}" x2="{left + width:.1f}" '
                f'y1="{y:.1f}" y2="{y:.1f}"/><text class="tick" x="{left - 5:.1f}" '
                f'y="{y + 4:.1f}" text-anchor="end">{text}</text>'
            )
    below = _TOP + height + 16
    inline = 12.0 if 0 < len(axes.x_label) < 4 else 0.0
    marks = (
        log_ticks(*axes.x)
        if axes.log_x
        else ticks(*axes.x, count=5, least=1.0 if axes.whole else 0.0)
    )
    for value, text in marks:
        x = left + float(axes.px(value))
        parts.append(
            f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{_TOP + height:.1f}" '
            f'y2="{_TOP + height + 4:.1f}"/>'
        )
        half = _DIGIT_WIDTH * len(text) / 2
        if x + half < axes.width - 2 - inline:
            parts.append(
                f'<text class="tick" x="{x:.1f}" y="{below:.1f}" '
                f'text-anchor="middle">{text}</text>'
            )
    parts.append(
        f'<line class="axis" x1="{left:.1f}" x2="{left + width:.1f}" '
        f'y1="{_TOP + height:.1f}" y2="{_TOP + height:.1f}"/>'
    )
    parts.append(
        f'<text class="tick" x="{axes.width - 2:.1f}" y="{axes.height - 6:.1f}" '
        f'text-anchor="end">{escape(axes.x_label)}</text>'
    )
    return "".join(parts)


def chart(
    axes: Axes,
    marks: Sequence[str],
    *,
    title: str,
    said: str,
    unit: str = "",
    remark: str = "",
) -> Markup:
    """A titled chart; `marks` are drawn in their order, cut at the field's edge.

    `said` describes the chart for those who cannot see it.
    """
    width, height = axes.size
    words = f"{title} [{unit}]: {said}" if unit else f"{title}: {said}"
    aside = (
        f'<text class="tick" x="{axes.width - 2:.1f}" y="15" '
        f'text-anchor="end">{escape(remark)}</text>'
        if remark
        else ""
    )
    tail = f'<tspan class="unit"> {escape(unit)}</tspan>' if unit else ""
    return Markup(
        f'<svg viewBox="0 0 {axes.width:g} {axes.height:g}" role="img" '
        f'aria-label="{escape(words)}">'
        f'<text class="title" x="2" y="15">{escape(title)}{tail}</text>{aside}'
        f"{_frame(axes)}"
        f'<svg x="{axes.left:.1f}" y="{_TOP:g}" width="{width:.1f}" '
        f'height="{height:.1f}">{"".join(marks)}</svg></svg>'
    )
