"""Numbers as a report writes them: as many digits as they deserve, and their units."""

import math
import re
from numbers import Integral, Real

import numpy as np

_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_SCIENTIFIC_BELOW = -3  # 0.001 is the last power of ten written out
_SCIENTIFIC_FROM = 5
MISSING = "–"


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


def _power_suffix(exponent: int) -> str:
    return f" × {power_of_ten(exponent)}" if exponent else ""


def _fixed_point(value: float, decimals: int) -> str:
    text = f"{value:.{max(decimals, 0)}f}"
    if float(text) == 0:
        text = text.lstrip("-")
    return text.replace("-", "−")


def format_number(value: object, digits: int = 3) -> str:
    """The number with so many significant digits, or a dash where there is none."""
    if not is_number(value):
        return MISSING
    x = float(value)  # type: ignore[arg-type]
    if isinstance(value, Integral) and abs(x) < 1e9:
        return f"{int(value):,}".replace(",", "\u202f").replace("-", "−")
    exponent = _shared_exponent(x)
    if exponent == 0 and abs(x) >= 10_000:
        return format_number(round(x))
    scaled = x / 10.0**exponent
    return _fixed_point(scaled, digits - 1 - _exponent(scaled)) + _power_suffix(
        exponent
    )


def plus_minus(mean: object, sd: object) -> str:
    """Mean and standard deviation to the two leading digits of the latter."""
    if not (is_number(mean) and is_number(sd)):
        return format_number(mean)
    m, s = float(mean), float(sd)  # type: ignore[arg-type]
    if s <= 0:
        return format_number(m)
    exponent = _shared_exponent(m, s)
    decimals = 1 - _exponent(s / 10.0**exponent)
    m, s = m / 10.0**exponent, s / 10.0**exponent
    text = f"{_fixed_point(m, decimals)} ± {_fixed_point(s, decimals)}"
    return f"({text}){_power_suffix(exponent)}" if exponent else text


def format_interval(low: object, high: object) -> str:
    """An interval with as many digits as its width deserves."""
    if not (is_number(low) and is_number(high)):
        return MISSING
    a, b = float(low), float(high)  # type: ignore[arg-type]
    if a > 0 and b > 20 * a:  # decades apart: each with its own digits
        return f"{format_number(a, 2)} to {format_number(b, 2)}"
    exponent = _shared_exponent(a, b)
    a, b = a / 10.0**exponent, b / 10.0**exponent
    decimals = 1 - _exponent((b - a) / 4) if b > a else 3
    text = f"{_fixed_point(a, decimals)} to {_fixed_point(b, decimals)}"
    return f"({text}){_power_suffix(exponent)}" if exponent else text


def format_percent(share: object) -> str:
    """A share as a percentage."""
    if not is_number(share):
        return MISSING
    value = 100 * float(share)  # type: ignore[arg-type]
    return f"{value:.1f} %"


def format_duration(seconds: object) -> str:
    """Seconds in words that fit their size."""
    if not is_number(seconds):
        return MISSING
    s = float(seconds)  # type: ignore[arg-type]
    if s < 100:
        return f"{format_number(s)} s"
    minutes, rest = divmod(round(s), 60)
    if minutes < 100:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"
