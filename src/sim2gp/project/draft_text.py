"""The words of a first project file: what was found, and the reason of each guess."""

import math
import os
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sim2gp.data.logs import Column
from sim2gp.identification.identifiability.selection import Selection
from sim2gp.identification.words import digits, linear_sum
from sim2gp.inference.parameters import Parameter
from sim2gp.project.columns import Match
from sim2gp.project.project import is_model
from sim2gp.project.replace import key as toml_key
from sim2gp.project.replace import quote
from sim2gp.systems import MuJoCo
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.mujoco.constants import constants_of

DELAY = 0.04  # s, the longest that a draft lets an input be late
#: Shortest and longest windows of an arm with servos, s (`benchmarks/arm_windows.py`).
WINDOWS = 1.0, 5.0
LISTED = 40  # parameters that are named in the file
_GAINS = ("kp", "kv")


@dataclass(frozen=True)
class Contents:
    """What a draft says.

    ``longest`` is the duration of the longest log in s, ``clock`` how the rows of the
    logs and the model's steps go together, ``mended`` keys without which the logs are
    refused, and why. ``unselected`` is why there is no ``selection``, where one was to
    be made.
    """

    model: str
    files: Sequence[Path]
    out: Path
    system: AbstractSystem
    root: Path | None = None
    time: Match | None = None
    period: float | None = None
    columns: Mapping[str, Match] = field(default_factory=dict)
    constant: Mapping[str, float] = field(default_factory=dict)
    images: int = 1
    longest: float = 0.0
    clock: Sequence[str] = ()
    mended: Mapping[str, str] = field(default_factory=dict)
    selection: Selection | None = None
    unselected: str = ""


def draft_text(c: Contents) -> str:
    """The project file as TOML."""
    folder, file = c.out.parent, is_model(c.model)
    named = _relative_path(Path(c.model), folder) if file else c.model
    rows = [
        "# A draft by sim2gp init: every guess has its reason next to it. Read them.",
        f"system = {quote(named)}",
        "",
    ]
    if c.root is not None:
        rows += ["[options]", f"root = {quote(_relative_path(c.root, folder))}", ""]
    rows += _constant_lines(c, file)
    rows += ["", *(_log_lines(c) if c.files else _wanted(c.system))]
    if isinstance(c.system, MuJoCo) and c.system.servos:
        rows += ["", *_window(c.longest if c.files else math.inf)]
    if c.system.actions:
        rows += ["", *_delays(c.system)]
    return "\n".join(rows) + "\n"


def _constant_lines(c: Contents, file: bool) -> list[str]:
    """What is open, what is held, and how to say more about it."""
    table, nominal = c.system.parameters.free, c.system.parameters.nominal()
    selection = c.selection or Selection({}, {})
    opened = [p for p in table if p.name not in selection.held]
    whose = "within a factor of three of the file's numbers" if file else "as bundled"
    count = "1 parameter is" if len(opened) == 1 else f"{len(opened)} parameters are"
    rows = [f"# {count} open, {whose}:"]
    if c.unselected:
        rows.append(f"# (which of them the logs tell apart is {c.unselected})")
    value = {p.name: _value_and_range(p, nominal[p.name]) for p in table}
    if selection.held:
        rows += _selected(selection, [p.name for p in opened], value)
        known = "{mean = ..., sd = ...} or {low = ..., high = ...}"
        rows.append(f'# To say what you know: "NAME" = {known}')
    else:
        rows += [f"#   {p.name} = {value[p.name]}" for p in table[:LISTED]]
        if len(table) > LISTED:
            rows.append(f"#   and {len(table) - LISTED} more")
        example = toml_key(table[0].name) if table else "NAME"
        known = f"[parameters.{example}] mean = ... sd = ..."
        rows.append(f"# To say what you know: {known}, or low = ... high = ...")
    if _has_servos(c.system):
        rows += [
            "# Not open, as the model has them: the gains of the servos, kp and kv.",
            "# Masses, friction and these gains share a factor that logs of positions",
            "# and targets do not tell. Open one if you know the masses.",
        ]
    return rows


def _value_and_range(parameter: Parameter, value: float) -> str:
    """The file's number, and how far from it a fit may go."""
    text = f"{value:.4g} {parameter.unit}".rstrip()
    ends = parameter.low, parameter.high
    if not all(map(math.isfinite, ends)):
        return text
    return f"{text}, from {ends[0]:.3g} to {ends[1]:.3g}"


