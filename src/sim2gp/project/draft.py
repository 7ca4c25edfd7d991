"""The first project file: a model and some recordings in, a checked draft out.

Every guess stands in the file with its reason, for whoever knows the machine to read.
What is written can be identified as it stands: it is loaded, with its logs, before it
takes its place.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.data.logs import Budget, Column, read_log
from sim2gp.data.logs.formats import recordings
from sim2gp.data.logs.units import UNITS
from sim2gp.errors import InputError
from sim2gp.project.columns import Match, match, time_column
from sim2gp.project.project import (
    SYSTEMS,
    is_model,
    system_class,
    unknown_system,
)
from sim2gp.project.readings import SURE, Found, Reading, Version, find_readings
from sim2gp.project.replace import key as toml_key
from sim2gp.project.replace import quoted, replace_project
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.units import joints_of
from sim2gp.types import Key

DELAY = 0.04  # s, the longest that a draft lets an input be late
LARGE = 3.2  # rad or m of travel that may be degrees or millimetres
LISTED = 40  # constants that are named in the file


@dataclass(frozen=True)
class Draft:
    """What was found: the file's text, each channel's column, and why."""

    system: AbstractSystem
    text: str
    columns: dict[str, Match]
    found: Found


def draft_project(
    model: str,
    files: Sequence[Path],
    out: Path,
    *,
    key: Key,
    period: float | None = None,
    budget: Budget | None = None,
) -> Draft:
    """Write the project file ``out`` for a bundled machine or a model's file.

    ``period`` in s stands for a column of time; reading one file may take the
    ``budget``. Raises `InputError` E103 where a joint
    or an input finds no column, E160 for an unknown machine, and the codes of models
    and logs.
    """
    system = _machine(model)
    budget = budget or Budget()
    time, columns = _columns(files[0], system, period, budget)
    stated = {name: m.column for name, m in columns.items()}
    versions = _versions(system, files, stated, time, period, budget)
    found = find_readings(system, versions, key=key)
    said = {name: _as_read(name, m, found) for name, m in columns.items()}
    text = _text(model, files, out, system, time, period, said, found)
    replace_project(out, text, lambda p: replace(p, budget=budget).load_logs())
    return Draft(system, text, said, found)


def _machine(model: str) -> AbstractSystem:
    """A bundled machine by name, or a model by its file."""
    if model in SYSTEMS:
        kind: Any = system_class(model)  # concrete, and content without arguments
        bare: AbstractSystem = kind()
        return bare
    if is_model(model):
        from sim2gp.systems import MuJoCo

        return MuJoCo(Path(model))
    raise unknown_system(model, "the command line")


def _columns(
    file: Path, system: AbstractSystem, period: float | None, budget: Budget
) -> tuple[Match | None, dict[str, Match]]:
    """The column of time, where the format needs one, and those of the channels."""
    tables = recordings(file, None, period=period, budget=budget)[0].tables
    main = max(tables, key=lambda t: len(t.rows.numbers) * len(t.columns))
    columns, clock, time = dict(main.columns), main.clock, None
    where = main.rows.source
    if period is not None:
        clock = period * np.arange(len(main.rows.numbers))
    elif clock is None:
        time = time_column(columns, where)
        clock = _seconds(columns.pop(time.column.column), time.column)
    for other in tables:
        if other is not main and other.clock is not None:
            for name, x in other.columns.items():  # to be looked at, not to be fitted
                columns[name] = np.interp(clock, other.clock, x)
    found = match(columns, clock, system.physical_states, system.actions, where)
    return time, found


def _seconds(x: np.ndarray, column: Column) -> np.ndarray:
    return np.asarray(x * UNITS[column.unit or "s"][1])


def _versions(
    system: AbstractSystem,
    files: Sequence[Path],
    stated: Mapping[str, Column],
    time: Match | None,
    period: float | None,
    budget: Budget,
) -> list[Version]:
    """The logs in the units that names tell, and in others that may be meant."""
    versions: list[Version] = []
    first: InputError | None = None
    for columns in (stated, _in_other_units(system, stated)):
        if versions and not _large(versions[0], system):
            break
        try:
            logs = [
                log
                for file in files
                for log in read_log(
                    file,
                    columns,
                    states=system.physical_states,
                    actions=system.actions,
                    time=None if time is None else time.column,
                    period=period,
                    budget=budget,
                )
            ]
            versions.append(Version(columns, logs))
        except InputError as error:
            first = first or error
            if error.code != "E107":
                raise
    if not versions and first is not None:
        raise first
    return versions


def _in_other_units(
    system: AbstractSystem, stated: Mapping[str, Column]
) -> dict[str, Column]:
    """Degrees for radians, millimetres for metres, wherever no name says what it is."""
    meant = {"rad": "deg", "rad/s": "deg/s", "m": "mm", "m/s": "mm/s"}
    own = {c.name: c.unit for c in system.physical_states}
    return {
        name: replace(column, unit=column.unit or meant.get(own.get(name, "")))
        for name, column in stated.items()
    }


def _large(version: Version, system: AbstractSystem) -> bool:
    """Whether a joint without a unit travels so far that it may be in a smaller one."""
    joints = [c.name for c in joints_of(system)]
    return any(
        np.ptp(log.channels[name]) > LARGE
        for log in version.logs
        for name in joints
        if name in log.channels and version.columns[name].unit is None
    )


def _as_read(name: str, found: Match, readings: Found) -> Match:
    """A channel's column in the reading that was found, with its reason."""
    joint = name.removesuffix(".velocity")
    reading = readings.readings[joint]
    column = reading.of(readings.version.columns[name], rate=name != joint)
    if name not in readings.readings:
        return Match(column, found.why)
    surer = readings.surer[name]
    if surer == np.inf:
        why = "no other reading comes near"
    elif surer > SURE:
        why = f"the next is {surer:.0f} nats behind"
    else:
        why = "the logs hardly tell: look"
    why = f"{reading_words(reading)} ({why})"
    return Match(column, f"{found.why}; {why}")


