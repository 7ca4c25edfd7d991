"""What a simulator may lack: every effect by what it acts on, and what to try.

One list serves all who add physics to a machine: the search for missing physics
(`candidates`), the mismatch map (`sim2gp.systems.effects.strengths`) and project files
(`named`, `possible`).

A candidate adds one scalar to a machine: the magnitude of an effect with a Gaussian
prior around nothing, a delay, or the time constant of a low pass. Priors are a fifth of
what the machine itself does, so that no candidate is favoured by its unit: a force by
the largest of its motor or weight, a stiffness and a drag by that force at a typical
position and speed, a dead zone by the input's range. A force on a joint that is listed
in `FORCES` is a candidate of every machine: its powers give its unit and its prior.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from sim2gp.errors import InputError
from sim2gp.systems.actuators import AbstractActuator, Delay, Gain, Lag, Offset
from sim2gp.systems.base import AbstractPlant, AbstractSystem
from sim2gp.systems.effects.base import (
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointEffect,
    AbstractJointForce,
    check_effect,
)
from sim2gp.systems.effects.friction import (
    Coulomb,
    Drag,
    RailFriction,
    Stribeck,
    Viscous,
)
from sim2gp.systems.effects.geometry import PoleGeometry, RodInertia
from sim2gp.systems.effects.inputs import DeadZone
from sim2gp.systems.effects.loads import BaseTilt, BaseTiltSide, Payload, RailTilt
from sim2gp.systems.effects.scales import drives
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.effects.tables import InputTable, PositionTable, VelocityTable
from sim2gp.systems.effects.units import joint_of
from sim2gp.systems.machine import Machine, plant_of
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.systems.parts import AbstractPart
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.systems.plants.two_link import TwoLink, UniformRodArm
from sim2gp.systems.sensors import EncoderOffset

#: On every joint. Each of these is a candidate too: `_force` gives it a prior.
FORCES: tuple[type[AbstractJointForce], ...] = (
    Coulomb,
    Stribeck,
    Spring,
    Drag,
    Viscous,
)
_JOINT: tuple[Any, ...] = (*FORCES, EncoderOffset, PositionTable, VelocityTable)
#: Every part by what it acts on; `possible` says which machines can have it.
REGISTRY: dict[str, tuple[Any, ...]] = {
    "hinge": (*_JOINT, BaseTilt, BaseTiltSide, Payload, PoleGeometry, RodInertia),
    "slide": (*_JOINT, RailFriction, RailTilt),
    "input": (DeadZone, InputTable, Gain, Offset, Delay, Lag),
}
#: Names in project files that are no longer a part's own.
ALIASES: dict[str, Any] = {"back_emf": Viscous}
_BY_NAME: dict[str, Any] = {
    kind.what: kind
    for kinds in REGISTRY.values()
    for kind in kinds
    if not issubclass(kind, AbstractActuator)  # these have tables of their own
}
#: Effects by the last part of their parameter's name, ``<channel>.<effect>``.
NAMES = tuple(sorted(_BY_NAME))

SHARE = 0.2  # of what the machine does: the prior sd of an effect
OFFSET = 0.05  # rad, prior sd of a tilt or of an encoder's zero
LONGEST = 0.04  # s, of a delay or a time constant


def named(what: str, where: str, magnitude: float, **options: Any) -> AbstractPart:
    """An effect by its name in a project file; `KeyError` for an unknown one."""
    if what in ALIASES:
        made: AbstractPart = ALIASES[what](where, magnitude, what=what, **options)
        return made
    kind: Any = _BY_NAME[what]
    found: AbstractPart = kind(where=where, magnitude=magnitude, **options)
    return found


def options_of(what: str) -> tuple[str, ...]:
    """The options of an effect, without its channel, magnitude and name."""
    return _options(ALIASES.get(what) or _BY_NAME[what])


def _options(kind: Any) -> tuple[str, ...]:
    return tuple(f.name for f in dataclasses.fields(kind)[2:] if f.name != "what")


def possible(plant: AbstractPlant, what: str, where: str) -> bool:
    """Whether a plant can have an effect: it changes its equations in motion.

    The zero of an encoder does not where nothing depends on the joint's position.
    """
    try:
        part = named(what, where, 1.0)
        if not isinstance(part, AbstractInputEffect):
            kind = "slide" if joint_of(plant, where).unit == "m" else "hinge"
            if type(part) not in REGISTRY[kind]:
                return False
        part.unit(plant)
        if isinstance(part, AbstractEffect):
            check_effect(plant, part)
    except (InputError, KeyError):
        return False
    if isinstance(part, AbstractInputEffect) or not isinstance(
        plant, AbstractMechanism
    ):
        return True
    q, v, params = jnp.full(2, 0.7), jnp.full(2, 0.9), plant.nominal()
    a = jnp.asarray([min(0.3 * channel.high, 1.0) for channel in plant.actions])
    true = q.at[plant.joint(where)].add(1.0) if isinstance(part, EncoderOffset) else q
    added = [(part, jnp.ones(()))] if isinstance(part, AbstractJointEffect) else []
    (M, f), (M2, f2) = (
        plant.equations(params, effects, at, v, a)
        for effects, at in (((), q), (added, true))
    )
    return bool(jnp.any(jnp.stack([*M, *f]) != jnp.stack([*M2, *f2])))


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One effect, sensor or actuator to be tried on a machine.

    The ``magnitude`` of ``effect`` is its prior sd, or the longest delay or lag.
    ``sign`` is +1 where only positive values are physical, 0 where both are. ``grid``
    are magnitudes at which the effect is linearised: zero alone where it is smooth
    there.
    """

    effect: AbstractPart
    sign: int = 1
    grid: tuple[float, ...] = (0.0,)

    @property
    def name(self) -> str:
        """Name of its parameter: ``<where>.<what>``."""
        return self.effect.name

    @property
    def smooth(self) -> bool:
        """Whether the derivative at nothing says what the effect does."""
        return self.grid == (0.0,)


