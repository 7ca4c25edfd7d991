"""A machine with physics that its simulator lacks, and the registered strengths.

``Perturbed(system, effects)`` is again a system. Each effect's magnitude is one more
constant, named ``<where>.<what>``: fixed, or free, which makes it the candidate in a
search for the missing term. `effect` looks up the catalogue of mismatch settings.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp import checks
from sim2gp.errors import InputError, nearest
from sim2gp.inference.parameters import Parameters
from sim2gp.systems.actuators import Actuated
from sim2gp.systems.base import AbstractMechanism, AbstractSystem, Channel, Inertia
from sim2gp.systems.effects.base import (
    AbstractEffect,
    Coulomb,
    DeadZone,
    Drag,
    Pair,
    PoleGeometry,
    RailFriction,
    RailTilt,
    RodInertia,
    Spring,
)
from sim2gp.systems.function_checks import check_returns
from sim2gp.types import Action, Scalar, State

STRENGTHS = ("mild", "middle", "strong")


@dataclasses.dataclass(frozen=True)
class InputDelay:
    """A delay of an input by ``magnitude`` seconds, for `perturb` (E148)."""

    where: str
    magnitude: float

    def __post_init__(self) -> None:
        checks.not_negative("InputDelay", magnitude=self.magnitude)


class PerturbedParams(eqx.Module):
    """Constants of the bare machine, and one magnitude for each effect."""

    system: Any
    magnitudes: tuple[Scalar, ...]


class Perturbed(AbstractMechanism):
    """A machine with effects that its bare model lacks; the same states and inputs.

    The magnitudes are fixed constants of the table; ``free=True`` makes them free, with
    no effect in the prior mean. Raises `InputError` E103 for an unknown channel, E145
    for two effects of one name, E140, E123 or E173 for an effect whose functions have
    another shape, are no real numbers, or raise.
    """

    system: AbstractMechanism
    effects: tuple[AbstractEffect, ...]
    parameters: Parameters = eqx.field(static=True)
    locked: tuple[bool, bool] = eqx.field(static=True)

    def __init__(
        self,
        system: AbstractMechanism,
        effects: Sequence[AbstractEffect],
        parameters: Parameters | None = None,
        *,
        free: bool = False,
    ) -> None:
        bare = system.system if isinstance(system, Perturbed) else system
        for effect in effects:
            effect.unit(bare)  # raises for a channel that is not there
        if free:
            more = Parameters(tuple(effect.parameter(bare) for effect in effects))
        else:
            more = Parameters((), tuple((e.name, e.magnitude) for e in effects))
        table = system.parameters.merge(more)
        if parameters is not None:
            table = table.replace(
                **{p.name: p for p in parameters.free}, **dict(parameters.fixed)
            )
        held = system.effects if isinstance(system, Perturbed) else ()
        names = [effect.name for effect in (*held, *effects)]
        for name in names:
            if names.count(name) > 1:
                raise InputError("E145", "two effects of one name", got=name)
        self.system = bare
        self.effects = (*held, *effects)
        self.parameters = table
        self.locked = bare.locked

    def check_functions(self) -> None:
        """Each effect's: a force on the wrong joints would pass for one on both."""
        for effect in self.effects:
            for what, f, size in (
                ("input", _input, len(self.actions)),
                ("inertia", _inertia, 3),
                ("force", _force, 2),
            ):
                name = f"{type(effect).__name__}.{what}"
                function = jax.tree_util.Partial(f, self.system, effect)
                check_returns(self, what, function, name=name, size=size)

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.system.states

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.system.actions

    @property
    def max_substep(self) -> float:
        return min([self.system.max_substep, *(e.max_substep for e in self.effects)])

    def record(self, values: Mapping[str, Scalar]) -> PerturbedParams:
        magnitudes = tuple(values[effect.name] for effect in self.effects)
        return PerturbedParams(self.system.record(values), magnitudes)

    def with_effects(self, params: Any) -> PerturbedParams:
        """A record of the bare machine, with every effect at its own magnitude."""
        one = jnp.ones_like(self.system.delays(params)[0])
        return PerturbedParams(params, tuple(e.magnitude * one for e in self.effects))

    def inertia(self, params: PerturbedParams, q: Pair) -> Inertia:
        a, b, c = self.system.inertia(params.system, q)
        for effect, x in zip(self.effects, params.magnitudes, strict=True):
            da, db, dc = effect.inertia(self.system, params.system, x, q)
            a, b, c = a + da, b + db, c + dc
        return a, b, c

    def forces(self, params: PerturbedParams, q: Pair, v: Pair, a: Action) -> Pair:
        pairs = list(zip(self.effects, params.magnitudes, strict=True))
        for effect, x in pairs:
            a = effect.input(self.system, x, a)
        f = self.system.forces(params.system, q, v, a)
        for effect, x in pairs:
            f = f + effect.force(self.system, params.system, x, q, v)
        return f


