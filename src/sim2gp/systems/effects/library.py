"""What a simulator may lack: the candidates of a search for the missing physics.

Each candidate adds one scalar to a machine: the magnitude of an effect with a Gaussian
prior around nothing, a delay, or the time constant of a low pass. Priors are a fifth of
what the machine itself does, so that no candidate is favoured by its unit: a force by
the largest of its motor or weight, a stiffness and a drag by that force at a typical
position and speed, a dead zone by the input's range.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.actuators import Actuated
from sim2gp.systems.base import AbstractMechanism, AbstractSystem
from sim2gp.systems.effects.base import (
    AbstractEffect,
    BackEmf,
    Coulomb,
    DeadZone,
    Drag,
    PoleGeometry,
    RailFriction,
    RailTilt,
    RodInertia,
    Spring,
    Stribeck,
)
from sim2gp.systems.effects.perturbed import InputDelay, Perturbed
from sim2gp.systems.effects.placement import (
    BaseTilt,
    BaseTiltSide,
    EncoderOffset,
    Payload,
)
from sim2gp.systems.lag import Lagged
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.systems.plants.two_link import TwoLink, UniformRodArm
from sim2gp.systems.variants import Configured

SHARE = 0.2  # of what the machine does: the prior sd of an effect
OFFSET = 0.05  # rad, prior sd of a tilt or of an encoder's zero
LONGEST = 0.04  # s, of a delay or a time constant
SHORTEST_LAG = 2e-3  # s


@dataclasses.dataclass(frozen=True)
class InputLag:
    """A first-order low pass of an input, of ``magnitude`` seconds."""

    where: str
    magnitude: float


@dataclasses.dataclass(frozen=True)
class Candidate:
    """One effect to be tried on a machine.

    The ``magnitude`` of ``effect`` is its prior sd, or the longest delay or lag.
    ``sign`` is +1 where only positive values are physical, 0 where both are. ``grid``
    are magnitudes at which the effect is linearised: zero alone where it is smooth
    there.
    """

    effect: AbstractEffect | InputDelay | InputLag
    sign: int = 1
    grid: tuple[float, ...] = (0.0,)

    @property
    def name(self) -> str:
        """Name of its constant: ``<where>.<what>``."""
        if isinstance(self.effect, AbstractEffect):
            return self.effect.name
        kind = "delay" if isinstance(self.effect, InputDelay) else "lag"
        return f"{self.effect.where}.{kind}"

    @property
    def meaning(self) -> str:
        """What it is, in words."""
        if isinstance(self.effect, AbstractEffect):
            return self.effect.meaning
        delayed = isinstance(self.effect, InputDelay)
        return "delay of the input" if delayed else "first-order lag of the input"

    @property
    def smooth(self) -> bool:
        """Whether the derivative at nothing says what the effect does."""
        return self.grid == (0.0,)

    def freed(self, system: AbstractSystem, *, period: float = 0.0) -> AbstractSystem:
        """The machine with this one more free constant.

        ``period`` (s) of the control makes delays and lags carry past actions; without
        it a delay is left to the likelihood over windows.
        """
        if isinstance(system, Configured):
            return system.around(self.freed(system.system, period=period))
        if isinstance(self.effect, AbstractEffect):
            return with_effects(system, [self.effect])
        where, longest = self.effect.where, self.effect.magnitude
        if isinstance(self.effect, InputLag):
            what = self.meaning
            lag = Parameter(self.name, "s", what, "log_box", SHORTEST_LAG, longest)
            return Lagged(system, where, lag, period=period)
        delay = Parameter(self.name, "s", f"delay of {where}", "box", 0.0, longest)
        inner = system.system if isinstance(system, Actuated) else system
        table = system.parameters if isinstance(system, Actuated) else None
        return Actuated(
            inner,
            {self.name: delay},
            parameters=table,
            delay_max=longest if period else 0.0,
            period=period or 1.0,
        )


def with_effects(
    system: AbstractSystem, effects: Sequence[AbstractEffect]
) -> AbstractSystem:
    """The machine with free effects inside, whatever actuators stand before it."""
    if isinstance(system, Configured):
        return system.around(with_effects(system.system, effects))
    if isinstance(system, Actuated):
        inner = with_effects(system.system, effects)
        return Actuated(inner, parameters=system.parameters)
    assert isinstance(system, AbstractMechanism)
    return Perturbed(system, effects, free=True)


def library(system: AbstractSystem, *, windows: bool = False) -> tuple[Candidate, ...]:
    """Every candidate for a machine, without those that its table has already.

    Over ``windows`` a lag is left to its equivalent, a delay. Raises `InputError` E145
    for a machine that no effects are registered for.
    """
    bare = _bare(system)
    found = _physics(bare)
    if found is None:
        known = "Furuta, CartPole, TwoLink, UniformRodArm"
        got = type(bare).__name__
        raise InputError("E145", "no library of effects", got=got, expected=known)
    for channel in bare.actions:
        found += _inputs(channel.name, channel.high, lag=not windows)
    return _new(found, system)


def smooth_effects(system: AbstractSystem) -> tuple[AbstractEffect, ...]:
    """What a machine may lack and whose slope at nothing says what it does.

    Each with its prior sd; none for a machine without a library.
    """
    found = _new(_physics(_bare(system)) or (), system)
    effects = [candidate.effect for candidate in found if candidate.smooth]
    return tuple(e for e in effects if isinstance(e, AbstractEffect))


def _bare(system: Any) -> Any:
    while isinstance(system, Actuated | Perturbed | Configured):
        system = system.system
    return system


def _physics(bare: Any) -> list[Candidate] | None:
    if isinstance(bare, Furuta):
        return _furuta()
    if isinstance(bare, CartPole):
        return _cartpole()
    return _arm(bare) if isinstance(bare, TwoLink | UniformRodArm) else None


def _new(found: Sequence[Candidate], system: AbstractSystem) -> tuple[Candidate, ...]:
    """Those that the table does not have already."""
    table = system.parameters
    there = {*table.names, *(name for name, value in table.fixed if value != 0.0)}
    there |= {e.name for e in _held(system)}
    return tuple(c for c in found if c.name not in there)


def _held(system: Any) -> tuple[AbstractEffect, ...]:
    inner = system
    while isinstance(inner, Actuated | Configured):
        inner = inner.system
    return inner.effects if isinstance(inner, Perturbed) else ()


def _inputs(name: str, high: float, *, lag: bool) -> list[Candidate]:
    width = SHARE * high
    found = [
        Candidate(DeadZone(name, width), grid=(0.25 * width, 0.5 * width, width)),
        Candidate(InputDelay(name, LONGEST), grid=(0.004, 0.012, 0.026)),
    ]
    if lag:
        found.append(Candidate(InputLag(name, LONGEST), grid=(0.004, 0.012, 0.026)))
    return found


def _joint(
    name: str, force: float, speed: float, reach: float, *, dry: Mapping[str, Any]
) -> list[Candidate]:
    """Friction, a spring and drag; ``force`` in N or N m is what moves the joint."""
    scale = SHARE * force
    return [
        Candidate(Stribeck(name, scale, **dry)),
        Candidate(Spring(name, scale / reach)),
        Candidate(Drag(name, scale / speed**2)),
        Candidate(BackEmf(name, scale / speed)),
    ]


def _furuta() -> list[Candidate]:
    # The motor's stall torque at 5 V; the pendulum's weight at its lever arm.
    arm, pendulum = 0.025, 0.015  # N m
    return [
        Candidate(Coulomb("theta", SHARE * arm)),
        Candidate(Coulomb("alpha", SHARE * pendulum)),
        *_joint("theta", arm, 10.0, 1.0, dry={}),
        *_joint("alpha", pendulum, 15.0, 1.0, dry={}),
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
        *_joint("x", cart, 1.0, 0.3, dry={"width": 0.01, "speed": 0.1}),
        *_joint("theta", pole, 10.0, 1.0, dry={}),
        Candidate(EncoderOffset("theta", OFFSET), sign=0),
        Candidate(RailTilt(magnitude=OFFSET), sign=0),
        Candidate(PoleGeometry(), sign=0),
        Candidate(Payload("theta", SHARE * 0.127)),
    ]


def _arm(bare: TwoLink | UniformRodArm) -> list[Candidate]:
    found = []
    for joint, channel in zip(bare.states[:2], bare.actions, strict=True):
        torque = channel.high
        found += [
            Candidate(Coulomb(joint.name, SHARE * torque)),
            *_joint(joint.name, torque, 10.0, 1.0, dry={}),
            Candidate(EncoderOffset(joint.name, OFFSET), sign=0),
        ]
    return found
