"""A CSV file of a robot becomes logs: columns named, converted, unwrapped, masked, cut.

The order matters: drop excluded rows, convert the unit, unwrap angles (a turn is 2 pi
before any sign or scale), apply sign, scale and offset, mask, then cut the recording
where time has a gap or rows were excluded. Excluded rows are cut out and not only
masked, because whatever disturbed the machine there also moved it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.errors import InputError, nearest
from sim2gp.logs import checks
from sim2gp.logs.log import ChannelLike, Column, Log, Note
from sim2gp.logs.table import Table, read_table, shown
from sim2gp.logs.units import factor

Values = Float[np.ndarray, " N"]
Mask = Bool[np.ndarray, " N"]


def read_csv(
    path: Path | str,
    columns: Mapping[str, Column | float],
    *,
    states: Sequence[ChannelLike],
    actions: Sequence[ChannelLike],
    time: Column | str = "time",
    exclude: Sequence[tuple[float, float]] = (),
    drop_nonfinite: bool = False,
    limits: Mapping[str, tuple[float, float]] | None = None,
    fixed: Mapping[str, float] | None = None,
    group: int = 0,
) -> tuple[Log, ...]:
    """Read one file into logs without gaps; a number for an input holds it constant.

    ``exclude`` lists intervals of the file's time in s; a log is cut around them.
    ``limits`` are end stops of states, in their units: samples there are masked.
    Raises `InputError` with the codes of bad tables (E101 to E131).
    """
    path = Path(path)
    clock = Column(time, "s") if isinstance(time, str) else time
    _check_names(columns, states, actions, shown(path))
    specs = {name: spec for name, spec in columns.items() if isinstance(spec, Column)}
    wanted = dict.fromkeys([clock.column, *(spec.column for spec in specs.values())])
    table = read_table(path, list(wanted), clock.column)
    table, cuts, notes = _usable(table, clock, specs, actions, exclude, drop_nonfinite)
    stamps = _converted(table.columns[clock.column], clock, "s", table.source)
    checks.stamps(stamps, table.lines, table.source)
    notes += checks.rate(stamps, cuts, table.source)
    channels, mask, more = _channels(table, specs, states, limits or {})
    inputs, clipped = _inputs(table, columns, actions, len(stamps))
    notes += more + clipped + checks.excitation(channels, inputs, table.source)
    for name, values in channels.items():
        if f"{name}.velocity" in channels:
            rate = channels[f"{name}.velocity"]
            checks.velocity_agrees(stamps, values, rate, name, table.source)
    whole = Log(
        path.stem,
        table.source,
        stamps,
        channels,
        inputs,
        mask,
        dict(fixed or {}),
        group,
        tuple(notes),
    )
    return _cut(whole, cuts, table.lines)


def _check_names(
    columns: Mapping[str, object],
    states: Sequence[ChannelLike],
    actions: Sequence[ChannelLike],
    where: str,
) -> None:
    measurable = [c.name for c in states]
    commands = [c.name for c in actions]
    for name in columns:
        if name not in (*measurable, *commands):
            close = nearest(name, [*measurable, *commands])
            raise InputError(
                "E160",
                f"unknown channel {name}",
                where=f"columns for {where}",
                got=name,
                expected="one of " + ", ".join([*measurable, *commands]),
                fix=f"did you mean {close}" if close else "use a name of the system",
            )
    for name in commands:
        if name not in columns:
            raise InputError(
                "E160",
                f"no column for input {name}",
                where=f"columns for {where}",
                got=", ".join(columns) or "no columns",
                expected=f"{name} = a column, or a constant number",
                fix=f"add {name} to the columns",
            )
    if not any(name in columns for name in measurable):
        raise InputError(
            "E160",
            "nothing measured",
            where=f"columns for {where}",
            got=", ".join(columns),
            expected="at least one of " + ", ".join(measurable),
            fix="add a measured channel to the columns",
        )


def _usable(
    table: Table,
    clock: Column,
    specs: Mapping[str, Column],
    actions: Sequence[ChannelLike],
    exclude: Sequence[tuple[float, float]],
    drop: bool,
) -> tuple[Table, Mask, list[Note]]:
    """The rows outside the excluded times, before which of them to cut, and notes."""
    notes = []
    time = _converted(table.columns[clock.column], clock, "s", table.source)
    out = np.zeros(len(time), dtype=bool)
    for low, high in exclude:
        if not low < high:
            raise InputError(
                "E141",
                "excluded interval",
                where=table.source,
                got=f"[{low:g}, {high:g}]",
                expected="[start, end] in s with start < end",
                fix="swap the two",
            )
        out |= (time >= low) & (time <= high)
    if drop:
        commands = {specs[a.name].column for a in actions if a.name in specs}
        needed = [clock.column, *commands]
        whole = np.logical_and.reduce([np.isfinite(table.columns[c]) for c in needed])
        count = int((~whole & ~out).sum())
        if count:
            text = f"{count} rows of {table.source} have no time or no command"
            notes.append(Note("W101", f"{text}: the log is cut there"))
        out |= ~whole
    else:
        checks.finite(table.columns, table.lines, table.source, out)
    keep = np.flatnonzero(~out)
    if keep.size < 2:
        raise _too_short(table.source, int(keep.size))
    cuts = np.concatenate([[False], np.diff(keep) > 1])
    kept = {name: values[keep] for name, values in table.columns.items()}
    return replace(table, columns=kept, lines=table.lines[keep]), cuts, notes


def _too_short(source: str, rows: int) -> InputError:
    return InputError(
        "E116",
        "no transition",
        where=source,
        got=f"{rows} usable row" + ("" if rows == 1 else "s"),
        expected="at least 2 per episode",
        fix="record longer, or exclude less",
    )


def _converted(
    raw: Values, spec: Column, unit: str, source: str, angle: bool = False
) -> Values:
    where = f"{source}:column {spec.column}"
    values = raw * factor(spec.unit, unit, where)
    if angle:
        values = np.unwrap(values)
    return spec.sign * spec.scale * values + spec.offset


def _channels(
    table: Table,
    specs: Mapping[str, Column],
    states: Sequence[ChannelLike],
    limits: Mapping[str, tuple[float, float]],
) -> tuple[dict[str, Values], dict[str, Mask], list[Note]]:
    """Measured channels in the system's units, their masks, and what to say."""
    channels: dict[str, Values] = {}
    masks: dict[str, Mask] = {}
    notes: list[Note] = []
    rows = np.arange(len(table.lines))
    for state in states:
        if state.name not in specs:
            continue
        spec = specs[state.name]
        raw, source = table.columns[spec.column], table.source
        absent, said = checks.sentinels(raw, spec.column, table.lines, source)
        mask = np.isfinite(raw) & ~absent
        if not mask.any():
            raise _too_short(f"{source}:column {spec.column}", 0)
        # A stand-in between neighbours keeps filters sane; the mask keeps it out.
        raw = np.interp(rows, rows[mask], raw[mask])
        notes += said + checks.counter_wraps(raw, spec.column, source)
        values = _converted(raw, spec, state.unit, source, state.angle)
        notes += _wraps(values, raw, spec, state, source)
        if spec.saturation is not None:
            mask &= (raw > spec.saturation[0]) & (raw < spec.saturation[1])
        checks.in_reach(values[mask], state, source)
        low, high = limits.get(state.name, (-np.inf, np.inf))
        mask &= (values > low) & (values < high)
        lost = int((~mask).sum())
        if lost:
            text = f"{lost} samples of {state.name} in {source} are masked"
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


