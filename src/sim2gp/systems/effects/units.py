"""Where an effect can be: its machines and channels, and the units it has there."""

from collections.abc import Mapping

from sim2gp.errors import InputError
from sim2gp.systems.base import AbstractMechanism


def only_on(name: str, system: AbstractMechanism, homes: Mapping[type, str]) -> None:
    """Refuse an effect on a machine or a channel that cannot have it (E145)."""
    where, what = name.rsplit(".", 1)
    for kind, channel in homes.items():
        if isinstance(system, kind) and where == channel:
            return
    raise InputError(
        "E145",
        f"{what} of this machine",
        got=f"{where} of {type(system).__name__}",
        expected=" or ".join(f"{c} of {k.__name__}" for k, c in homes.items()),
    )


def gravity_of(system: AbstractMechanism) -> float:
    """Acceleration of gravity, m/s^2, of a machine that has any."""
    return float(system.gravity)  # type: ignore[attr-defined]


def force_unit(system: AbstractMechanism, name: str) -> str:
    """N on a slide, N m on a hinge."""
    return "N" if system.states[system.joint(name)].unit == "m" else "N m"


def unit_per(
    system: AbstractMechanism, name: str, seconds: str, square: bool = False
) -> str:
    """Unit of a force per position, or per squared velocity."""
    position = system.states[system.joint(name)].unit
    power = "^2" if square else ""
    return f"{force_unit(system, name)}{seconds}/{position}{power}"