def _selected(
    selection: Selection, opened: Sequence[str], value: Mapping[str, str]
) -> list[str]:
    """The open parameters, then the held ones with what the logs say of them."""
    rows = ["[parameters]"]
    for name in opened:
        taken = selection.stands_for.get(name)
        row = f"{toml_key(name)} = {{}}  # {value[name]}"
        if taken:
            terms = [(1.0, name), *((w, other) for other, w in taken.items())]
            row += f"; stands for {linear_sum(terms, 3)}"
        rows.append(row)
    rows += [
        "# Held at the file's numbers: the logs do not depend on these, or not apart",
        "# from the open ones. To open one, remove its #.",
    ]
    for name, left in selection.held.items():
        share = f"the logs leave {digits(100.0 * left)} % of its spread"
        rows.append(f"# {toml_key(name)} = {{}}  # {value[name]}; {share}")
    return rows


def _has_servos(system: AbstractSystem) -> bool:
    if not isinstance(system, MuJoCo):
        return False
    known = constants_of(system.engine.model).values()
    return any(c.kind == "actuator" and c.quantity in _GAINS for c in known)


def _log_lines(c: Contents) -> list[str]:
    """The recordings, and the column of each channel."""
    listed = [quote(_relative_path(file, c.out.parent)) for file in c.files]
    rows = ["[[logs]]", f"files = [{', '.join(listed)}]"]
    if c.time is not None:
        rows.append(f"time = {_column_text(c.time.column)}  # {c.time.why}")
    elif c.period is not None:
        rows.append(f"period = {c.period!r}")
    rows += [f"{key} = true  # {why}" for key, why in c.mended.items()]
    rows += [f"# {part}" for line in c.clock for part in textwrap.wrap(line, 80)]
    if c.images > 1:
        rows += [
            "",
            f"# {c.images} ways to read these columns, mirror images and the like,",
            "# are one to the machine: this is the plainest of them.",
        ]
    rows.append("[logs.columns]")
    for name, m in c.columns.items():
        rows.append(f"{toml_key(name)} = {_column_text(m.column)}  # {m.why}")
    for name, value in c.constant.items():
        rows.append(f"{toml_key(name)} = {value!r}  # constant, as --constant says")
    return rows


def _wanted(system: AbstractSystem) -> list[str]:
    """Without a log: the columns that one needs, and how it is named here."""
    states = [c for c in system.physical_states if not c.name.endswith(".activation")]
    joints = [c for c in states if not c.name.endswith(".velocity")]
    rates = [c for c in states if c.name.endswith(".velocity")]
    rows = ["# There is no log yet. One needs a row for each sample, with the columns"]
    rows.append("#   time in s")
    rows += [f"#   {c.name} in {_unit(c.unit)}, measured" for c in joints]
    rows += [f"#   {c.name} in {_unit(c.unit)}, as commanded" for c in system.actions]
    if rates:
        rows.append("# and, where they are measured, the velocities")
        rows += [f"#   {c.name} in {c.unit}" for c in rates]
    if system.actions:
        rows.append("# Record the commands that were sent, in the units of the model.")
    rows += [
        "# Then run sim2gp init MODEL LOG --out FILE for another draft, or add it:",
        "# [[logs]]",
        '# files = ["run.csv"]',
        "# [logs.columns]",
        *(f'# {toml_key(c.name)} = "{c.name}"' for c in (*joints, *system.actions)),
    ]
    return rows


def _unit(unit: str) -> str:
    return "the model's unit" if unit == "1" else unit


def window_of(longest: float) -> float:
    """Length of the windows of an arm with servos, of its longest log; both in s."""
    low, high = WINDOWS
    return int(1e3 * min(max(low, 0.5 * longest), high, longest)) / 1e3


def _window(longest: float) -> list[str]:
    """A servo hides masses and friction for some tenths of a second."""
    window = window_of(longest)
    return [
        "# Servos hide masses and friction in short windows: of a six-axis arm with",
        "# 30 s of log, .2, 1 and 5 s left median errors of .093, .055 and .047.",
        "[likelihood]",
        f"window = {window!r}",
    ]


def _delays(system: AbstractSystem) -> list[str]:
    """An open delay of each input; the drives of a model share theirs."""
    rows = ["# Inputs act late on most machines; delay = 0.0 takes that out."]
    delay = f"delay = {{low = 0.0, high = {DELAY}}}"
    if isinstance(system, MuJoCo) and len(system.actions) > 1:
        rows.append("# One delay for all drives: without tie each has its own.")
        return [*rows, '[actuators."*"]', delay, "tie = true"]
    for channel in system.actions:
        rows += [f"[actuators.{toml_key(channel.name)}]", delay]
    return rows


def _column_text(column: Column) -> str:
    """A column as the file says it."""
    plain = Column(column.column)
    if column == plain:
        return quote(column.column)
    words = [f"column = {quote(column.column)}"]
    if column.unit is not None:
        words.append(f"unit = {quote(column.unit)}")
    if column.sign != plain.sign:
        words.append(f"sign = {column.sign}")
    if column.offset != plain.offset:
        words.append(f"offset = {column.offset!r}")
    return "{" + ", ".join(words) + "}"


def _relative_path(file: Path, folder: Path) -> str:
    return Path(os.path.relpath(file, folder)).as_posix()