def candidates(
    system: AbstractSystem, *, windows: bool = False
) -> tuple[Candidate, ...]:
    """Every candidate for a machine, without those that its table has already.

    Over ``windows`` a lag is left to its equivalent, a delay.
    """
    plant = plant_of(system)
    found = _physics(plant)
    for channel in plant.actions:
        high = channel.high if math.isfinite(channel.high) else 1.0
        found += _of_input(channel.name, high, lag=not windows)
    return _new(found, system)


def _new(found: Sequence[Candidate], system: AbstractSystem) -> tuple[Candidate, ...]:
    """Those that the machine does not have already."""
    table = system.parameters
    there = {*table.names, *(name for name, value in table.fixed if value != 0.0)}
    parts = system.parts if isinstance(system, Machine) else ()
    held = {
        (type(p), p.where)
        for p in parts
        if not isinstance(p, AbstractActuator) or p.name in there
    }
    return tuple(
        c
        for c in found
        if c.name not in there and (type(c.effect), c.effect.where) not in held
    )


def _physics(plant: AbstractPlant) -> list[Candidate]:
    if isinstance(plant, Furuta):
        return _furuta()
    if isinstance(plant, CartPole):
        return _cartpole()
    if isinstance(plant, TwoLink | UniformRodArm):
        return _arm(plant)
    return _of_any(plant)


def _of_input(name: str, high: float, *, lag: bool) -> list[Candidate]:
    width = SHARE * high
    late = (0.004, 0.012, 0.026)
    return [
        Candidate(DeadZone(name, width), grid=(0.25 * width, 0.5 * width, width)),
        Candidate(Delay(name, LONGEST), grid=late),
        *([Candidate(Lag(name, LONGEST), grid=late)] if lag else []),
    ]


class _Joint(NamedTuple):
    """What moves a joint, and how it moves: rad and rad/s of a hinge.

    ``force`` is in N or N m, or an acceleration where a plant has no mass matrix.
    ``width`` and ``slip`` are the speeds of a friction's sign and of its fall.
    """

    name: str
    force: float
    speed: float = 10.0  # typical
    reach: float = 1.0  # likewise
    width: float = 0.05
    slip: float = 1.0


def _slide(name: str, force: float) -> _Joint:
    """Of a slide, in m and m/s."""
    return _Joint(name, force, speed=1.0, reach=0.3, width=0.01, slip=0.1)


def _force(kind: type[AbstractJointForce], joint: _Joint) -> Candidate:
    """A force ``x q^i v^j`` on a joint, at its typical position and speed."""
    of_position, of_velocity = kind.powers
    sd = SHARE * joint.force / (joint.reach**of_position * joint.speed**of_velocity)
    speeds = {"width": joint.width, "speed": joint.slip}
    options = {k: x for k, x in speeds.items() if k in _options(kind)}
    made: Any = kind
    return Candidate(made(joint.name, sd, **options))


def _other_forces(joint: _Joint) -> list[Candidate]:
    """All forces but dry friction, which comes first."""
    return [_force(kind, joint) for kind in FORCES if kind is not Coulomb]


def _of_joint(joint: _Joint) -> list[Candidate]:
    """All that any joint may lack."""
    offset = Candidate(EncoderOffset(joint.name, OFFSET), sign=0)
    return [_force(Coulomb, joint), *_other_forces(joint), offset]


def _furuta() -> list[Candidate]:
    # The motor's stall torque at 5 V; the pendulum's weight at its lever arm.
    arm, pendulum = _Joint("theta", 0.025), _Joint("alpha", 0.015, speed=15.0)
    return [
        _force(Coulomb, arm),
        _force(Coulomb, pendulum),
        *_other_forces(arm),
        *_other_forces(pendulum),
        Candidate(EncoderOffset("alpha", OFFSET), sign=0),
        Candidate(BaseTilt(magnitude=OFFSET), sign=0),
        Candidate(BaseTiltSide(magnitude=OFFSET), sign=0),
        Candidate(RodInertia()),
        Candidate(Payload("alpha", SHARE * 0.024)),
    ]


def _cartpole() -> list[Candidate]:
    # The motor's stall force at 10 V; the pole's weight at its lever arm.
    cart, pole = _slide("x", 12.6), _Joint("theta", 0.21)
    return [
        Candidate(RailFriction(magnitude=SHARE * 0.5)),
        _force(Coulomb, pole),
        *_other_forces(cart),
        *_other_forces(pole),
        Candidate(EncoderOffset("theta", OFFSET), sign=0),
        Candidate(RailTilt(magnitude=OFFSET), sign=0),
        Candidate(PoleGeometry(), sign=0),
        Candidate(Payload("theta", SHARE * 0.127)),
    ]


def _arm(plant: TwoLink | UniformRodArm) -> list[Candidate]:
    found = []
    for joint, channel in zip(plant.states[:2], plant.actions, strict=True):
        found += _of_joint(_Joint(joint.name, channel.high))
    return found


def _of_any(plant: AbstractPlant) -> list[Candidate]:
    """Of each joint whose velocity is a state, as large as what moves it.

    Without a mass matrix an effect is a kick: an acceleration.
    """
    kicks = not isinstance(plant, AbstractMechanism)
    found: list[Candidate] = []
    for name, drive in drives(plant).items():
        made = _slide if joint_of(plant, name).unit == "m" else _Joint
        found += _of_joint(made(name, drive.acceleration if kicks else drive.force))
    return found
