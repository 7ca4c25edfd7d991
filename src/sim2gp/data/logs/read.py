"""Recordings of a robot become logs: named, converted, unwrapped, masked, cut.

The order matters: drop excluded rows, convert the unit, unwrap angles (a turn is 2 pi
before any sign or scale), apply sign, scale and offset, mask, bring all streams on one
clock, then cut the recording where time has a gap or rows were excluded. Excluded rows
are cut out and not only masked, because what disturbed the machine there also moved it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from sim2gp.data.logs import checks
from sim2gp.data.logs.alignment import alignment_notes
from sim2gp.data.logs.budget import Budget
from sim2gp.data.logs.file import display_path
from sim2gp.data.logs.formats import BOOKKEEPING, TIME, Recording, read_recordings
from sim2gp.data.logs.log import ChannelLike, Column, Log, Note, RawLog
from sim2gp.data.logs.resample import Resample, Track, join_tracks
from sim2gp.data.logs.table import LogTable, Rows
from sim2gp.data.logs.units import unit_factor
from sim2gp.errors import InputError, error

Values = Float[np.ndarray, " N"]
Mask = Bool[np.ndarray, " N"]


@dataclass(frozen=True)
class _Plan:
    """What the user says of a group of files, and the channels that it is for."""

    columns: Mapping[str, Column | float]
    states: Sequence[ChannelLike]
    actions: Sequence[ChannelLike]
    clock: Column  # of time, in s unless it says otherwise
    period: float | None
    resample: Resample | None
    exclude: Sequence[tuple[float, float]]
    drop_nonfinite: bool
    keep_first: bool
    limits: Mapping[str, tuple[float, float]]

    def held(self, among: Sequence[ChannelLike], table: LogTable) -> dict[str, Column]:
        """The columns of some channels that are in a table."""
        found = {c.name: self.columns.get(c.name) for c in among}
        return {
            name: spec
            for name, spec in found.items()
            if isinstance(spec, Column) and spec.column in table.columns
        }


def read_log(
    path: Path | str | RawLog,
    columns: Mapping[str, Column | float],
    *,
    states: Sequence[ChannelLike],
    actions: Sequence[ChannelLike],
    time: Column | str | None = None,
    period: float | None = None,
    episode: str | None = None,
    resample: Resample | None = None,
    exclude: Sequence[tuple[float, float]] = (),
    drop_nonfinite: bool = False,
    keep_first: bool = False,
    limits: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, float] | None = None,
    group: int = 0,
    longest_delay: float = 0.0,
    budget: Budget | None = None,
) -> tuple[Log, ...]:
    """Read a file, a folder or columns into logs without gaps, episode by episode.

    A number for an input holds it constant. ``time`` is a column, in a bag "header" or
    "log"; ``period`` in s replaces it where rows are even; ``episode`` is a column of
    numbers. ``exclude`` lists intervals of the file's time in s; a log is cut around
    them. ``limits`` are end stops of states, in their units: samples there are masked.
    ``keep_first`` drops further rows of a stamp; a ``longest_delay`` is the model's.
    Reading may take the ``budget``: 2 GiB unpacked and 60 s, if None (E126).
    Raises `InputError` with the codes of bad recordings (E101 to E141, E180, E182).
    """
    path = path if isinstance(path, RawLog) else Path(path)
    place = path.name if isinstance(path, RawLog) else display_path(path)
    checks.check_column_names(columns, states, actions, place)
    named = time.column if isinstance(time, Column) else time
    clock = time if isinstance(time, Column) else Column(time or TIME, "s")
    plan = _Plan(
        columns, states, actions, clock, period, resample, exclude,
        drop_nonfinite, keep_first, limits or {},
    )  # fmt: skip
    specs = [spec for spec in columns.values() if isinstance(spec, Column)]
    wanted = list(dict.fromkeys(spec.column for spec in specs))
    try:
        found = read_recordings(
            path, wanted, time=named, period=period, episode=episode, budget=budget
        )
    except InputError as error:
        raise _or_constant(error, plan) from error
    about = checks.unused_columns(_unread_columns(found[0].tables), place)
    logs = _logs_of_recordings(found, plan, path, dict(fixed or {}), group, about)
    if not logs:
        raise _too_short(place, 1)
    about += alignment_notes(max(logs, key=len), states, longest_delay)
    return (replace(logs[0], notes=(*logs[0].notes, *about)), *logs[1:])


def _logs_of_recordings(
    found: Sequence[Recording],
    plan: _Plan,
    path: Path | RawLog,
    fixed: dict[str, float],
    group: int,
    about: list[Note],
) -> list[Log]:
    """The logs of all recordings of a file; ``about`` gets those of one row."""
    whole = isinstance(path, RawLog) or path.is_dir()
    name = path.name if whole else Path(path.name).stem
    logs: list[Log] = []
    for recording in found:
        if len(found) > 1 and min(len(t.rows.numbers) for t in recording.tables) < 2:
            text = f"episode {recording.episode} of {name} has one row"
            about.append(Note("W116", f"{text}: it is left out"))
            continue
        called = f"{name}[{recording.episode}]" if recording.episode else name
        logs += _assembled(recording, plan, called, fixed, group)
    return logs


def _assembled(
    recording: Recording, plan: _Plan, name: str, fixed: dict[str, float], group: int
) -> tuple[Log, ...]:
    """One episode: its streams on their own clocks, on one clock, checked and cut."""
    tracks = [_track(table, plan) for table in recording.tables]
    source = recording.tables[0].rows.source
    if recording.tables[0].stream:
        source = source.removesuffix(f" {recording.tables[0].stream}")
    whole, said = join_tracks(tracks, plan.resample, source)
    inputs = dict(whole.inputs)
    for action in plan.actions:
        constant = plan.columns[action.name]
        if not isinstance(constant, Column):
            inputs[action.name] = np.full(len(whole.time), float(constant))
    notes = [note for track in tracks for note in track.notes] + said
    notes += checks.excitation(whole.channels, inputs, source)
    for channel, values in whole.channels.items():
        if f"{channel}.velocity" in whole.channels:
            rate = whole.channels[f"{channel}.velocity"]
            checks.velocity_agrees(whole.time, values, rate, channel, source)
    log = Log(
        name,
        source,
        whole.time,
        {s.name: whole.channels[s.name] for s in plan.states
         if s.name in whole.channels},
        {a.name: inputs[a.name] for a in plan.actions},
        whole.mask,
        fixed,
        group,
        tuple(notes),
    )  # fmt: skip
    return _split_at_gaps(log, whole.cuts, whole.rows)


def _unread_columns(tables: Sequence[LogTable]) -> list[str]:
    """The columns that were not read, but for a format's own.

    A message of a bag has the fields of its type, even if nobody needs them.
    """
    return [
        name
        for table in tables
        if not table.stream
        for name in table.header
        if name and name not in table.columns and name not in BOOKKEEPING
    ]


def _track(table: LogTable, plan: _Plan) -> Track:
    """The table's columns in the system's units, on the table's own clock."""
    table, time, cuts, notes = _usable(table, plan)
    rows = table.rows
    checks.stamps(time, rows)
    known = table.clock is not None or plan.period is not None
    notes += checks.rate(time, cuts, rows.source, in_seconds=known)
    channels, mask, masked = _measured_channels(table, plan)
    inputs, clipped = _commanded_inputs(table, plan)
    said = (*table.notes, *notes, *masked, *clipped)
    return Track(table.stream, rows, time, cuts, channels, mask, inputs, said)