def _input(
    system: AbstractMechanism, effect: AbstractEffect, params: Any, s: State, a: Action
) -> Any:
    """`AbstractEffect.input` of a whole state, at the effect's magnitude of one."""
    return effect.input(system, jnp.ones((), s.dtype), a)


def _inertia(
    system: AbstractMechanism, effect: AbstractEffect, params: Any, s: State, a: Action
) -> Any:
    """`AbstractEffect.inertia`, likewise, as one array."""
    one = jnp.ones((), s.dtype)
    return jnp.stack(effect.inertia(system, params.system, one, s[:2]))


def _force(
    system: AbstractMechanism, effect: AbstractEffect, params: Any, s: State, a: Action
) -> Any:
    """`AbstractEffect.force`, likewise."""
    one = jnp.ones((), s.dtype)
    return effect.force(system, params.system, one, s[:2], s[2:4])


def perturb(
    system: AbstractMechanism,
    effects: Sequence[AbstractEffect | InputDelay],
    *,
    period: float = 0.02,
) -> AbstractSystem:
    """The machine with effects; input delays carry past actions of ``period`` s."""
    physics = [e for e in effects if isinstance(e, AbstractEffect)]
    delays = {
        f"{e.where}.delay": e.magnitude for e in effects if isinstance(e, InputDelay)
    }
    machine = Perturbed(system, physics) if physics else system
    if not delays:
        return machine
    longest = max(delays.values())
    return Actuated(machine, delays, delay_max=longest, period=period)


# The mild and strong magnitudes are published or measured (the amplifier's dead zone,
# the rail's friction) where there is such a value; the middle one is near their
# geometric mean. Drag, tilt and the cart's cable have none: these strengths are ours.
# The rod's inertia is there or not, at any strength.
_CATALOGUE: dict[
    str, dict[str, tuple[AbstractEffect | InputDelay, tuple[float, float, float]]]
] = {
    "furuta": {
        "coulomb": (Coulomb("theta", 0.0), (1.5e-3, 2.5e-3, 4e-3)),
        "dead_zone": (DeadZone("voltage", 0.0), (0.65, 0.9, 1.2)),
        "spring": (Spring("theta", 0.0), (2e-3, 4.5e-3, 1e-2)),
        "delay": (InputDelay("voltage", 0.0), (0.010, 0.015, 0.020)),
        "rod_inertia": (RodInertia(), (1.0, 1.0, 1.0)),
        "drag": (Drag("alpha", 0.0), (2e-6, 4.5e-6, 1e-5)),
    },
    "cartpole": {
        "coulomb": (RailFriction(), (0.02, 0.045, 0.1)),
        "dead_zone": (DeadZone("voltage", 0.0), (0.5, 0.7, 1.0)),
        "spring": (Spring("x", 0.0), (2.0, 4.5, 10.0)),
        "delay": (InputDelay("voltage", 0.0), (0.010, 0.015, 0.020)),
        "geometry": (PoleGeometry(), (0.0095, 0.019, 0.038)),
        "tilt": (
            RailTilt(),
            (math.radians(0.5), math.radians(1.0), math.radians(2.0)),
        ),
        "drag": (Drag("x", 0.0), (0.5, 1.2, 3.0)),
    },
}


def catalogue(machine: str) -> tuple[str, ...]:
    """Names of the effects registered for ``furuta`` or ``cartpole``."""
    return tuple(_known(_CATALOGUE, machine))


def effect(machine: str, name: str, strength: str) -> AbstractEffect | InputDelay:
    """A registered effect at one of `STRENGTHS`; E145 names the nearest known one."""
    made, magnitudes = _known(_known(_CATALOGUE, machine), name)
    strengths = dict(zip(STRENGTHS, magnitudes, strict=True))
    return dataclasses.replace(made, magnitude=_known(strengths, strength))


def _known(table: Mapping[str, Any], name: str) -> Any:
    if name not in table:
        close = nearest(name, table)
        raise InputError(
            "E145",
            "unknown name in the catalogue of effects",
            got=name,
            expected=f"one of {', '.join(table)}",
            fix=f"did you mean {close}?" if close else "",
        )
    return table[name]
