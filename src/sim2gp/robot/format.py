"""The format of an exported policy: every field and array, its type, shape and rule.

A run directory (`sim2gp.runs`) whose summary has a table ``policy``, and whose arrays
are float32. With n states, m actions and layers of widths w_0 ... w_L::

    w_0 = n, or n + 1 with an angle (its sine and cosine)     w_L = 2 m (mean, spread)
    weights/i (w_i, w_i+1)   biases/i (w_i+1)   scale (n)   low, high (m)
"""

from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from sim2gp.errors import InputError, error
from sim2gp.runs.archive import Declared

FORMAT = 1
LARGEST = 2**28  # bytes of all arrays
LAYERS = 64
LONGEST = 200  # characters of a name or a unit
_HALF = float(np.finfo(np.float32).max) / 2.0

About = Mapping[str, Any]


def _is_whole(x: Any, low: int, high: int) -> bool:
    return type(x) is int and low <= x <= high


def _is_name(x: Any) -> bool:
    return isinstance(x, str) and x.isprintable() and 0 < len(x.strip()) <= LONGEST


def _are_names(x: Any) -> bool:
    return isinstance(x, list) and x != [] and all(map(_is_name, x)) and _differ(x)


def _differ(x: list[str]) -> bool:
    return len(set(x)) == len(x)


def _channel_names(about: About) -> list[str]:
    return [*about["states"], *about["actions"]]


def _are_units(x: Any, about: About) -> bool:
    named = isinstance(x, dict) and sorted(x) == sorted(_channel_names(about))
    return named and all(map(_is_name, x.values()))


def _angle(x: Any, about: About) -> bool:
    states = about["states"]
    known = _is_whole(x, 0, len(states) - 1)
    return x is None or (known and about["units"][states[x]] == "rad")


#: Fields of the header, each with its rule, which may ask of the fields above it.
FIELDS: dict[str, tuple[Callable[[Any, About], bool], str]] = {
    "format": (lambda x, _: _is_whole(x, FORMAT, FORMAT), f"{FORMAT}"),
    "layers": (
        lambda x, _: _is_whole(x, 1, LAYERS),
        f"a whole number from 1 to {LAYERS}",
    ),
    "states": (lambda x, _: _are_names(x), "a list of different names"),
    "actions": (
        lambda x, about: _are_names(x) and _differ([*about["states"], *x]),
        "a list of different names, none of a state",
    ),
    "units": (_are_units, "a unit for each state and action"),
    "angle": (_angle, "null, or the number of a state in rad"),
}
#: Rules of the arrays' values, next to being finite.
VALUES: tuple[tuple[Callable[[Mapping[str, np.ndarray]], bool], str], ...] = (
    (lambda x: bool((x["scale"] > 0.0).all()), "a positive scale of each state"),
    (lambda x: bool((x["low"] <= x["high"]).all()), "low at most high"),
    (
        lambda x: bool((x["high"] / 2.0 - x["low"] / 2.0 < _HALF).all()),
        "limits of actions whose difference is finite",
    ),
)


def header(summary: Mapping[str, Any], where: str) -> dict[str, Any]:
    """The checked table ``policy`` of a run's summary (E133, E185)."""
    about = summary.get("policy")
    if not isinstance(about, dict):
        raise not_a_policy(where, "another run")
    number = about.get("format")
    if type(number) is int and number > FORMAT:
        raise error("newer_policy", where=where, got=number, newest=FORMAT)
    for name, (rule, expected) in FIELDS.items():
        if name not in about:
            raise not_a_policy(where, f"no field {name}")
        if not rule(about[name], about):
            raise not_a_policy(where, f"a field {name} that is not {expected}")
    unknown = sorted(set(about) - set(FIELDS))
    if unknown:
        raise not_a_policy(where, f"an unknown field {unknown[0][:LONGEST]!r}")
    return about


def check_shapes(about: About, found: Mapping[str, Declared], where: str) -> None:
    """Refuse arrays that are not those of the header (E133)."""
    expected = _shapes(about, found)
    for name in sorted(set(found) | set(expected)):
        if name not in found:
            raise not_a_policy(where, f"no array {name}")
        if name not in expected:
            raise not_a_policy(where, f"an unknown array {name[:LONGEST]!r}")
        if found[name].dtype != np.float32:
            raise not_a_policy(where, f"array {name} of {found[name].dtype}")
        if found[name].shape != expected[name] or 0 in expected[name]:
            got = f"array {name} of shape {found[name].shape}"
            raise not_a_policy(where, f"{got}, not {expected[name]}")


def _shapes(about: About, found: Mapping[str, Declared]) -> dict[str, tuple[int, ...]]:
    """Of every array; a layer is as wide as its biases say, the last as actions ask."""
    n, m = len(about["states"]), len(about["actions"])
    widths = [n + (about["angle"] is not None)]
    for i in range(about["layers"] - 1):
        declared = found.get(f"biases/{i}")
        widths.append(declared.shape[0] if declared and declared.shape else 0)
    widths.append(2 * m)
    shapes: dict[str, tuple[int, ...]] = {"scale": (n,), "low": (m,), "high": (m,)}
    for i, (before, after) in enumerate(pairwise(widths)):
        shapes |= {f"weights/{i}": (before, after), f"biases/{i}": (after,)}
    return shapes


def check_values(arrays: Mapping[str, np.ndarray], where: str) -> None:
    """Refuse numbers that are not finite (E181) or cannot be what they are (E133)."""
    for name, x in arrays.items():
        bad = int(np.size(x) - np.isfinite(x).sum())
        if bad:
            place, got = f"{where}, array {name}", f"{bad} of {np.size(x)}"
            raise error("policy_not_finite", where=place, got=got)
    for rule, expected in VALUES:
        if not rule(arrays):
            raise not_a_policy(where, f"arrays without {expected}")


def not_a_policy(where: str, got: str) -> InputError:
    """E133: what is there is no policy of this format."""
    return error("not_a_policy", where=where, got=got, number=FORMAT)