def _usable(table: LogTable, plan: _Plan) -> tuple[LogTable, Values, Mask, list[Note]]:
    """The rows outside the excluded times, their times, where to cut, and notes."""
    source = table.rows.source
    notes = []
    time = _time(table, plan)
    out = np.zeros(len(time), dtype=bool)
    for low, high in plan.exclude:
        if not low < high:
            raise error("excluded_interval", where=source, got=f"[{low:g}, {high:g}]")
        out |= (time >= low) & (time <= high)
    if plan.drop_nonfinite:
        commands = plan.held(plan.actions, table).values()
        needed = [time, *(table.columns[spec.column] for spec in commands)]
        whole = np.logical_and.reduce([np.isfinite(values) for values in needed])
        count = int((~whole & ~out).sum())
        if count:
            text = f"{count} rows of {source} have no time or no command"
            notes.append(Note("W101", f"{text}: the log is cut there"))
        out |= ~whole
    else:
        checks.check_finite_columns(table.columns, table.rows, out)
    keep = np.flatnonzero(~out)
    if plan.keep_first:
        again = np.diff(time[keep], prepend=-np.inf) == 0
        if again.any():
            text = f"{int(again.sum())} rows of {source} repeat the stamp before"
            notes.append(Note("W108", f"{text}: the first of each is kept"))
    else:
        again = np.zeros(len(keep), dtype=bool)
    cuts = np.diff(keep, prepend=keep[:1]) > 1
    keep, cuts = keep[~again], cuts[~again]
    if keep.size < 2:
        raise _too_short(source, int(keep.size))
    return table.kept(keep), time[keep], cuts, notes


def _time(table: LogTable, plan: _Plan) -> Values:
    """Seconds: the format's own stamps, a column, or rows times the stated period."""
    if plan.period is not None:
        return plan.period * np.arange(len(table.rows.numbers))
    if table.clock is not None:
        checks.plain_clock(plan.clock, table.rows.source)
        return table.clock
    raw = table.columns[plan.clock.column]
    return _converted(raw, plan.clock, "s", table.rows.source)


def _or_constant(error: InputError, plan: _Plan) -> InputError:
    """What is missing may be an input's column: a number can replace it."""
    for action in plan.actions:
        spec = plan.columns[action.name]
        column = spec.column if isinstance(spec, Column) else None
        if error.code == "E103" and error.what == f"missing column {column}":
            fix = f"{error.fix}; if it was held at zero, write {action.name} = 0.0"
            kept = ("where", "got", "expected", "key")
            rest = {name: getattr(error, name) for name in kept}
            return InputError(error.code, error.what, fix=fix, **rest)
    return error


