"""Numbers, units, combinations of parameters and their bounds as text."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np


def digits(x: float, count: int = 3) -> str:
    """So many significant digits, without an exponent where that stays short."""
    if x != 0.0 and 1e-4 <= abs(x) < 10.0**count:
        places = max(count - 1 - math.floor(math.log10(abs(x))), 0)
        text = f"{x:.{places}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{x:.0f}" if 1.0 <= abs(x) < 1e5 else f"{x:.{count}g}"


def quantity(x: float, unit: str) -> str:
    """A number and its unit."""
    return f"{digits(x, 4)} {unit}".strip()


def finite_or_none(x: float) -> float | None:
    """JSON has no infinity: an open end is null."""
    return float(x) if math.isfinite(x) else None


def join_names(names: Iterable[str]) -> str:
    """a, b and c."""
    *head, last = names
    return f"{', '.join(head)} and {last}" if head else last


def descending_order(sizes: np.ndarray) -> list[int]:
    """Positions by falling size; sizes equal up to rounding keep their order."""
    steps = np.round(sizes / max(float(np.max(sizes, initial=0.0)), 1e-300), 6)
    return [int(j) for j in np.argsort(-steps, kind="stable")]


def weighted_sum(weights: np.ndarray, names: Sequence[str]) -> str:
    """``0.9 a + 0.2 b``, largest terms first, those below a fifth of it left out.

    A single term is its name alone, without its weight.
    """
    size = np.abs(weights)
    order = [j for j in descending_order(size) if size[j] > 0.2 * size.max()]
    if len(order) == 1:
        return names[order[0]]
    terms = linear_sum([(float(weights[j]), names[j]) for j in order], 2)
    return f"{terms} (each in prior sd)"


def linear_sum(terms: Iterable[tuple[float, str]], count: int = 4) -> str:
    """``a + 0.2 b - c`` of the terms as they come."""
    text = ""
    for weight, name in terms:
        size = digits(abs(weight), count)
        size = "" if size == "1" else f"{size} "
        joint = " - " if weight < 0.0 else " + "
        text += (joint if text else joint.strip(" +")) + size + name
    return text


def product(terms: Iterable[tuple[float, str]]) -> str:
    """``a^2 b / (c d)`` of exponents and names."""
    above: list[str] = []
    below: list[str] = []
    for exponent, name in terms:
        power = digits(abs(exponent), 3)
        text = name if power == "1" else f"{name}^{power}"
        (above if exponent > 0.0 else below).append(text)
    top = " ".join(above) or "1"
    if not below:
        return top
    return f"{top} / {below[0]}" if len(below) == 1 else f"{top} / ({' '.join(below)})"


def unit_product(terms: Iterable[tuple[float, str]]) -> str:
    """The unit of a product of powers, like symbols cancelled: ``kg m^2 s^-1``."""
    total: dict[str, float] = {}
    for exponent, unit in terms:
        for position, part in enumerate(unit.split("/")):
            side = exponent if position == 0 else -exponent
            for symbol, power in re.findall(r"([^\s^()]+)(?:\^(-?[\d.]+))?", part):
                if symbol != "1":
                    total[symbol] = total.get(symbol, 0.0) + side * float(power or 1)
    kept = [(s, p) for s, p in total.items() if abs(p) > 1e-9]
    kept.sort(key=lambda item: item[1] < 0.0)
    return " ".join(s if p == 1.0 else f"{s}^{digits(p, 3)}" for s, p in kept)


def bound_warnings(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """What to do about each parameter that the data press against an end of its range.

    At zero nothing: less than nothing cannot be, and the data show none of it.
    """
    found = {}
    for name, entry in entries.items():
        low, high = entry.get("low"), entry.get("high")
        if entry.get("verdict") != "at_bound" or low is None or high is None:
            continue
        is_upper = high - entry["mean"] < entry["mean"] - low
        end, word, way = (
            ("upper", "high", "larger") if is_upper else ("lower", "low", "smaller")
        )
        if entry[word] != 0.0:
            found[name] = (
                f"{name} is at the {end} end of its range, "
                f"{quantity(entry[word], entry['unit'])}. If the true value is beyond "
                f"it, all values of this fit are wrong: write a {way} `{word}` in the "
                "project file, and run identify again."
            )
    return found
