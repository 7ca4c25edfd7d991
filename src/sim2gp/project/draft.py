"""The first project file: a model and some recordings in, a checked draft out.

Every guess is in the file with its reason, for the user who knows the machine to read.
Parameters of a model's file that the logs cannot separate are held, and the file says
so. What is written can be identified as it is: it is loaded, with its logs, before it
takes its place. Without recordings the file says which columns they need.
"""

import time
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.data.clock import clock_lines
from sim2gp.data.logs import Budget, Column, Log, read_log
from sim2gp.data.logs.formats import read_recordings
from sim2gp.data.logs.units import UNITS
from sim2gp.errors import InputError
from sim2gp.identification.identifiability.selection import Selection
from sim2gp.identification.words import join_names
from sim2gp.project.columns import Match, match, time_column
from sim2gp.project.draft_text import Contents, draft_text
from sim2gp.project.open_constants import try_selection
from sim2gp.project.project import (
    SYSTEMS,
    Project,
    is_model,
    system_class,
    unknown_system,
)
from sim2gp.project.readings import (
    SURE,
    BestReadings,
    Question,
    Reading,
    find_readings,
    finer,
)
from sim2gp.project.replace import replace_project
from sim2gp.systems import MuJoCo
from sim2gp.systems.base import AbstractSystem, Channel
from sim2gp.systems.effects.units import joints_of

LARGE = 3.2  # rad or m of travel that may be degrees or millimetres
TURNS = 25.0  # rad or m: more is rather degrees or millimetres
FAR = 10.0  # times the range of a joint: no log in the right unit travels so far
SHARE = 0.8  # of the time, after which no further reading is begun
_MENDS = {"E101": "drop_nonfinite", "E108": "keep_first"}  # said in the draft
_SMALLER = {"rad": "deg", "m": "mm"}


@dataclass(frozen=True)
class Request:
    """What a draft is made of.

    model: a bundled machine's name or a model's file; ``root`` the folder in which all
        files of that model lie, its own if None.
    files: the recordings, alike in their columns; none is a draft without logs.
    period: s between rows, in place of a column of time.
    constant: inputs that have no column, and the number that each was held at.
    columns: of channels whose columns are known; the others' are looked for.
    readings: whether signs, zeros and units are tried; ``seconds`` that the whole draft
        may take from ``started`` (of `time.monotonic`).
    step: gets the name of each stage that is done: three with logs, one without.
    """

    model: str
    files: Sequence[Path]
    out: Path
    root: Path | None = None
    period: float | None = None
    constant: Mapping[str, float] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    readings: bool = True
    seconds: float = 60.0
    started: float = field(default_factory=time.monotonic)
    budget: Budget = field(default_factory=Budget)
    step: Callable[[str], None] = lambda done: None


@dataclass(frozen=True)
class Draft:
    """What was found: the file's text, each channel's column, and why.

    ``mended`` has the keys of `_MENDS` without which the logs cannot be read, and why.
    """

    system: AbstractSystem
    text: str
    columns: dict[str, Match]
    found: BestReadings
    mended: Mapping[str, str] = field(default_factory=dict)
    selection: Selection | None = None


def draft_project(asked: Request) -> Draft:
    """Write the project file for a bundled machine or a model's file.

    Raises `InputError` E103 where a joint or an input finds no column, E160 for an
    unknown machine, and the codes of models and logs.
    """
    system = _find_machine(asked)
    if not asked.files:
        bare = Contents(asked.model, (), asked.out, system, asked.root)
        replace_project(asked.out, draft_text(bare), lambda _: None)
        asked.step("project file")
        return Draft(system, draft_text(bare), {}, BestReadings({}))
    time_, columns, travel = _match_columns(asked, system)
    asked.step("columns matched; trying readings")
    options = _reading_options(system, columns, travel)
    read = {n: _in_unit(n, m.column, options) for n, m in columns.items()}
    logs, mended = _mended_logs(asked, system, read, time_)
    question = Question(logs, options, _together(system, options))
    until = asked.started + SHARE * asked.seconds
    if not asked.readings:
        until = -np.inf
    found = find_readings(system, question, until=until)
    asked.step("readings tried; choosing what is open")
    reason = f"the {asked.seconds:g} s were over" if asked.readings else "--no-readings"
    said = {n: _as_read(n, m, found, options, reason) for n, m in columns.items()}
    contents = Contents(
        asked.model, asked.files, asked.out, system, asked.root, time_,
        asked.period, said, asked.constant, found.images,
        max(float(np.ptp(log.time)) for log in logs), clock_lines(logs, system),
        mended,
    )  # fmt: skip
    text, ready = draft_text(contents), []

    def check(project: Project) -> None:
        project = replace(project, budget=asked.budget)
        ready.append((project, project.load_logs()))

    replace_project(asked.out, text, check)
    if asked.readings and is_model(asked.model):
        limit = asked.started, asked.seconds
        selection, why = try_selection(*ready[0], *limit)
        contents = replace(contents, selection=selection, unselected=why)
        text = draft_text(contents)
        replace_project(asked.out, text, lambda _: None)
    asked.step("project file")
    return Draft(system, text, said, found, mended, contents.selection)


