"""A checked file becomes a machine: options, priors, actuators, and every name known.

This half of the project loads the simulators; `sim2gp.project.schema` does not.
"""

import inspect
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sim2gp.errors import InputError, error
from sim2gp.inference.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.project import slips
from sim2gp.project.actuators import with_actuators
from sim2gp.project.effects import with_effects
from sim2gp.project.priors import prior, with_location
from sim2gp.project.schema import (
    ColumnSpec,
    LogSpec,
    ParameterSpec,
    ProjectSpec,
)
from sim2gp.project.source import ProjectSource
from sim2gp.project.validate import describe_violation, unknown, wrong_value
from sim2gp.systems import AbstractPlant, AbstractSystem
from sim2gp.systems.machine import as_machine
from sim2gp.systems.variants import AT


def build_system(
    spec: ProjectSpec, source: ProjectSource, kind: type[AbstractPlant]
) -> AbstractSystem:
    """The machine of the file, with effects and actuators (E141, E145, E160)."""
    options = _class_options(spec.options, source, kind)
    try:
        plain = kind(**options)
    except InputError as caught:
        raise with_location(caught, source.where("options")) from caught
    except (TypeError, ValueError) as caught:
        where, expected = source.where("options"), str(caught)
        got = ", ".join(f"{k} = {v}" for k, v in options.items())
        raise error(
            "options_refused", where=where, got=got, expected=expected
        ) from caught
    shared = {k: v for k, v in spec.parameters.items() if AT not in k}
    table = _parameters_with_priors(plain.parameters, shared, source, ("parameters",))
    plant: Any = kind(parameters=table, **options)
    return with_actuators(with_effects(plant, spec.effects, source), spec, source)


def build_own(
    spec: ProjectSpec, source: ProjectSource, system: AbstractSystem
) -> AbstractSystem:
    """A user's system with the file's priors, effects and actuators.

    Raises `InputError` E141, E145, and E160 for ``[options]``, which it has none of.
    """
    for name in spec.options:
        raise unknown("option", name, (), source.where("options", name))
    shared = {k: v for k, v in spec.parameters.items() if AT not in k}
    table = _parameters_with_priors(system.parameters, shared, source, ("parameters",))
    machine = replace(as_machine(system), parameters=table)
    return with_actuators(with_effects(machine, spec.effects, source), spec, source)


def _class_options(
    options: Mapping[str, Any], source: ProjectSource, kind: type[AbstractPlant]
) -> dict[str, Any]:
    """The options that the class takes, each of its declared type."""
    hints = get_type_hints(kind.__init__)
    known = [
        name
        for name in inspect.signature(kind).parameters
        if name not in ("self", "parameters")
    ]
    out = {}
    for name, value in options.items():
        where = source.where("options", name)
        if name not in known:
            raise unknown("option", name, known, where)
        strict = ConfigDict(strict=True, allow_inf_nan=False)
        adapter = TypeAdapter(hints[name], config=strict)
        given = tuple(value) if isinstance(value, list) else value
        try:
            out[name] = adapter.validate_python(given)
        except ValidationError as error:
            expected = describe_violation({**error.errors()[0]})
            fix = slips.fix_for_value(("options", name), value, expected)
            raise wrong_value("E160", where, value, expected, fix) from error
    return out


def _parameters_with_priors(
    table: Parameters,
    specs: Mapping[str, ParameterSpec | float],
    source: ProjectSource,
    path: tuple[str, ...],
) -> Parameters:
    """The table with the file's priors and fixed values in place of its own."""
    fixed = dict(table.fixed)
    changes = {}
    for name, stated in specs.items():
        where = source.where(*path, name)
        if isinstance(stated, ParameterSpec) and stated.tie:
            raise unknown("option", "tie", (), where)
        if name in table.names:
            base = table[name]
        elif name in fixed:
            base = Parameter(name, "", "", "identity", mean=fixed[name], sd=1.0)
        else:
            known = [*table.names, *fixed]
            raise with_location(unknown_parameter(name, known), where)
        changes[name] = prior(stated, base, where, fixed.get(name))
    return table.replace(**changes)


