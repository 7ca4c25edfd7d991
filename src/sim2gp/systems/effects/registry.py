"""What a simulator may lack: every effect by what it acts on, and what to try.

One list serves all who add physics to a machine: the search for missing physics
(`candidates`), the corrected intervals (`smooth_effects`), the mismatch map
(`sim2gp.systems.effects.strengths`) and project files (`named`, `possible`).

A candidate adds one scalar to a machine: the magnitude of an effect with a Gaussian
prior around nothing, a delay, or the time constant of a low pass. Priors are a fifth of
what the machine itself does, so that no candidate is favoured by its unit: a force by
the largest of its motor or weight, a stiffness and a drag by that force at a typical
position and speed, a dead zone by the input's range.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.errors import InputError
from sim2gp.systems.actuators import AbstractActuator, Delay, Gain, Lag, Offset
from sim2gp.systems.base import LONGEST_MEAN, AbstractPlant, AbstractSystem
from sim2gp.systems.effects.base import (
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointEffect,
    check_effect,
)
from sim2gp.systems.effects.forces import BaseTilt, BaseTiltSide, Payload, RailTilt
from sim2gp.systems.effects.friction import (
    Coulomb,
    Drag,
    RailFriction,
    Stribeck,
    Viscous,
)
from sim2gp.systems.effects.geometry import PoleGeometry, RodInertia
from sim2gp.systems.effects.inputs import DeadZone
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.effects.units import joint_of, joints_of, velocity_of
from sim2gp.systems.machine import Machine, plant_of
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.systems.parts import AbstractPart
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.systems.plants.two_link import TwoLink, UniformRodArm
from sim2gp.systems.sensors import EncoderOffset
from sim2gp.types import in_float64

_JOINT: tuple[Any, ...] = Coulomb, Stribeck, Viscous, Drag, Spring, EncoderOffset
#: Every part by what it acts on; `possible` says which machines can have it.
REGISTRY: dict[str, tuple[Any, ...]] = {
    "hinge": (*_JOINT, BaseTilt, BaseTiltSide, Payload, PoleGeometry, RodInertia),
    "slide": (*_JOINT, RailFriction, RailTilt),
    "input": (DeadZone, Gain, Offset, Delay, Lag),
}
#: Names in project files that are no longer a part's own.
ALIASES: dict[str, Any] = {"back_emf": Viscous}
_BY_NAME: dict[str, Any] = {
    kind.what: kind
    for kinds in REGISTRY.values()
    for kind in kinds
    if not issubclass(kind, AbstractActuator)  # these have tables of their own
}
#: Effects by the last part of their constant's name, ``<channel>.<effect>``.
NAMES = tuple(sorted(_BY_NAME))

SHARE = 0.2  # of what the machine does: the prior sd of an effect
OFFSET = 0.05  # rad, prior sd of a tilt or of an encoder's zero
LONGEST = 0.04  # s, of a delay or a time constant


def named(what: str, where: str, magnitude: float, **options: float) -> AbstractPart:
    """An effect by its name in a project file; `KeyError` for an unknown one."""
    if what in ALIASES:
        made: AbstractPart = ALIASES[what](where, magnitude, what=what, **options)
        return made
    kind: Any = _BY_NAME[what]
    found: AbstractPart = kind(where=where, magnitude=magnitude, **options)
    return found


def options_of(what: str) -> tuple[str, ...]:
    """What an effect has besides its channel, magnitude and name."""
    kind = ALIASES.get(what) or _BY_NAME[what]
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
        """Name of its constant: ``<where>.<what>``."""
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


def smooth_effects(system: AbstractSystem) -> tuple[AbstractPart, ...]:
    """What a machine may lack and whose slope at nothing says what it does.

    Each with its prior sd; none for a plant without a mass matrix, whose intervals
    rest on the scatter of its windows alone.
    """
    plant = plant_of(system)
    if not isinstance(plant, AbstractMechanism):
        return ()
    found = _new(_physics(plant), system)
    return tuple(candidate.effect for candidate in found if candidate.smooth)


def _new(found: Sequence[Candidate], system: AbstractSystem) -> tuple[Candidate, ...]:
    """Those that the machine does not have already."""
    table = system.parameters
    there = {*table.names, *(name for name, value in table.fixed if value != 0.0)}
    parts = system.parts if isinstance(system, Machine) else ()
    held = {(type(p), p.where) for p in parts if not isinstance(p, AbstractActuator)}
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


def _of_joint(
    name: str,
    force: float,
    speed: float,
    reach: float = 1.0,
    *,
    width: float = 0.05,
    slip: float = 1.0,
) -> list[Candidate]:
    """Stribeck friction, a spring, drag and damping.

    ``force`` in N or N m is what moves the joint, at a typical ``speed`` and ``reach``.
    """
    scale = SHARE * force
    return [
        Candidate(Stribeck(name, scale, width, slip)),
        Candidate(Spring(name, scale / reach)),
        Candidate(Drag(name, scale / speed**2)),
        Candidate(Viscous(name, scale / speed)),
    ]


def _furuta() -> list[Candidate]:
    # The motor's stall torque at 5 V; the pendulum's weight at its lever arm.
    arm, pendulum = 0.025, 0.015  # N m
    return [
        Candidate(Coulomb("theta", SHARE * arm)),
        Candidate(Coulomb("alpha", SHARE * pendulum)),
        *_of_joint("theta", arm, 10.0),
        *_of_joint("alpha", pendulum, 15.0),
        Candidate(EncoderOffset("alpha", OFFSET), sign=0),
        Candidate(BaseTilt(magnitude=OFFSET), sign=0),
        Candidate(BaseTiltSide(magnitude=OFFSET), sign=0),
        Candidate(RodInertia()),
        Candidate(Payload("alpha", SHARE * 0.024)),
    ]


def _cartpole() -> list[Candidate]:
    # The motor's stall force at 10 V; the pole's weight at its lever arm.
    cart, pole = 12.6, 0.21  # N, N m
    return [
        Candidate(RailFriction(magnitude=SHARE * 0.5)),
        Candidate(Coulomb("theta", SHARE * pole)),
        *_of_joint("x", cart, 1.0, 0.3, width=0.01, slip=0.1),
        *_of_joint("theta", pole, 10.0),
        Candidate(EncoderOffset("theta", OFFSET), sign=0),
        Candidate(RailTilt(magnitude=OFFSET), sign=0),
        Candidate(PoleGeometry(), sign=0),
        Candidate(Payload("theta", SHARE * 0.127)),
    ]


def _arm(plant: TwoLink | UniformRodArm) -> list[Candidate]:
    found = []
    for joint, channel in zip(plant.states[:2], plant.actions, strict=True):
        found += [
            Candidate(Coulomb(joint.name, SHARE * channel.high)),
            *_of_joint(joint.name, channel.high, 10.0),
            Candidate(EncoderOffset(joint.name, OFFSET), sign=0),
        ]
    return found


def _of_any(plant: AbstractPlant) -> list[Candidate]:
    """Of each joint whose velocity is a state, as large as what moves it."""
    found: list[Candidate] = []
    names, most = [c.name for c in plant.physical_states], _accelerations(plant)
    for joint in joints_of(plant):
        if f"{joint.name}.velocity" not in names:
            continue
        slide = joint.unit == "m"
        width, slip = (0.01, 0.1) if slide else (0.05, 1.0)
        speed, reach = (1.0, 0.3) if slide else (10.0, 1.0)
        force = most[velocity_of(plant, joint.name)]
        found += [
            Candidate(Coulomb(joint.name, SHARE * force, width)),
            *_of_joint(joint.name, force, speed, reach, width=width, slip=slip),
            Candidate(EncoderOffset(joint.name, OFFSET), sign=0),
        ]
    return found


@in_float64
def _accelerations(plant: AbstractPlant) -> list[float]:
    """The largest slope of each state that inputs and weight give at rest, per second.

    With nominal constants; 1 for a state that does not move.
    """
    params, joints = plant.nominal(), joints_of(plant)
    away = np.asarray([0.5 * (c in joints) for c in plant.physical_states])
    high = [c.high if math.isfinite(c.high) else 1.0 for c in plant.actions]
    low = [c.low if math.isfinite(c.low) else -1.0 for c in plant.actions]
    inputs = [np.zeros(len(high)), *np.diag(high), *np.diag(low)]
    flow = jax.jit(lambda s, a: plant.flow(params, s, a, LONGEST_MEAN) - s)
    moved = [
        np.abs(flow(jnp.asarray(s), jnp.asarray(a))) / LONGEST_MEAN
        for s in (0.0 * away, away)
        for a in inputs
    ]
    most = np.max(moved, axis=0)
    return [float(x) if 0.0 < x < math.inf else 1.0 for x in most]
