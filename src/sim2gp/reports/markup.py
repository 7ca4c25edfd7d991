"""Words, numbers and tables of a report, always escaped.

Every string that comes from a run passes through `esc`; text that already is
markup is a `Raw` and passes as it is.
"""

import math
import re
from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources
from numbers import Integral, Real

import numpy as np

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SCIENTIFIC_BELOW = -3  # 0.001 is the last power of ten written out
_SCIENTIFIC_FROM = 5
MISSING = "–"


class Raw(str):
    """Text that is markup already and is not escaped again."""

    __slots__ = ()


def esc(text: object) -> str:
    """The text with everything that HTML would read as markup escaped."""
    return text if isinstance(text, Raw) else escape(str(text), quote=True)


def is_number(value: object) -> bool:
    """Whether the value is a finite real number (and not a truth value)."""
    if isinstance(value, bool | np.bool_):
        return False
    return isinstance(value, Real) and math.isfinite(value)


def _exponent(value: float) -> int:
    return 0 if value == 0 else math.floor(math.log10(abs(value)))


def _shared_exponent(*values: float) -> int:
    """The power of ten to factor out so that the values read well; 0 for none."""
    exponent = _exponent(max(abs(value) for value in values))
    return 0 if _SCIENTIFIC_BELOW <= exponent < _SCIENTIFIC_FROM else exponent


def power_of_ten(exponent: int) -> str:
    """A power of ten as it is written by hand."""
    return f"10{str(exponent).translate(_SUPERSCRIPT)}"


def unit_text(unit: object) -> str:
    """A unit with its powers raised: "kg m^2" becomes "kg m²"."""
    return re.sub(r"\^(-?\d+)", lambda m: m[1].translate(_SUPERSCRIPT), str(unit or ""))


def name_text(name: object) -> Raw:
    """A name in bold that may break after an underscore, a slash or a dot."""
    breakable = re.sub(r"([_/.])(?=\w)", r"\1<wbr>", esc(name))
    return Raw(f"<b>{breakable}</b>")


def _power(exponent: int) -> str:
    return f" × {power_of_ten(exponent)}" if exponent else ""


def _fixed(value: float, decimals: int) -> str:
    text = f"{value:.{max(decimals, 0)}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def number(value: object, digits: int = 3) -> str:
    """The number with so many significant digits, or a dash where there is none."""
    if not is_number(value):
        return MISSING
    x = float(value)  # type: ignore[arg-type]
    if isinstance(value, Integral) and abs(x) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    exponent = _shared_exponent(x)
    if exponent == 0 and abs(x) >= 10_000:
        return number(round(x))
    scaled = x / 10.0**exponent
    return _fixed(scaled, digits - 1 - _exponent(scaled)) + _power(exponent)


def plus_minus(mean: object, sd: object) -> str:
    """Mean and standard deviation to the two leading digits of the latter."""
    if not (is_number(mean) and is_number(sd)):
        return number(mean)
    m, s = float(mean), float(sd)  # type: ignore[arg-type]
    if s <= 0:
        return number(m)
    exponent = _shared_exponent(m, s)
    decimals = 1 - _exponent(s / 10.0**exponent)
    m, s = m / 10.0**exponent, s / 10.0**exponent
    text = f"{_fixed(m, decimals)} ± {_fixed(s, decimals)}"
    return f"({text}){_power(exponent)}" if exponent else text


def interval(low: object, high: object) -> str:
    """An interval with as many digits as its width deserves."""
    if not (is_number(low) and is_number(high)):
        return MISSING
    a, b = float(low), float(high)  # type: ignore[arg-type]
    if a > 0 and b > 20 * a:  # decades apart: each with its own digits
        return f"{number(a, 2)} to {number(b, 2)}"
    exponent = _shared_exponent(a, b)
    a, b = a / 10.0**exponent, b / 10.0**exponent
    decimals = 1 - _exponent((b - a) / 4) if b > a else 3
    text = f"{_fixed(a, decimals)} to {_fixed(b, decimals)}"
    return f"({text}){_power(exponent)}" if exponent else text


def percent(share: object) -> str:
    """A share as a percentage."""
    if not is_number(share):
        return MISSING
    value = 100 * float(share)  # type: ignore[arg-type]
    return f"{value:.1f} %"


def duration(seconds: object) -> str:
    """Seconds in words that fit their size."""
    if not is_number(seconds):
        return MISSING
    s = float(seconds)  # type: ignore[arg-type]
    if s < 100:
        return f"{number(s)} s"
    minutes, rest = divmod(round(s), 60)
    if minutes < 100:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def table(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    words: Sequence[int],
    cards: bool = False,
) -> Raw:
    """A table that scrolls sideways where it does not fit; `words`: text columns.

    With `cards` every row becomes a card of its own on a narrow screen.
    """

    right = "", ' class="n"'

    def cell(index: int, text: str) -> str:
        css = [] if index in words else ["n"]
        if not cards:
            return f"<td{right[index not in words]}>{text}</td>"
        # A card begins with the first column and its words, without their titles.
        if index and index == len(columns) - 1 and index in words:
            css.append("said")
        css += [] if text else ["void"]
        title = f' data-name="{esc(columns[index])}"' if columns[index] else ""
        return f'<td class="{" ".join(css)}"{title}><div>{text}</div></td>'

    head = "".join(
        f"<th>{esc(title)}</th>"
        if index in words
        else f'<th class="n">{esc(title)}</th>'
        for index, title in enumerate(columns)
    )
    lines = ("".join(cell(i, esc(x)) for i, x in enumerate(row)) for row in rows)
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    css = ' class="as-cards"' if cards else ""
    return Raw(
        f'<div class="scroll"><table{css}>\n'
        f"<thead><tr>{head}</tr></thead>\n"
        f"<tbody>\n{body}</tbody></table></div>\n"
    )


def listing(items: Iterable[object]) -> Raw:
    """An unordered list."""
    inner = "".join(f"<li>{esc(item)}</li>\n" for item in items)
    return Raw(f"<ul>\n{inner}</ul>\n" if inner else "")


def paragraph(text: object, css: str = "") -> Raw:
    """One paragraph."""
    attribute = f' class="{css}"' if css else ""
    return Raw(f"<p{attribute}>{esc(text)}</p>\n")


def legend(entries: Sequence[tuple[str, str]]) -> Raw:
    """The key of the drawings that follow: pairs of colour class and words."""
    keys = " ".join(
        f'<span class="key"><i class="{css}"></i>{esc(words)}</span>'
        for css, words in entries
    )
    return Raw(f'<p class="legend">{keys}</p>\n')


def cards(figures: Iterable[str], css: str = "cards") -> Raw:
    """Drawings side by side, as many as fit the width of the screen."""
    inner = "".join(f"<figure>{figure}</figure>\n" for figure in figures)
    return Raw(f'<div class="{css}">\n{inner}</div>\n' if inner else "")


def section(anchor: str, title: str, *parts: str) -> Raw:
    """A titled section, or nothing if all its parts are empty."""
    inner = "".join(parts)
    if not inner:
        return Raw("")
    return Raw(f'<section id="{anchor}">\n<h2>{esc(title)}</h2>\n{inner}</section>\n')


def asset(name: str) -> str:
    """The text of a file beside this module."""
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def page(title: str, body: str, script: str) -> str:
    """The whole document: nothing in it is fetched from anywhere."""
    tail = f"<script>\n{script}</script>\n" if script else ""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{esc(title)}</title>\n<style>\n{asset('page.css')}</style>\n</head>\n"
        f"<body>\n<main>\n{body}</main>\n{tail}</body>\n</html>\n"
    )
