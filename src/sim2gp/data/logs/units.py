"""Units of a column: what the file holds, turned into what the system speaks.

``1 deg = pi/180 rad``, ``1 rpm = 2 pi/60 rad/s`` and so on: each unit is a factor to
the base unit of its kind, and two units convert when their kinds agree.
"""

from math import pi

from sim2gp.errors import error, nearest

#: unit -> (kind, factor to the base unit of the kind)
UNITS: dict[str, tuple[str, float]] = {
    "rad": ("angle", 1.0),
    "deg": ("angle", pi / 180),
    "turn": ("angle", 2 * pi),
    "m": ("length", 1.0),
    "cm": ("length", 1e-2),
    "mm": ("length", 1e-3),
    "s": ("time", 1.0),
    "ms": ("time", 1e-3),
    "us": ("time", 1e-6),
    "ns": ("time", 1e-9),
    "rad/s": ("angular velocity", 1.0),
    "deg/s": ("angular velocity", pi / 180),
    "turn/s": ("angular velocity", 2 * pi),
    "rpm": ("angular velocity", 2 * pi / 60),
    "m/s": ("velocity", 1.0),
    "cm/s": ("velocity", 1e-2),
    "mm/s": ("velocity", 1e-3),
    "V": ("voltage", 1.0),
    "mV": ("voltage", 1e-3),
    "A": ("current", 1.0),
    "mA": ("current", 1e-3),
    "N": ("force", 1.0),
    "N m": ("torque", 1.0),
    "mN m": ("torque", 1e-3),
}


def unit_factor(unit: str | None, target: str, where: str) -> float:
    """What a number in ``unit`` is multiplied by to be in ``target`` (E107, E160)."""
    if unit is None or unit == target:
        return 1.0
    if unit not in UNITS:
        close = nearest(unit, UNITS)
        raise error(
            "unknown_unit",
            where=where,
            got=repr(unit),
            known=", ".join(UNITS),
            fix=f"did you mean {close!r}" if close else f"use {target!r}",
        )
    if target not in UNITS or UNITS[unit][0] != UNITS[target][0]:
        raise error(
            "unit_of_another_kind",
            where=where,
            got=f"{unit!r}, a unit of {UNITS[unit][0]}",
            target=repr(target),
        )
    return UNITS[unit][1] / UNITS[target][1]