def check_known_names(
    spec: ProjectSpec, source: ProjectSource, system: AbstractSystem
) -> None:
    """Every channel and parameter that the file names is the machine's."""
    states = [channel.name for channel in system.physical_states]
    inputs = [channel.name for channel in system.actions]
    constants = [*system.parameters.names, *(n for n, _ in system.parameters.fixed)]
    for i, group in enumerate(spec.logs):
        for name, value in group.columns.items():
            where = source.where("logs", i, "columns", name)
            if name not in (*states, *inputs):
                raise unknown("channel", name, [*states, *inputs], where)
            if isinstance(value, ColumnSpec) and value.saturation is not None:
                low, high = value.saturation
                _check_pair(f"saturation of {name}", low, high, where)
            if isinstance(value, float) and name not in inputs:
                raise error("constant_measured_channel", where=where, got=f"{value:g}")
        _check_complete(list(group.columns), states, inputs, source, i)
        _check_clock(group, source, i)
        for name in group.fixed:
            if name not in constants:
                where = source.where("logs", i, "fixed", name)
                raise with_location(unknown_parameter(name, constants), where)
        for k, (low, high) in enumerate(group.exclude):
            where = source.where("logs", i, "exclude", k)
            _check_pair("excluded interval", low, high, where)
    for name, (low, high) in spec.limits.items():
        where = source.where("limits", name)
        if name not in (*states, *inputs):
            raise unknown("channel", name, [*states, *inputs], where)
        _check_pair(f"limits of {name}", low, high, where)
    for name in spec.rates:
        if name not in inputs:
            raise unknown("input", name, inputs, source.where("rates", name))
    _check_likelihood(spec, source, states)


def _check_likelihood(
    spec: ProjectSpec, source: ProjectSource, states: list[str]
) -> None:
    """What the file says of windows, of states, and of noise is what is fitted."""
    stated = spec.likelihood
    if stated.window == 0.0 and "start" in stated.model_fields_set:
        where = source.where("likelihood", "start")
        got = f'window = 0, start = "{stated.start}"'
        raise error("start_of_one_step", where=where, got=got)
    named = {name for group in spec.logs for name in group.columns}
    measured = [name for name in states if name in named] or states
    for key, given, kind, known in (
        ("start_sd", stated.start_sd, "state", states),
        ("noise_floor", stated.noise_floor, "measured state", measured),
    ):
        for name in given if isinstance(given, dict) else ():
            if name not in known:
                where = source.where("likelihood", key, name)
                raise unknown(kind, name, known, where)


def _check_complete(
    named: list[str],
    states: list[str],
    inputs: list[str],
    source: ProjectSource,
    i: int,
) -> None:
    """Every input is known, and something is measured."""
    where = source.where("logs", i, "columns")
    missing = [name for name in inputs if name not in named]
    if not set(named) & set(states):
        missing = missing or states
    elif not missing:
        return
    got = ", ".join(named) or "no columns"
    raise error("no_column_for_channel", where=where, got=got, channel=missing[0])


def _check_clock(group: LogSpec, source: ProjectSource, i: int) -> None:
    """Time comes from a column or a period; rows from a period or from stamps."""
    if isinstance(group.time, ColumnSpec) and group.time.saturation is not None:
        where = source.where("logs", i, "time", "saturation")
        got = f"saturation = {group.time.saturation}"
        raise error("saturation_of_clock", where=where, got=got)
    pairs: list[tuple[str, str, object, object]]
    pairs = [("time", "period", group.time, group.period)]
    if group.resample is not None:
        rule = group.resample
        pairs += [("resample.period", "resample.stamps", rule.period, rule.stamps)]
    for one, other, first, second in pairs:
        if first is not None and second is not None:
            where = source.where("logs", i, *other.split("."))
            got = f"{other} = {second!r}"
            raise error("two_keys_for_one", where=where, got=got, one=one, other=other)


def _check_pair(what: str, low: float, high: float, where: str) -> None:
    if not low < high:
        got = f"[{low:g}, {high:g}]"
        if low > high:
            raise error("interval_reversed", where=where, got=got, what=what)
        raise error("interval_empty", where=where, got=got, what=what)
