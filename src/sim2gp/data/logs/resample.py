"""Streams with clocks of their own become one log: inputs held, states between stamps.

Each stream is a `Track`: converted, unwrapped and masked on its own stamps first, for
an angle must not be interpolated across its wrap. A state is taken at a time t between
the samples at t_i <= t < t_{i+1} as ``x_i + (t - t_i) / (t_{i+1} - t_i) (x_{i+1} -
x_i)`` and counts if both count; an input keeps its last value. Nothing is taken across
a gap: the log is cut there. Where rows are denser than samples, a sample counts at the
row next to it alone: interpolated values are not further measurements.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.data.logs.checks import GAP
from sim2gp.data.logs.log import Note
from sim2gp.data.logs.table import Rows
from sim2gp.errors import InputError, error, nearest

Values = Float[np.ndarray, " N"]
Mask = Bool[np.ndarray, " N"]
LOST = 0.05  # share of samples that is worth stating
ALIKE = 1.1  # ratio of periods of streams that count as equally fast


@dataclass(frozen=True)
class Resample:
    """How several clocks become one: ``method`` "linear" or "hold" for states.

    At a ``period`` in s, or at the ``stamps`` of a named stream; with neither, at the
    stamps of the slowest stream that measures, so that none is interpolated densely.
    """

    method: Literal["linear", "hold"] = "linear"
    period: float | None = None
    stamps: str | None = None


@dataclass(frozen=True)
class Track:
    """What was measured and commanded on one clock, in the system's units.

    ``cuts`` is True where nothing may connect a row to the one before.
    """

    stream: str
    rows: Rows
    time: Values
    cuts: Mask
    channels: dict[str, Values]
    mask: dict[str, Mask]
    inputs: dict[str, Values]
    notes: tuple[Note, ...]

    @property
    def period(self) -> float:
        """The median time between rows, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def segment(self) -> Int[np.ndarray, " N"]:
        """The number of the uninterrupted stretch that each row belongs to."""
        gaps = np.diff(self.time, prepend=self.time[0]) > GAP * self.period
        return np.cumsum(self.cuts | gaps)


def join_tracks(
    tracks: Sequence[Track], resample: Resample | None, source: str
) -> tuple[Track, list[Note]]:
    """One track of all, and what was done to get it (E103, E116)."""
    if len(tracks) == 1:
        if resample is None:
            return tracks[0], []
        if resample.period is None and resample.stamps is None:
            raise error(
                "nothing_to_resample",
                where=source,
                got="one stream, and neither period nor stamps",
            )
    rule = resample or Resample()
    at, cuts, place = _row_times(tracks, rule, source)
    channels: dict[str, Values] = {}
    mask: dict[str, Mask] = {}
    inputs: dict[str, Values] = {}
    notes: list[Note] = []
    valid = np.ones(len(at), dtype=bool)
    lost: list[str] = []
    counted: dict[str, Mask] = {}
    between = rule.method == "linear"
    for track in tracks:
        if track.time is at:
            channels |= track.channels
            mask |= track.mask
            inputs |= track.inputs
            continue
        notes += _gaps(track)
        before = _before(track, at)
        once = _once(track.time, at, before, between)
        piece = track.segment[np.maximum(before.row, 0)]
        cuts = cuts | np.concatenate([[False], np.diff(piece) != 0])
        if track.channels:
            valid &= before.inside if between else before.held
        if track.inputs:
            valid &= before.held
        for name, values in track.channels.items():
            channels[name], mask[name] = _resampled_state(
                values, track.mask[name], before, between
            )
            mask[name] &= once
            counted[name] = once
        for name, values in track.inputs.items():
            inputs[name] = values[np.maximum(before.row, 0)]
            skipped = 1 - len(np.unique(before.row)) / max(_during(track, at), 1)
            if skipped > LOST:
                lost.append(f"{100 * skipped:.0f} % of the samples of {name}")
    if valid.sum() < 2:
        raise _no_overlap(tracks, source)
    spread = [name for name, once in counted.items() if (~once[valid]).mean() > LOST]
    notes.append(_resample_note(rule, place, lost, spread, source))
    rows = Rows(source, np.arange(len(at)), "row")
    whole = Track("", rows, at, cuts, channels, mask, inputs, ())
    return _only(whole, valid), notes


@dataclass(frozen=True)
class _Before:
    """For each wanted time: the row at or before it, how far towards the next."""

    row: Int[np.ndarray, " M"]
    share: Float[np.ndarray, " M"]
    inside: Bool[np.ndarray, " M"]  # on a sample, or between two of one stretch
    held: Bool[np.ndarray, " M"]  # or not longer after the last than its period


