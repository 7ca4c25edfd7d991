"""A checked file becomes a machine: options, priors, actuators, and every name known.

This half of the project loads the simulators; `sim2gp.project.schema` does not.
"""

import dataclasses
import inspect
from collections.abc import Collection, Mapping
from typing import Any, get_type_hints

from pydantic import ConfigDict, TypeAdapter, ValidationError

from sim2gp.configurations import AT
from sim2gp.errors import InputError, nearest
from sim2gp.parameters import Parameter, Parameters, unknown_parameter
from sim2gp.project import slips
from sim2gp.project.priors import located, prior
from sim2gp.project.schema import (
    EFFECT_OPTIONS,
    ActuatorSpec,
    ColumnSpec,
    EffectSpec,
    LogSpec,
    ParameterSpec,
    ProjectSpec,
)
from sim2gp.project.source import Source
from sim2gp.project.validate import words
from sim2gp.systems import (
    AbstractMechanism,
    AbstractSystem,
    Perturbed,
    effects,
    placement,
)
from sim2gp.systems.actuator import Actuated, actuator_prior
from sim2gp.systems.effects import AbstractEffect

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


def build_system(
    spec: ProjectSpec, source: Source, kind: type[AbstractSystem]
) -> AbstractSystem:
    """The machine of the file, wrapped by its actuators (E141, E145, E160)."""
    options = _options(spec.options, source, kind)
    try:
        plain = kind(**options)
    except InputError as error:
        raise located(error, source.where("options")) from error
    except (TypeError, ValueError) as error:
        raise InputError(
            "E160",
            "options refused",
            where=source.where("options"),
            got=", ".join(f"{k} = {v}" for k, v in options.items()),
            expected=str(error),
            fix="correct the options",
        ) from error
    shared = {k: v for k, v in spec.parameters.items() if AT not in k}
    table = _table(plain.parameters, shared, source, ("parameters",))
    system: AbstractSystem = kind(parameters=table, **options)
    if spec.effects:
        system = _perturbed(system, spec.effects, source)
    return actuated(system, spec.actuators, source)