def _inputs(
    table: Table,
    columns: Mapping[str, Column | float],
    actions: Sequence[ChannelLike],
    rows: int,
) -> tuple[dict[str, Values], list[Note]]:
    """What was commanded; a command beyond its saturation reaches the motor clipped."""
    inputs: dict[str, Values] = {}
    notes: list[Note] = []
    for action in actions:
        spec = columns[action.name]
        if not isinstance(spec, Column):
            inputs[action.name] = np.full(rows, float(spec))
            continue
        raw = table.columns[spec.column]
        if spec.saturation is not None:
            low, high = spec.saturation
            count = int(((raw < low) | (raw > high)).sum())
            raw = np.clip(raw, low, high)
            if count:
                text = f"{count} samples of {action.name} in {table.source} are clipped"
                notes.append(Note("W151", text))
        inputs[action.name] = _converted(raw, spec, action.unit, table.source)
    return inputs, notes


def _cut(log: Log, cuts: Mask, lines: Int[np.ndarray, " N"]) -> tuple[Log, ...]:
    """Split at gaps (W111) and at removed rows; pieces of one row are left out."""
    steps = np.diff(log.time)
    gaps = np.concatenate([[False], steps > checks.GAP * np.median(steps)])
    notes = list(log.notes)
    for i in np.flatnonzero(gaps & ~cuts):
        text = f"gap of {steps[i - 1]:.3g} s in {log.source} before line {lines[i]}"
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
