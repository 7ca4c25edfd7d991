"""Where an effect can be: its machines and channels, and the units it has there."""

from collections.abc import Mapping

from sim2gp.errors import InputError
from sim2gp.systems.base import AbstractPlant, AbstractSystem, Channel, index_of
from sim2gp.systems.mechanism import AbstractMechanism


def only_on(name: str, plant: AbstractPlant, homes: Mapping[type, str]) -> None:
    """Refuse an effect on a machine or a channel that cannot have it (E145)."""
    where, what = name.rsplit(".", 1)
    for kind, channel in homes.items():
        if isinstance(plant, kind) and where == channel:
            return
    raise InputError(
        "E145",
        f"{what} of this machine",
        got=f"{where} of {type(plant).__name__}",
        expected=" or ".join(f"{c} of {k.__name__}" for k, c in homes.items()),
    )


def gravity_of(system: AbstractMechanism) -> float:
    """Acceleration of gravity, m/s^2, of a machine that has any."""
    return float(system.gravity)  # type: ignore[attr-defined]


def joints_of(system: AbstractSystem) -> list[Channel]:
    """The positions among the states: of hinges in rad, of slides in m."""
    return [c for c in system.physical_states if c.unit in ("rad", "m")]


def joint_of(plant: AbstractPlant, name: str) -> Channel:
    """A joint by the name of its position (E103)."""
    joints = joints_of(plant)
    return joints[index_of(name, joints)]


def velocity_of(plant: AbstractPlant, name: str) -> int:
    """Index of a joint's velocity among the states (E103)."""
    joint_of(plant, name)
    return index_of(f"{name}.velocity", plant.physical_states)


def force_unit(plant: AbstractPlant, name: str) -> str:
    """N on a slide, N m on a hinge; of a plant without a mass matrix acceleration."""
    position = joint_of(plant, name).unit
    if isinstance(plant, AbstractMechanism):
        return "N" if position == "m" else "N m"
    velocity_of(plant, name)
    return f"{position}/s^2"


def unit_per(
    plant: AbstractPlant, name: str, seconds: str, square: bool = False
) -> str:
    """Unit of a force per position, per velocity, or per squared velocity."""
    force, position = force_unit(plant, name), joint_of(plant, name).unit
    if not isinstance(plant, AbstractMechanism):
        return {"": "1/s^2", " s": "1/s"}.get(seconds, f"1/{position}")
    power = "^2" if square else ""
    return f"{force}{seconds}/{position}{power}"
