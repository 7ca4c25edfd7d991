"""Physics that the file adds to a machine: what is possible, and its prior.

    [effects.theta.coulomb]
    mean = 0.0
    sd = 0.001

An effect that changes nothing of the machine's equations on its channel is an error.
"""

from collections.abc import Collection, Mapping
from typing import Any

from sim2gp.errors import InputError, error, nearest
from sim2gp.inference.parameters import Parameter
from sim2gp.project.priors import prior, with_location
from sim2gp.project.schema import EFFECT_OPTIONS, EffectSpec, PriorSpec
from sim2gp.project.source import ProjectSource
from sim2gp.project.validate import unknown
from sim2gp.systems import AbstractPart, AbstractPlant, AbstractSystem, with_parts
from sim2gp.systems.effects.registry import (
    ALIASES,
    NAMES,
    named,
    options_of,
    possible,
)
from sim2gp.systems.effects.tables import AbstractTable
from sim2gp.systems.effects.units import joints_of
from sim2gp.systems.machine import plant_of


def with_effects(
    system: AbstractSystem,
    specs: Mapping[str, Mapping[str, EffectSpec | float]],
    source: ProjectSource,
) -> AbstractSystem:
    """The machine with the effects of the file; magnitudes are parameters by name."""
    plant, parts = plant_of(system), list[AbstractPart]()
    stated: dict[str, Parameter | float] = {}
    for where, kinds in specs.items():
        for what, said in kinds.items():
            line = source.where("effects", where, what)
            if not possible(plant, what, where):
                raise _impossible_effect(plant, what, where, line)
            options = effect_options(what, said, options_of(what), line)
            part = _made(what, where, options, line)
            parts.append(part)
            base, table = part.parameter(plant), isinstance(part, AbstractTable)
            if table and isinstance(said, EffectSpec) and not _states_prior(said):
                said = 1.0
            own = 1.0 if table else 0.0
            stated[part.name] = prior(said, base, line, own=own)
    return with_parts(system, parts, stated)


def _made(what: str, where: str, options: Mapping[str, Any], line: str) -> AbstractPart:
    """The effect, at a magnitude of one (E148 for points that are no table)."""
    try:
        return named(what, where, 1.0, **options)
    except InputError as refused:
        raise with_location(refused, line) from refused


def _states_prior(said: EffectSpec) -> bool:
    """Whether the table of an effect states more than options."""
    return any(getattr(said, name) is not None for name in PriorSpec.model_fields)


def _impossible_effect(
    plant: AbstractPlant, what: str, where: str, line: str
) -> InputError:
    """An effect that no machine, this one, or this channel has (E103, E145, E160)."""
    channels = [c.name for c in (*joints_of(plant), *plant.actions)]
    known = {
        channel: [kind for kind in NAMES if possible(plant, kind, channel)]
        for channel in channels
    }
    homes = [channel for channel in channels if possible(plant, what, channel)]
    every = sorted({kind for kinds in known.values() for kind in kinds})
    if where in (*NAMES, *ALIASES):  # [effects.coulomb] and below it a prior's keys
        names = ", ".join(channels)
        return error("effect_for_channel", where=line, got=where, names=names, of=where)
    if what not in (*NAMES, *ALIASES):
        return unknown("effect", what, known.get(where, every), line)
    if homes and where not in channels:
        close, names = nearest(where, homes), ", ".join(homes)
        fix = f"did you mean {close}" if close else "use one of these"
        return error(
            "unknown_channel_of_effect", where=line, got=where, names=names, fix=fix
        )
    return error(
        "impossible_effect",
        where=line,
        got=f"{where}.{what}",
        fix=f"write [effects.{homes[0]}.{what}]" if homes else "use one of these",
        what=what,
        place=where if homes else "this machine",
        names=", ".join(known.get(where, every)),
    )


def effect_options(
    what: str, said: EffectSpec | float, known: Collection[str], line: str
) -> dict[str, Any]:
    """The options of an effect next to its magnitude; E160 for one that it lacks."""
    stated = () if isinstance(said, float) else EFFECT_OPTIONS
    given = {name: getattr(said, name) for name in stated}
    options = {name: value for name, value in given.items() if value is not None}
    if "points" in options:
        options["points"] = tuple((float(z), float(f)) for z, f in options["points"])
    for name in options:
        if name not in known:
            raise unknown(f"option of {what}", name, known, line)
    return options