def _too_short(source: str, rows: int) -> InputError:
    return error(
        "no_transition",
        where=source,
        got=f"{rows} usable row" + ("" if rows == 1 else "s"),
    )


def _converted(
    raw: Values, spec: Column, unit: str, source: str, angle: bool = False
) -> Values:
    where = f"{source}:column {spec.column}"
    values = raw * unit_factor(spec.unit, unit, where)
    if angle:
        values = np.unwrap(values)
    return spec.sign * spec.scale * values + spec.offset


def _measured_channels(
    table: LogTable, plan: _Plan
) -> tuple[dict[str, Values], dict[str, Mask], list[Note]]:
    """Measured channels in the system's units, their masks, and what to say."""
    channels: dict[str, Values] = {}
    masks: dict[str, Mask] = {}
    notes: list[Note] = []
    source, index = table.rows.source, np.arange(len(table.rows.numbers))
    specs = plan.held(plan.states, table)
    for state in plan.states:
        if state.name not in specs:
            continue
        spec = specs[state.name]
        raw = table.columns[spec.column]
        absent, said = checks.sentinels(raw, spec.column, table.rows)
        mask = np.isfinite(raw) & ~absent
        if not mask.any():
            raise _too_short(f"{source}:column {spec.column}", 0)
        # A value between its neighbours keeps filters finite; the mask excludes it.
        raw = np.interp(index, index[mask], raw[mask])
        notes += said + checks.counter_wraps(raw, spec.column, source)
        values = _converted(raw, spec, state.unit, source, state.angle)
        notes += _wraps(values, raw, spec, state, source)
        if spec.saturation is not None:
            mask &= (raw > spec.saturation[0]) & (raw < spec.saturation[1])
        checks.in_reach(values[mask], state, source)
        low, high = plan.limits.get(state.name, (-np.inf, np.inf))
        mask &= (values > low) & (values < high)
        lost = int((~mask).sum())
        if lost:
            why = "missing, saturated or beyond its limits"
            text = f"{lost} samples of {state.name} in {source} are not used: {why}"
            notes.append(Note("W152", text))
        channels[state.name], masks[state.name] = values, mask
    return channels, masks, notes


def _wraps(
    values: Values, raw: Values, spec: Column, state: ChannelLike, source: str
) -> list[Note]:
    if not state.angle:
        return []
    plain = _converted(raw, spec, state.unit, source)
    turns = np.abs(np.diff(values - plain)) > 1e-6
    if not turns.any():
        return []
    text = f"{state.name} in {source} wraps {int(turns.sum())} times and was unwrapped"
    return [Note("W122", text)]


def _commanded_inputs(
    table: LogTable, plan: _Plan
) -> tuple[dict[str, Values], list[Note]]:
    """What was commanded; a command beyond its saturation reaches the motor clipped."""
    inputs: dict[str, Values] = {}
    notes: list[Note] = []
    source, specs = table.rows.source, plan.held(plan.actions, table)
    for action in plan.actions:
        if action.name not in specs:
            continue
        spec = specs[action.name]
        raw = table.columns[spec.column]
        if spec.saturation is not None:
            low, high = spec.saturation
            count = int(((raw < low) | (raw > high)).sum())
            raw = np.clip(raw, low, high)
            if count:
                text = f"{count} samples of {action.name} in {source} are clipped"
                notes.append(Note("W151", text))
        inputs[action.name] = _converted(raw, spec, action.unit, source)
    return inputs, notes


def _split_at_gaps(log: Log, cuts: Mask, rows: Rows) -> tuple[Log, ...]:
    """Split at gaps (W111) and at removed rows; pieces of one row are left out."""
    steps = np.diff(log.time)
    gaps = np.concatenate([[False], steps > checks.GAP * np.median(steps)])
    notes = list(log.notes)
    for i in np.flatnonzero(gaps & ~cuts):
        place = f"{log.source} before {rows.word} {rows.numbers[i]}"
        text = f"gap of {steps[i - 1]:.3g} s in {place}"
        notes.append(Note("W111", f"{text}: a new episode starts there"))
    edges = [0, *np.flatnonzero(gaps | cuts), len(log)]
    pieces = [slice(int(a), int(b)) for a, b in pairwise(edges) if b - a >= 2]
    if not pieces:
        raise _too_short(log.source, len(log))
    single = len(pieces) == 1
    return tuple(
        replace(
            log,
            name=log.name if single else f"{log.name}[{i}]",
            time=log.time[piece],
            channels={name: v[piece] for name, v in log.channels.items()},
            inputs={name: v[piece] for name, v in log.inputs.items()},
            mask={name: v[piece] for name, v in log.mask.items()},
            notes=tuple(notes) if i == 0 else (),
        )
        for i, piece in enumerate(pieces)
    )