def _before(track: Track, at: Values) -> _Before:
    time, segment = track.time, track.segment
    row = np.searchsorted(time, at, side="right") - 1
    i = np.maximum(row, 0)
    j = np.minimum(i + 1, len(time) - 1)
    on = (row >= 0) & (at == time[i])
    linked = (row >= 0) & (j > i) & (segment[i] == segment[j])
    span = np.where(j > i, time[j] - time[i], 1.0)
    share = np.where(linked & ~on, (at - time[i]) / span, 0.0)
    held = on | linked | ((row >= 0) & (at - time[i] <= track.period))
    return _Before(row, share, on | linked, held)


def _once(
    time: Values, at: Float[np.ndarray, " M"], before: _Before, between: bool
) -> Bool[np.ndarray, " M"]:
    """The row next to each sample, where several have it as their nearest (or last)."""
    near = np.maximum(before.row, 0)
    if between:
        near = np.minimum(near + (before.share >= 0.5), len(time) - 1)
    away = np.where(before.inside, np.abs(at - time[near]), np.inf)
    order = np.lexsort((away, near))
    first = np.flatnonzero(np.diff(near[order], prepend=-1))
    once = np.zeros(len(at), dtype=bool)
    once[order[first]] = True
    return once


def _resampled_state(
    values: Values, mask: Mask, before: _Before, between: bool
) -> tuple[Float[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """A state at the wanted times, and whether all that it is made of counts."""
    i = np.maximum(before.row, 0)
    j = np.minimum(i + 1, len(values) - 1)
    if not between:
        return values[i], mask[i]
    some = before.share > 0
    taken = values[i] + before.share * (values[j] - values[i])
    return taken, mask[i] & (mask[j] | ~some)


def _row_times(
    tracks: Sequence[Track], rule: Resample, source: str
) -> tuple[Values, Mask, str]:
    """The times of the rows, cuts among them, and what they are called."""
    if rule.period is not None:
        start = max(track.time[0] for track in tracks)
        end = min(track.time[-1] for track in tracks)
        if not end > start:
            raise _no_overlap(tracks, source)
        count = int(np.floor((end - start) / rule.period + 1e-9)) + 1
        at = start + rule.period * np.arange(count)
        return at, np.zeros(count, dtype=bool), f"every {rule.period:g} s"
    if rule.stamps is None:
        measuring = [track for track in tracks if track.channels]
        slowest = max(track.period for track in measuring)
        among = [t for t in measuring if t.period * ALIKE > slowest]
        chosen = max(among, key=lambda track: len(track.channels))
    else:
        named = {track.stream: track for track in tracks}
        if rule.stamps not in named:
            close = nearest(rule.stamps, named)
            raise error(
                "no_stream",
                where=source,
                got=", ".join(named) or "one clock",
                name=rule.stamps,
                fix=f"did you mean {close}" if close else "state a period instead",
            )
        chosen = named[rule.stamps]
    return chosen.time, chosen.cuts, f"at the stamps of {chosen.stream or source}"


def _during(track: Track, at: Values) -> int:
    return int(((track.time >= at[0]) & (track.time <= at[-1])).sum())


def _gaps(track: Track) -> list[Note]:
    steps = np.diff(track.time)
    wide = np.flatnonzero((steps > GAP * track.period) & ~track.cuts[1:])
    rows, notes = track.rows, []
    for i in wide:
        text = f"gap of {steps[i]:.3g} s before {rows.at(int(i) + 1)}"
        notes.append(Note("W111", f"{text}: a new episode starts there"))
    return notes


def _resample_note(
    rule: Resample,
    place: str,
    lost: Sequence[str],
    spread: Sequence[str],
    source: str,
) -> Note:
    how = "linear between their samples" if rule.method == "linear" else "held"
    text = f"{source} is resampled {place}: states {how}, inputs held"
    if lost:
        text += "; " + ", ".join(lost) + " fall between two rows and are not used"
    if spread:
        text += "; samples of " + ", ".join(spread) + " are fewer than the rows: each"
        text += " counts once"
    return Note("W153", text)


def _only(track: Track, valid: Mask) -> Track:
    """The rows at which everything is known; others are cut out."""
    keep = np.flatnonzero(valid)
    number = np.cumsum(track.cuts)[keep]
    skipped = np.diff(keep) > 1
    cuts = np.concatenate([[False], skipped | (np.diff(number) != 0)])
    return replace(
        track,
        rows=track.rows.kept(keep),
        time=track.time[keep],
        cuts=cuts,
        channels={name: v[keep] for name, v in track.channels.items()},
        mask={name: v[keep] for name, v in track.mask.items()},
        inputs={name: v[keep] for name, v in track.inputs.items()},
    )


def _no_overlap(tracks: Sequence[Track], source: str) -> InputError:
    spans = [f"{t.stream or 'rows'} {t.time[0]:.6g} to {t.time[-1]:.6g} s"
             for t in tracks]  # fmt: skip
    return error("streams_do_not_overlap", where=source, got="; ".join(spans))
