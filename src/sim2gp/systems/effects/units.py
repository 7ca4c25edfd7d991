"""Where an effect can be: its machines and channels, and the units it has there."""

from collections.abc import Mapping, Sequence

from sim2gp.errors import error
from sim2gp.systems.base import AbstractPlant, AbstractSystem, Channel, index_of
from sim2gp.systems.mechanism import AbstractMechanism, takes_forces


def only_on(name: str, plant: AbstractPlant, homes: Mapping[type, str]) -> None:
    """Refuse an effect on a machine or a channel that cannot have it (E145)."""
    where, what = name.rsplit(".", 1)
    for kind, channel in homes.items():
        if isinstance(plant, kind) and where == channel:
            return
    got = f"{where} of {type(plant).__name__}"
    expected = " or ".join(f"{c} of {k.__name__}" for k, c in homes.items())
    raise error("effect_of_other_machine", got=got, expected=expected, effect=what)


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
    """Of a missing force: N on a slide, N m on a hinge, or an acceleration
    (`takes_forces`)."""
    return _unit(plant, name, (0, 0), takes_forces(plant))


def law_unit(plant: AbstractPlant, name: str, powers: tuple[int, int]) -> str:
    """Unit of ``x`` in a force ``x q^i v^j`` on a joint, ``powers`` being ``(i, j)``.

    An acceleration of a plant without a mass matrix. Raises `InputError` E103 for a
    joint that is not there.
    """
    return _unit(plant, name, powers, isinstance(plant, AbstractMechanism))


def _unit(
    plant: AbstractPlant, name: str, powers: tuple[int, int], is_force: bool
) -> str:
    of_position, of_velocity = powers
    position = joint_of(plant, name).unit
    length, seconds = -of_position - of_velocity, of_velocity
    if is_force:
        force = [("N", 1)] if position == "m" else [("N", 1), ("m", 1)]
        return _written([*force, ("s", seconds), (position, length)])
    velocity_of(plant, name)
    return _written([(position, length + 1), ("s", seconds - 2)])


def _written(units: Sequence[tuple[str, int]]) -> str:
    """A product of powers of units: ``N m s^2/rad^2``, ``1/(rad^2 s^2)``."""
    above = [_power(unit, power) for unit, power in units if power > 0]
    below = [_power(unit, -power) for unit, power in units if power < 0]
    over = " ".join(above) or "1"
    if not below:
        return over
    under = " ".join(below)
    return f"{over}/({under})" if len(below) > 1 else f"{over}/{under}"


def _power(unit: str, power: int) -> str:
    return unit if power == 1 else f"{unit}^{power}"