def _find_machine(asked: Request) -> AbstractSystem:
    """A bundled machine by name, or a model by its file."""
    if asked.model in SYSTEMS:
        kind: Any = system_class(asked.model)  # concrete, and content without arguments
        bare: AbstractSystem = kind()
        return bare
    if is_model(asked.model):
        return MuJoCo(Path(asked.model), root=asked.root)
    raise unknown_system(asked.model, "the command line")


def _match_columns(
    asked: Request, system: AbstractSystem
) -> tuple[Match | None, dict[str, Match], dict[str, float]]:
    """The column of time, where the format needs one, and those of the channels.

    And how far each of these travels, in the numbers of the file.
    """
    file, budget = asked.files[0], asked.budget
    period = asked.period
    tables = read_recordings(file, None, period=period, budget=budget)[0].tables
    main = max(tables, key=lambda t: len(t.rows.numbers) * len(t.columns))
    columns, clock, named = dict(main.columns), main.clock, None
    where = main.rows.source
    if period is not None:
        clock = period * np.arange(len(main.rows.numbers))
    elif clock is None:
        named = time_column(columns, where)
        clock = _seconds(columns.pop(named.column.column), named.column)
    for other in tables:
        if other is not main and other.clock is not None:
            for name, x in other.columns.items():  # to be looked at, not to be fitted
                columns[name] = np.interp(clock, other.clock, x)
    open_ = [c for c in system.actions if c.name not in asked.constant]
    states, given = system.physical_states, asked.columns
    found = match(columns, clock, states, open_, where, given)
    travel = {name: _travel(columns[m.column.column]) for name, m in found.items()}
    return named, found, travel


def _travel(x: np.ndarray) -> float:
    known = x[np.isfinite(x)]
    return float(np.ptp(known)) if known.size else 0.0


def _seconds(x: np.ndarray, column: Column) -> np.ndarray:
    return np.asarray(x * UNITS[column.unit or "s"][1])


def _reading_options(
    system: AbstractSystem, columns: Mapping[str, Match], travel: Mapping[str, float]
) -> dict[str, list[Reading]]:
    """Both signs, half a turn's zero where a joint turns freely, and two units.

    Degrees or millimetres where no name gives the unit and the column travels far.
    """
    joints = {c.name: c for c in joints_of(system)}
    drives = system.drives if isinstance(system, MuJoCo) else {}
    servos = system.servos if isinstance(system, MuJoCo) else ()
    found = {}
    for channel in (*joints.values(), *system.actions):
        name = channel.name
        if name not in columns:
            continue
        joint = joints.get(name)
        if joint is None and name in servos:
            joint = joints.get(drives.get(name, ""))
        turns = joint is not None and joint.angle
        zeros = (0.0, np.pi) if turns else (0.0,)
        stated = columns[name].column.unit is not None
        units = [None] if stated else _possible_units(channel, travel[name])
        found[name] = [Reading(s, z, u) for u in units for z in zeros for s in (1, -1)]
    return found


def _possible_units(channel: Channel, travel: float) -> list[str | None]:
    """The units that a column may be in, by its travel, the likely one first."""
    smaller, reach = _SMALLER.get(channel.unit), FAR * (channel.high - channel.low)
    if smaller is None or travel <= min(LARGE, reach):
        return [None]
    if travel > reach:
        return [smaller]
    return [smaller, None] if travel > TURNS else [None, smaller]


def _together(
    system: AbstractSystem, options: Mapping[str, Sequence[Reading]]
) -> list[list[str]]:
    """Each joint with the inputs that act on it: to turn one alone is never right."""
    drives = system.drives if isinstance(system, MuJoCo) else {}
    groups: dict[str, list[str]] = {}
    for name in options:
        groups.setdefault(drives.get(name, name), []).append(name)
    return list(groups.values())


