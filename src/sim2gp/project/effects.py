"""Physics that the file adds to a bundled machine: what is possible, and its prior.

    [effects.theta.coulomb]
    mean = 0.0
    sd = 0.001

An effect that changes nothing of the machine's equations on its channel is an error.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any

import jax.numpy as jnp

from sim2gp.errors import InputError, nearest
from sim2gp.inference.parameters import Parameter
from sim2gp.project.priors import prior
from sim2gp.project.schema import EFFECT_OPTIONS, EffectSpec
from sim2gp.project.source import Source
from sim2gp.project.validate import unknown
from sim2gp.systems import AbstractMechanism, AbstractSystem, Perturbed
from sim2gp.systems.effects import base as effects
from sim2gp.systems.effects import placement
from sim2gp.systems.effects.base import AbstractEffect

#: Effects by the last part of their constant's name, ``<channel>.<effect>``.
EFFECTS: dict[str, Any] = {
    kind.what: kind
    for kind in (
        effects.BackEmf,
        placement.BaseTilt,
        placement.BaseTiltSide,
        effects.Coulomb,
        effects.DeadZone,
        effects.Drag,
        placement.EncoderOffset,
        placement.Payload,
        effects.PoleGeometry,
        effects.RailFriction,
        effects.RailTilt,
        effects.RodInertia,
        effects.Spring,
        effects.Stribeck,
    )
}


def perturbed(
    system: AbstractSystem,
    specs: Mapping[str, Mapping[str, EffectSpec | float]],
    source: Source,
) -> AbstractSystem:
    """The machine with the effects of the file; magnitudes are constants by name."""
    assert isinstance(system, AbstractMechanism)  # as every class of `SYSTEMS` is
    added: list[AbstractEffect] = []
    stated: dict[str, Parameter | float] = {}
    for where, kinds in specs.items():
        for what, said in kinds.items():
            line = source.where("effects", where, what)
            if not _possible(system, what, where):
                raise _impossible(system, what, where, line)
            effect = _effect(what, where, said, line)
            added.append(effect)
            base = effect.parameter(system)
            stated[effect.name] = prior(said, base, line, own=0.0)
    table = Perturbed(system, added).parameters.replace(**stated)
    return Perturbed(system, added, table)


def _possible(system: AbstractMechanism, what: str, where: str) -> bool:
    """Whether a machine can have an effect: it changes its equations in motion.

    The zero of an encoder does not where nothing depends on the joint's position.
    """
    try:
        changed = Perturbed(system, [EFFECTS[what](where=where, magnitude=1.0)])
    except (InputError, KeyError):
        return False
    q, v = jnp.full(2, 0.7), jnp.full(2, 0.9)
    a = jnp.asarray([min(0.3 * channel.high, 1.0) for channel in system.actions])
    before, after = (
        jnp.stack([*s.inertia(p, q), *s.forces(p, q, v, a)])
        for s, p in ((system, system.nominal()), (changed, changed.nominal()))
    )
    return bool(jnp.any(before != after))


def _impossible(
    system: AbstractMechanism, what: str, where: str, line: str
) -> InputError:
    """An effect that no machine, this one, or this channel has (E103, E145, E160)."""
    channels = [c.name for c in (*system.states[:2], *system.actions)]
    known = {
        channel: [kind for kind in EFFECTS if _possible(system, kind, channel)]
        for channel in channels
    }
    homes = [channel for channel in channels if what in known[channel]]
    every = sorted({kind for kinds in known.values() for kind in kinds})
    if where in EFFECTS:  # [effects.coulomb] and below it the keys of a prior
        code, wrong, got, names = "E103", "unknown channel", where, channels
        fix = f"write [effects.CHANNEL.{where}]"
    elif what not in EFFECTS:
        return unknown("effect", what, known.get(where, every), line)
    elif homes and where not in channels:
        code, wrong, got, names = "E103", "unknown channel", where, homes
        close = nearest(where, homes)
        fix = f"did you mean {close}" if close else "use one of these"
    else:
        code, got, names = "E145", f"{where}.{what}", known.get(where, every)
        wrong = f"no {what} on {where if homes else 'this machine'}"
        fix = f"write [effects.{homes[0]}.{what}]" if homes else "use one of these"
    return InputError(
        code,
        wrong,
        where=line,
        got=got,
        expected="one of " + ", ".join(names),
        fix=fix,
    )


def _effect(
    what: str, where: str, said: EffectSpec | float, line: str
) -> AbstractEffect:
    """The effect of a name on a channel, with the options it has (E160)."""
    known = [field.name for field in dataclasses.fields(EFFECTS[what])]
    options = effect_options(what, said, known[2:], line)
    made: AbstractEffect = EFFECTS[what](where=where, magnitude=1.0, **options)
    return made


def effect_options(
    what: str, said: EffectSpec | float, known: Collection[str], line: str
) -> dict[str, float]:
    """What an effect has besides its magnitude, each one that it knows (E160)."""
    stated = () if isinstance(said, float) else EFFECT_OPTIONS
    given = {name: getattr(said, name) for name in stated}
    options = {name: value for name, value in given.items() if value is not None}
    for name in options:
        if name not in known:
            raise unknown(f"option of {what}", name, known, line)
    return options