def reading_words(reading: Reading) -> str:
    """`as it stands`, or what is done to a column."""
    words = []
    if reading.sign < 0:
        words.append("turned round")
    if reading.offset:
        words.append("zero half a turn away")
    return " and ".join(words) or "as it stands"


def _text(
    model: str,
    files: Sequence[Path],
    out: Path,
    system: AbstractSystem,
    time: Match | None,
    period: float | None,
    columns: Mapping[str, Match],
    found: Found,
) -> str:
    folder = out.parent
    named = _relative(Path(model), folder) if is_model(model) else model
    listed = [_relative(file, folder) for file in files]
    rows = [
        "# A draft by sim2gp init: every guess has its reason beside it. Read them.",
        f"system = {quoted(named)}",
        "",
        *_constants(system, is_model(model)),
        "",
        "[[logs]]",
        f"files = [{', '.join(quoted(file) for file in listed)}]",
    ]
    if time is not None:
        rows.append(f"time = {_value(time.column)}  # {time.why}")
    elif period is not None:
        rows.append(f"period = {period!r}")
    if found.images > 1:
        rows += [
            "",
            f"# {found.images} ways to read these columns, mirror images and the like,",
            "# are one to the machine: this is the plainest of them.",
        ]
    rows.append("[logs.columns]")
    for name, m in columns.items():
        rows.append(f"{toml_key(name)} = {_value(m.column)}  # {m.why}")
    rows += ["", "# Inputs act late on most machines; delay = 0.0 takes that out."]
    for channel in system.actions:
        rows.append(f"[actuators.{toml_key(channel.name)}]")
        rows.append(f"delay = {{low = 0.0, high = {DELAY}}}")
    return "\n".join(rows) + "\n"


def _constants(system: AbstractSystem, file: bool) -> list[str]:
    """What is open, and how to say more about it."""
    table = system.parameters.free
    whose = "within a factor of three of the file's numbers" if file else "as bundled"
    rows = [f"# {len(table)} constants are open, {whose}:"]
    nominal = system.parameters.nominal()
    for p in table[:LISTED]:
        rows.append(f"#   {p.name} = {nominal[p.name]:.4g} {p.unit}".rstrip())
    if len(table) > LISTED:
        rows.append(f"#   and {len(table) - LISTED} more")
    example = toml_key(table[0].name) if table else "NAME"
    rows.append(f"# To say what you know: [parameters.{example}] mean = ... sd = ...")
    return rows


def _value(column: Column) -> str:
    """A column as the file says it."""
    plain = Column(column.column)
    if column == plain:
        return quoted(column.column)
    words = [f"column = {quoted(column.column)}"]
    if column.unit is not None:
        words.append(f"unit = {quoted(column.unit)}")
    if column.sign != plain.sign:
        words.append(f"sign = {column.sign}")
    if column.offset != plain.offset:
        words.append(f"offset = {column.offset!r}")
    return "{" + ", ".join(words) + "}"


def _relative(file: Path, folder: Path) -> str:
    return Path(os.path.relpath(file, folder)).as_posix()


def told(draft: Draft, out: Path) -> dict[str, Any]:
    """The summary of a draft."""
    table = {
        name: {
            "column": m.column.column,
            "unit": m.column.unit or "",
            "sign": m.column.sign,
            "offset": m.column.offset,
            "why": m.why,
        }
        for name, m in draft.columns.items()
    }
    doubts = [name for name, surer in draft.found.surer.items() if surer <= SURE]
    return {
        "command": "init",
        "headline": f"Wrote {out}: read it, then sim2gp identify {out}",
        "file": str(out),
        "columns": table,
        "open_constants": len(draft.system.parameters.free),
        "warnings": [
            f"W160 the logs hardly tell how {n} is to be read" for n in doubts
        ],
    }