def _in_unit(
    name: str, column: Column, options: Mapping[str, Sequence[Reading]]
) -> Column:
    """The column in the last unit that it may be in: no number is too large then."""
    joint = name.removesuffix(".velocity")
    if joint not in options:
        return column
    return Reading(unit=finer(options[joint])).of(column, rate=name != joint)


def _mended_logs(
    asked: Request,
    system: AbstractSystem,
    columns: Mapping[str, Column],
    clock: Match | None,
) -> tuple[list[Log], dict[str, str]]:
    """The logs, and the keys of `_MENDS` that they need, with why."""
    keys: dict[str, str] = {}
    while True:
        try:
            return _draft_logs(asked, system, columns, clock, keys), keys
        except InputError as error:
            key = _MENDS.get(error.code, "")
            if not key or key in keys or f"{key} = true" not in error.fix:
                raise
            keys[key] = f"{error.what} in {error.where}"


def _draft_logs(
    asked: Request,
    system: AbstractSystem,
    columns: Mapping[str, Column],
    clock: Match | None,
    mended: Container[str],
) -> list[Log]:
    return [
        log
        for file in asked.files
        for log in read_log(
            file,
            {**columns, **asked.constant},
            states=system.physical_states,
            actions=system.actions,
            time=None if clock is None else clock.column,
            period=asked.period,
            budget=asked.budget,
            drop_nonfinite="drop_nonfinite" in mended,
            keep_first="keep_first" in mended,
        )
    ]


def _as_read(
    name: str,
    found: Match,
    readings: BestReadings,
    options: Mapping[str, Sequence[Reading]],
    untried: str,
) -> Match:
    """A channel's column in the reading that was found, with its reason."""
    joint = name.removesuffix(".velocity")
    if joint not in options:
        return found
    reading = readings.readings[joint]
    column = reading.of(found.column, rate=name != joint)
    if name != joint or len(options[name]) == 1:
        return Match(column, found.why)
    words = _reading_text(reading)
    if name not in readings.surer:
        asked = _differing_words(options[name])
        return Match(column, f"{found.why}; {asked} not tried: {untried}")
    surer = readings.surer[name]
    if surer > SURE:
        why = "the model predicts the log best so"
    else:
        rival = readings.rivals[name].items()
        other = [
            f"{n} {_reading_text(r)}" for n, r in rival if r != readings.readings[n]
        ]
        why = f"look: the log hardly tells this from {' and '.join(other)}"
    return Match(column, f"{found.why}; {words} ({why})")


def _reading_text(reading: Reading) -> str:
    """`as recorded`, or what is done to a column."""
    words = [f"in {reading.unit}"] if reading.unit else []
    if reading.sign < 0:
        words.append("turned round")
    if reading.offset:
        words.append("zero half a turn away")
    return " and ".join(words) or "as recorded"


def _differing_words(options: Sequence[Reading]) -> str:
    """What the readings of a channel differ in."""
    parts = [("sign", "sign"), ("zero", "offset"), ("unit", "unit")]
    differ = [w for w, key in parts if len({getattr(r, key) for r in options}) > 1]
    return " and ".join(differ)


def draft_summary(draft: Draft, out: Path) -> dict[str, Any]:
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
    surer = draft.found.surer
    held = draft.selection.held if draft.selection else {}
    doubts = [name for name, z in surer.items() if z <= SURE]
    untried = [
        name
        for name, m in draft.columns.items()
        if name not in surer and "not tried" in m.why
    ]
    warnings = [
        f"the file has {key} = true: {why}" for key, why in draft.mended.items()
    ]
    if doubts:
        are = "is" if len(doubts) == 1 else "are"
        warnings.append(
            f"W160 the logs hardly show how {join_names(doubts)} {are} to be read: "
            "check unit, sign and offset in the file"
        )
    if untried:
        warnings.append(f"W160 not tried how to read {', '.join(untried)}")
    return {
        "command": "init",
        "headline": f"Wrote {out}: read it, then sim2gp identify {out}",
        "file": str(out),
        "columns": table,
        "open_parameters": len(draft.system.parameters) - len(held),
        **({"held_parameters": list(held)} if held else {}),
        "warnings": warnings,
    }