def _options(
    options: Mapping[str, Any], source: Source, kind: type[AbstractSystem]
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
            expected = words({**error.errors()[0]})
            fix = slips.of_value(("options", name), value, expected)
            raise InputError(
                "E160",
                "wrong value",
                where=where,
                got=repr(value)[:40],
                expected=expected,
                fix=fix or "correct the value",
            ) from error
    return out


def _table(
    table: Parameters,
    specs: Mapping[str, ParameterSpec | float],
    source: Source,
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
            raise located(unknown_parameter(name, known), where)
        changes[name] = prior(stated, base, where, fixed.get(name))
    return table.replace(**changes)


def _perturbed(
    system: AbstractSystem,
    specs: Mapping[str, Mapping[str, EffectSpec | float]],
    source: Source,
) -> AbstractSystem:
    """The machine with the effects of the file; magnitudes are constants by name."""
    assert isinstance(system, AbstractMechanism)  # as every class of `SYSTEMS` is
    added: list[AbstractEffect] = []
    stated: dict[str, Parameter | float] = {}
    possible = _possible(system)
    for where, kinds in specs.items():
        for what, said in kinds.items():
            line = source.where("effects", where, what)
            if what not in possible.get(where, ()):
                raise _impossible(what, where, possible, line)
            effect = _effect(what, where, said, line)
            added.append(effect)
            base = effect.parameter(system)
            stated[effect.name] = prior(said, base, line, own=0.0)
    table = Perturbed(system, added).parameters.replace(**stated)
    return Perturbed(system, added, table)


def _possible(system: AbstractMechanism) -> dict[str, list[str]]:
    """The effects that a machine can have, by joint and input."""
    found: dict[str, list[str]] = {}
    for channel in (*system.states[:2], *system.actions):
        for what, kind in EFFECTS.items():
            try:
                kind(where=channel.name, magnitude=1.0).unit(system)
            except InputError:
                continue
            found.setdefault(channel.name, []).append(what)
    return found


def _impossible(
    what: str, where: str, possible: Mapping[str, list[str]], line: str
) -> InputError:
    """An effect that this machine, or this channel, cannot have (E103, E145, E160)."""
    homes = [channel for channel, kinds in possible.items() if what in kinds]
    if where in EFFECTS:  # [effects.coulomb] and below it the keys of a prior
        fix = f"write [effects.CHANNEL.{where}]"
        return InputError(
            "E103",
            "unknown channel",
            where=line,
            got=where,
            expected="one of " + ", ".join(possible),
            fix=fix,
        )
    if what not in EFFECTS:
        return unknown("effect", what, possible.get(where, EFFECTS), line)
    if homes and where not in possible:
        close = nearest(where, homes) or homes[0]
        return InputError(
            "E103",
            "unknown channel",
            where=line,
            got=where,
            expected="one of " + ", ".join(homes),
            fix=f"did you mean {close}",
        )
    known = possible.get(where) or sorted(
        {k for kinds in possible.values() for k in kinds}
    )
    return InputError(
        "E145",
        f"no {what} on this machine" if not homes else f"no {what} on {where}",
        where=line,
        got=f"{where}.{what}",
        expected="one of " + ", ".join(known),
        fix=f"write [effects.{homes[0]}.{what}]" if homes else "use one of these",
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
    """What an effect has beside its magnitude, each one that it knows (E160)."""
    stated = () if isinstance(said, float) else EFFECT_OPTIONS
    given = {name: getattr(said, name) for name in stated}
    options = {name: value for name, value in given.items() if value is not None}
    for name in options:
        if name not in known:
            raise unknown(f"option of {what}", name, known, line)
    return options


def actuated(
    system: AbstractSystem, specs: Mapping[str, ActuatorSpec], source: Source
) -> AbstractSystem:
    """The machine behind its actuators; what the file does not name is neutral."""
    if not specs:
        return system
    channels = {channel.name: channel for channel in system.actions}
    stated: dict[str, Parameter | float] = {}
    for name, spec in specs.items():
        if name not in channels:
            raise unknown("input", name, channels, source.where("actuators", name))
        for part in ("gain", "offset", "delay"):
            said = getattr(spec, part)
            where = source.where("actuators", name, part)
            base = actuator_prior(channels[name], part)
            own = None if part == "delay" else ActuatorSpec.model_fields[part].default
            chosen = base if said == "free" else prior(said, base, where, own)
            _check_delay(part, chosen, where)
            stated[f"{name}.{part}"] = chosen
    return Actuated(system, stated)


def _check_delay(part: str, stated: Parameter | float, where: str) -> None:
    low = stated.low if isinstance(stated, Parameter) else stated
    if part == "delay" and low < 0:
        raise InputError(
            "E141",
            "negative delay",
            where=where,
            got=f"{low:g} s",
            expected="a delay of at least 0 s",
            fix="state low and high, with low >= 0",
        )


def unknown(kind: str, name: str, known: Collection[str], where: str) -> InputError:
    """E160 with the name that was probably meant."""
    close = nearest(name, known)
    fix = f"did you mean {close}" if close else slips.elsewhere(name)
    return InputError(
        "E160",
        f"unknown {kind}",
        where=where,
        got=name,
        expected="one of " + ", ".join(known) if known else f"no {kind}",
        fix=fix or ("use a known name" if known else "remove it"),
    )


def check_names(spec: ProjectSpec, source: Source, system: AbstractSystem) -> None:
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
                raise InputError(
                    "E160",
                    "a measured channel cannot be a constant",
                    where=where,
                    got=f"{value:g}",
                    expected="a column in quotes",
                    fix="name the column, or leave the channel out",
                )
        _check_complete(list(group.columns), states, inputs, source, i)
        _check_clock(group, source, i)
        for name in group.fixed:
            if name not in constants:
                where = source.where("logs", i, "fixed", name)
                raise located(unknown_parameter(name, constants), where)
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


def _check_likelihood(spec: ProjectSpec, source: Source, states: list[str]) -> None:
    """What the file says of windows, of states, and of noise is what is fitted."""
    stated = spec.likelihood
    if stated.window == 0.0 and "start" in stated.model_fields_set:
        raise InputError(
            "E160",
            "start of windows of one step",
            where=source.where("likelihood", "start"),
            got=f'window = 0, start = "{stated.start}"',
            expected="no start: a step begins at its first row",
            fix="remove start, or set window to some tenths of a second",
        )
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
    named: list[str], states: list[str], inputs: list[str], source: Source, i: int
) -> None:
    """Every input is known, and something is measured."""
    where = source.where("logs", i, "columns")
    lacking = [name for name in inputs if name not in named]
    if not set(named) & set(states):
        lacking = lacking or states
    elif not lacking:
        return
    raise InputError(
        "E160",
        f"no column for {lacking[0]}",
        where=where,
        got=", ".join(named) or "no columns",
        expected="every input, and at least one measured channel",
        fix=f'add {lacking[0]} = "its column" (an input may be a constant number)',
    )


def _check_clock(group: LogSpec, source: Source, i: int) -> None:
    """Time comes from a column or a period; rows from a period or from stamps."""
    if isinstance(group.time, ColumnSpec) and group.time.saturation is not None:
        raise InputError(
            "E160",
            "saturation of a clock",
            where=source.where("logs", i, "time", "saturation"),
            got=f"saturation = {group.time.saturation}",
            expected="column, unit, sign, scale, offset",
            fix="remove it, or leave rows out by exclude",
        )
    pairs: list[tuple[str, str, object, object]]
    pairs = [("time", "period", group.time, group.period)]
    if group.resample is not None:
        rule = group.resample
        pairs += [("resample.period", "resample.stamps", rule.period, rule.stamps)]
    for one, other, first, second in pairs:
        if first is not None and second is not None:
            raise InputError(
                "E160",
                f"{one} and {other}",
                where=source.where("logs", i, *other.split(".")),
                got=f"{other} = {second!r}",
                expected="one of the two",
                fix=f"remove {one} or {other}",
            )


def _check_pair(what: str, low: float, high: float, where: str) -> None:
    if not low < high:
        raise InputError(
            "E141",
            f"{what} reversed" if low > high else f"{what} empty",
            where=where,
            got=f"[{low:g}, {high:g}]",
            expected="[low, high] with low < high",
            fix="swap the two" if low > high else "leave room between them",
        )
