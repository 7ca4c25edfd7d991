"""Is this recording what it claims to be? Each check raises, or returns notes.

Errors (E1xx) make every fit impossible; notes (W1xx) are facts that the reader of a
result should know. Nothing is repaired silently. Position and velocity of a joint are
compared through displacements: over k rows, ``q_{i+k} - q_i`` against the integral of
dq, whose slope is 1 for a healthy pair, -1 for a flipped sign, 57.3 for degrees.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from sim2gp.data.logs.log import ChannelLike, Column, Log, Note
from sim2gp.data.logs.table import Rows
from sim2gp.errors import error, nearest

Values = Float[np.ndarray, " N"]
Mask = Bool[np.ndarray, " N"]

GAP = 5.0  # periods without a row that end an episode
JITTER = 0.10  # relative spread of the period that is worth stating
DAY = 86400.0
SENTINELS: tuple[float, ...] = (-999.0, -9999.0, 9999.0, -99999.0, 99999.0, 1e30, -1e30)
SENTINELS += (32767.0, -32768.0, 65535.0, 2147483647.0, 4294967295.0)
_FACTORS = {  # slope of displacement on integrated velocity -> what it betrays
    180 / np.pi: "the position is in degrees or the velocity in rad/s of another kind",
    np.pi / 180: "the velocity is in degrees per second",
    1 / (2 * np.pi): "the position is in turns",
    2 * np.pi: "the velocity is in turns per second",
    1e3: "the position is in thousandths (mm for m), or time in thousands of s",
    1e-3: "the velocity is in thousandths, or time is in ms",
    1e-6: "time is in us",
}


def check_finite_columns(columns: Mapping[str, Values], rows: Rows, skip: Mask) -> None:
    """No NaN or infinity in a used column outside the skipped rows (E101)."""
    bad = {name: ~np.isfinite(v) & ~skip for name, v in columns.items()}
    count = sum(int(b.sum()) for b in bad.values())
    if count == 0:
        return
    numbers = rows.numbers[np.logical_or.reduce(list(bad.values()))]
    name = next(name for name, b in bad.items() if b.any())
    first = int(np.flatnonzero(bad[name])[0])
    value = columns[name][first]
    some = ", ".join(str(r) for r in numbers[:5])
    some += ", ..." if len(numbers) > 5 else ""
    raise error(
        "value_not_finite",
        where=f"{rows.at(first)}, column {name}",
        got=f"{value:g} ({count} such on {len(numbers)} {rows.word}s: {some})",
    )


def stamps(time: Values, rows: Rows) -> None:
    """Time goes forward at every row (E108, E109, E112)."""
    steps = np.diff(time)
    forward = steps[steps > 0]
    period = float(np.median(forward)) if forward.size else 0.0
    bad = np.flatnonzero(steps <= 0)
    jumps = np.flatnonzero(steps > DAY)
    if bad.size == 0 and jumps.size == 0:
        return
    i = int(bad[0]) if bad.size else int(jumps[0])
    where = rows.at(i + 1)
    got = f"{time[i + 1]:.9g} s after {time[i]:.9g} s"
    lost = float(np.spacing(np.float32(np.max(np.abs(time)))))
    single = bool(np.all(time.astype(np.float32).astype(np.float64) == time))
    if bad.size and np.max(np.abs(time)) > 1e5 and single and lost > 0.5 * period:
        raise error(
            "stamps_lost_resolution",
            where=where,
            got=f"{got}, resolved to {lost:.3g} s",
        )
    stays = i + 2 < len(time) and time[i + 2] <= time[i]
    back = 0 < GAP * period < -steps[i] and stays
    if not bad.size or back:
        raise error("clock_jump", where=where, got=f"{got}, a jump of {steps[i]:.9g} s")
    got = f"{got} ({bad.size} such rows)"
    if steps[i] == 0:
        raise error("duplicate_time_stamp", where=where, got=got)
    raise error("time_does_not_increase", where=where, got=got)


def plain_clock(column: Column, source: str) -> None:
    """A recording with stamps of its own needs no unit or sign of them (E160)."""
    if column in (Column(column.column), Column(column.column, "s")):
        return
    raise error(
        "unit_of_own_clock",
        where=source,
        got=f"time as a column, {column.column}, with its unit",
    )


def rate(time: Values, cuts: Mask, source: str, *, in_seconds: bool) -> list[Note]:
    """A period that is no control period is a unit (E107); jitter is stated (W110).

    ``in_seconds`` says that the format itself gives the unit.
    """
    steps = np.diff(time)
    period = float(np.median(steps))
    if period >= 0.5 and not in_seconds:
        raise error(
            "time_in_another_unit",
            where=source,
            got=f"a median period of {period:g} s",
            unit=_guess(period),
        )
    steady = steps[(steps <= GAP * period) & ~cuts[1:]]
    spread = float(np.max(np.abs(steady - period), initial=0.0)) / period
    if spread <= JITTER:
        return []
    low, high = float(np.min(steady)), float(np.max(steady))
    text = (
        f"period varies in {source}: {1e3 * low:.3g}, {1e3 * period:.3g}, "
        f"{1e3 * high:.3g} ms (minimum, median, maximum); the stamps are used as they "
        f"are (resample = {{period = {period:.2g}}} would even them out)"
    )
    return [Note("W110", text)]


def _guess(period: float) -> str:
    return "ms" if period < 500 else "us" if period < 5e5 else "ns"


def period_matches(log: Log, dt: float) -> None:
    """For likelihoods of one fixed period only: the log has that period (E113)."""
    if abs(log.period - dt) > 1e-3 * dt:
        raise error(
            "period_differs_from_step",
            where=log.source,
            got=f"{log.period:g} s",
            dt=f"{dt:g}",
        )


def sentinels(values: Values, name: str, rows: Rows) -> tuple[Mask, list[Note]]:
    """Samples that mean "no value" (-9999, 65535, ...): masked, above 1 % an error."""
    bad = np.zeros(len(values), dtype=bool)
    for mark in SENTINELS:
        here = values == mark
        if here.sum() < 2:
            continue
        others = np.abs(values[~here])
        if not others.size or abs(mark) > 10 * np.max(others, initial=1e-9):
            bad |= here
    if not bad.any():
        return bad, []
    first = int(np.flatnonzero(bad)[0])
    share = float(np.mean(bad))
    where = f"{rows.at(first)}, column {name}"
    if share > 0.01:
        raise error(
            "sentinel_in_column",
            where=where,
            got=f"{values[first]:g} in {100 * share:.1f} % of the rows",
        )
    masked = f"{bad.sum()} samples ({100 * share:.2g} %) masked"
    text = f"{values[first]:g} means no value at {where}: {masked}"
    return bad, [Note("W102", text)]


def counter_wraps(values: Values, name: str, source: str) -> list[Note]:
    """Integer counts that jump by a power of two: an encoder that overflowed (W122)."""
    if len(values) < 3 or not np.all(values == np.round(values)):
        return []
    jumps = np.abs(np.diff(values))
    for bits in (8, 10, 12, 14, 16, 24, 32):
        hit = np.abs(jumps - 2.0**bits) < 0.02 * 2.0**bits
        if hit.any() and np.median(jumps) < 0.02 * 2.0**bits:
            text = f"column {name} of {source} jumps by 2^{bits} {int(hit.sum())} times"
            return [Note("W122", f"{text}: an encoder that overflows?")]
    return []


def in_reach(values: Values, channel: ChannelLike, source: str) -> None:
    """A joint with limits does not travel ten times their distance (E107).

    The distance counts and not the place: a measured angle may be any of its turns.
    """
    allowed = channel.high - channel.low
    if not np.isfinite(allowed) or len(values) == 0:
        return
    travel = float(np.ptp(values))
    if travel > 10 * allowed:
        raise error(
            "travel_beyond_limits",
            where=source,
            got=f"a travel of {travel:g} {channel.unit}",
            name=channel.name,
            allowed=f"{allowed:g}",
            unit=channel.unit,
            perhaps={"m": ', perhaps "mm"', "rad": ', perhaps "deg"'}.get(
                channel.unit, ""
            ),
        )


def follows(time: Values, q: Values, dq: Values) -> tuple[float, float] | None:
    """Slope and correlation of displacements on integrated velocities, or None."""
    k = max(3, round(0.1 / float(np.median(np.diff(time)))))
    k = min(k, len(time) // 10)
    if k < 3:
        return None
    area = np.concatenate([[0.0], np.cumsum(0.5 * (dq[1:] + dq[:-1]) * np.diff(time))])
    dQ, dA = q[k::k] - q[:-k:k], area[k::k] - area[:-k:k]
    moves = np.abs(np.diff(q))
    quantum = np.min(moves[moves > 0], initial=np.inf)
    if not np.sqrt(np.mean(dQ**2)) > 20 * quantum:
        return None  # hardly moves: quantisation would decide
    power = float(np.sum(dA**2) * np.sum(dQ**2))
    if power == 0.0:
        return 0.0, 0.0
    return float(np.sum(dQ * dA) / np.sum(dA**2)), float(np.sum(dQ * dA) / power**0.5)


def velocity_agrees(
    time: Values, q: Values, dq: Values, name: str, source: str
) -> None:
    """The velocity column is the rate of the position column (E106, E107)."""
    found = follows(time, q, dq)
    if found is None:
        return
    slope, correlation = found
    if (correlation > 0.8 and 2 / 3 < slope < 1.5) or 0.5 < correlation <= 0.8:
        return
    got = f"slope {slope:.3g}, correlation {correlation:.2f}"
    where = f"{source}: {name} and {name}.velocity"
    swapped = follows(time, dq, q)
    if swapped and swapped[1] > 0.9 and 2 / 3 < swapped[0] < 1.5:
        raise error("columns_swapped", where=where, got=got, name=name)
    if correlation > 0.8:
        for ratio, meaning in _FACTORS.items():
            if abs(slope / ratio - 1) < 0.15:
                raise error(
                    "velocity_in_wrong_unit",
                    where=where,
                    got=got,
                    name=name,
                    meaning=meaning,
                )
    fix = "set sign = -1 on one of them" if correlation < -0.8 else "check the columns"
    raise error(
        "position_and_velocity_disagree", where=where, got=got, name=name, fix=fix
    )


def excitation(
    channels: Mapping[str, Values], inputs: Mapping[str, Values], source: str
) -> list[Note]:
    """Columns that never change teach nothing (W117)."""
    notes = []
    still = [name for name, v in channels.items() if np.ptp(v) == 0]
    if still and len(still) == len(channels):
        text = f"nothing moves in {source}: its parameters keep their prior"
        return [Note("W117", text)]
    flat = [name for name, v in inputs.items() if np.ptp(v) == 0]
    for names, word in ((still, "channel"), (flat, "input")):
        if names:
            listed = ", ".join(names)
            notes.append(Note("W117", f"constant {word} {listed} in {source}"))
    return notes


def unused_columns(names: Sequence[str], source: str) -> list[Note]:
    """Columns of a file that nothing takes: perhaps one was forgotten (W105)."""
    if not names:
        return []
    text = ", ".join(names)
    text = text if len(text) <= 200 else f"{text[:197].rsplit(', ', 1)[0]}, ..."
    return [Note("W105", f"columns of {source} that nothing takes: {text}")]


def check_all_used(logs: Sequence[Log]) -> None:
    """A strict reader needs every column (E105)."""
    for log in logs:
        for note in log.notes:
            if note.code == "W105":
                raise error(
                    "columns_nothing_takes",
                    where=log.source,
                    got=note.text.split(": ", 1)[1],
                )


def shared_rows(train: Sequence[Log], test: Sequence[Log]) -> list[Note]:
    """Rows that are in both sets: a test on them proves nothing (W128).

    Rows at rest, alike in every log that begins with them, do not count.
    """

    def rows_of(log: Log) -> set[bytes]:
        parts = [log.time, *log.channels.values(), *log.inputs.values()]
        rows = np.stack(parts, axis=1)
        moved = np.any(np.diff(rows[:, 1:], axis=0) != 0.0, axis=1)
        return {row.tobytes() for row in rows[np.concatenate([moved[:1], moved])]}

    known = set().union(*(rows_of(log) for log in train)) if train else set()
    notes = []
    for log in test:
        count = len(rows_of(log) & known)
        if count:
            text = f"{count} rows of {log.source} were also fitted to"
            notes.append(Note("W128", text))
    return notes


def check_column_names(
    columns: Mapping[str, object],
    states: Sequence[ChannelLike],
    actions: Sequence[ChannelLike],
    where: str,
) -> None:
    """E160 for a channel of another system, an input without column, no state."""
    measurable = [c.name for c in states]
    commands = [c.name for c in actions]
    for name in columns:
        if name not in (*measurable, *commands):
            close = nearest(name, [*measurable, *commands])
            raise error(
                "unknown_channel",
                where=f"columns for {where}",
                got=name,
                name=name,
                known=", ".join([*measurable, *commands]),
                fix=f"did you mean {close}" if close else "use a name of the system",
            )
    for name in commands:
        if name not in columns:
            raise error(
                "no_column_for_input",
                where=f"columns for {where}",
                got=", ".join(columns) or "no columns",
                name=name,
            )
    if not any(name in columns for name in measurable):
        raise error(
            "nothing_measured",
            where=f"columns for {where}",
            got=", ".join(columns),
            measurable=", ".join(measurable),
        )
