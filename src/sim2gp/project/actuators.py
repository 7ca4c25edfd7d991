"""Gain, offset and delay of a machine's inputs, as a project file states them.

    [actuators."joint*.control"]
    delay = {low = 0.0, high = 0.02}
    tie = true

A table names one input, or several by a pattern; tied inputs share their parameters,
under the first one's name.
"""

from collections.abc import Collection, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter
from sim2gp.project.priors import prior
from sim2gp.project.schema import ProjectSpec
from sim2gp.project.source import ProjectSource
from sim2gp.project.validate import unknown
from sim2gp.systems import AbstractSystem, with_parts
from sim2gp.systems.actuators import neutral_actuators
from sim2gp.systems.machine import plant_of


def with_actuators(
    system: AbstractSystem, spec: ProjectSpec, source: ProjectSource
) -> AbstractSystem:
    """The machine with its actuators; what the file does not name is neutral.

    Raises `InputError` E141, E145 and E160 for what the file cannot mean.
    """
    if not spec.actuators:
        return system
    inputs = [channel.name for channel in system.actions]
    tables = _inputs_by_table(spec, source, inputs)
    ties = {
        name: found[0]
        for pattern, found in tables.items()
        if spec.actuators[pattern].tie
        for name in found[1:]
    }
    pattern_of = {name: pattern for pattern, found in tables.items() for name in found}
    stated: dict[str, Parameter | float] = {}
    parts = neutral_actuators(system.actions, ties)
    for part in parts:
        if part.where not in pattern_of or part.tie:
            continue
        pattern = pattern_of[part.where]
        said = getattr(spec.actuators[pattern], part.what)
        where = source.where("actuators", pattern, part.what)
        base = part.parameter(plant_of(system))
        if part.where in ties.values():
            base = replace(base, meaning=f"{part.what} of {pattern}")
        own = None if part.what == "delay" else part.magnitude
        chosen = base if said == "free" else prior(said, base, where, own)
        _check_delay(part.what, chosen, where)
        stated[part.name] = chosen
    return with_parts(system, parts, stated)


def _inputs_by_table(
    spec: ProjectSpec, source: ProjectSource, inputs: Sequence[str]
) -> dict[str, list[str]]:
    """The inputs of each table; no input has two (E145), one alone no tie (E160)."""
    tables: dict[str, list[str]] = {}
    for pattern, table in spec.actuators.items():
        where = source.where("actuators", pattern)
        found = _matching(pattern, inputs, spec.actuators, where)
        twice = [name for other in tables.values() for name in other if name in found]
        if twice:
            raise error("input_named_twice", where=where, got=twice[0])
        if table.tie and len(found) == 1:
            where = source.where("actuators", pattern, "tie")
            raise error("tie_of_one_input", where=where, got=found[0])
        tables[pattern] = found
    return tables


def _matching(
    pattern: str, inputs: Sequence[str], stated: Collection[str], where: str
) -> list[str]:
    """What a pattern names; an input with a table of its own is the exception to it."""
    if pattern in inputs:
        return [pattern]
    found = [name for name in inputs if fnmatchcase(name, pattern)]
    if not found:
        raise unknown("input", pattern, inputs, where)
    own = [name for name in found if name not in stated]
    if not own:
        raise error("pattern_without_own_inputs", where=where, got=pattern)
    return own


def _check_delay(part: str, stated: Parameter | float, where: str) -> None:
    low = stated.low if isinstance(stated, Parameter) else stated
    if part == "delay" and low < 0:
        raise error("negative_delay", where=where, got=f"{low:g} s")
