"""Where logs are cut into windows; the windows themselves are made when asked for.

Of millions of rows all windows at once do not fit into memory: with their padding, the
steps of their simulation and their inputs they are several times the logs. `Cuts` are
what a fit in parts needs of them: some, all as large, one part after the other.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows, parts_of
from sim2gp.systems.base import DELAY_BLUR, AbstractSystem, steps_in


class Cuttable(NamedTuple):
    """A log as windows need it.

    values, valid: the measured channels, and which samples count.
    place, lengths: each row's place among the integration steps' ends; their lengths.
    knots: of the held inputs (`knots_of`).
    """

    values: Float[np.ndarray, "N c"]
    valid: Bool[np.ndarray, "N c"]
    place: Int[np.ndarray, " N"]
    lengths: Float[np.ndarray, " S"]
    knots: tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K m"]]


@dataclass(frozen=True)
class Cuts:
    """Rows ``i .. j - 1`` of log ``k`` are a window, for each piece (k, i, j).

    ``start``, ``start_sd`` and ``floor`` are those of `Windows`, ``measured`` names the
    channels. Nothing is measured in windows that are not ``used``, nor before a
    window's row ``first``.
    """

    system: AbstractSystem
    logs: Sequence[Log]
    pieces: Int[np.ndarray, "W 3"]
    measured: Sequence[str]
    start: Float[np.ndarray, "W n"]
    start_sd: Float[np.ndarray, "W n"]
    floor: Float[np.ndarray, " c"]
    used: Bool[np.ndarray, " W"]
    first: int = 0
    _last: dict[int, Cuttable] = field(default_factory=dict, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.pieces)

    @property
    def outputs(self) -> tuple[int, ...]:
        """Places of the measured channels among the states."""
        names = [channel.name for channel in self.system.physical_states]
        return tuple(names.index(name) for name in self.measured)

    @property
    def length(self) -> int:
        """Rows of each window."""
        return self._sizes[0]

    @property
    def most(self) -> int:
        """Rows of the log in the window that has most."""
        return int(np.max(self.pieces[:, 2] - self.pieces[:, 1]))

    @property
    def counts(self) -> Float[np.ndarray, "W c"]:
        """Samples of each window and channel."""
        return self._sizes[2] * self.used[:, None]

    @property
    def seconds(self) -> Float[np.ndarray, " W"]:
        """How long each lasts."""
        time = [log.time for log in self.logs]
        return np.asarray([time[k][j - 1] - time[k][i] for k, i, j in self.pieces])

    @property
    def places(self) -> Int[np.ndarray, "W 2"]:
        """Log and first row of each window."""
        return self.pieces[:, :2]

    def whole(self) -> Windows:
        """All windows at once."""
        return self.some(np.arange(len(self)))

    def masked(self, used: Bool[np.ndarray, " W"]) -> "Cuts":
        """The same, where nothing is measured in the others."""
        return replace(self, used=self.used & used)

    def in_parts(self, size: int) -> Iterator[tuple[Int[np.ndarray, " w"], Windows]]:
        """So many windows at a time, and their numbers (`parts_of`)."""
        yield from parts_of(self.some, len(self), size)

    def some(self, which: Bool[np.ndarray, " W"] | Int[np.ndarray, " w"]) -> Windows:
        """The windows chosen by a mask or by number."""
        which = np.arange(len(self))[which]
        (L, H, _), c = self._sizes, len(self.measured)
        W, m = len(which), len(self.system.actions)
        span, knots, area = np.zeros((W, L)), np.zeros((W, H)), np.zeros((W, H, m))
        y, mask = np.zeros((W, L, c)), np.zeros((W, L, c), bool)
        for w, k, i, j in _log_by_log(self.pieces[which]):
            log = self._of(k)
            at = log.place[i:j] - log.place[i]
            y[w, at], mask[w, at] = log.values[i:j], log.valid[i:j]
            span[w, 1 : at[-1] + 1] = log.lengths[log.place[i] : log.place[j - 1]]
            time = self.logs[k].time
            since, ends = time[i], self._knots(log, time[i], time[j - 1] - time[i])
            knots[w], area[w] = padded_knots(log.knots, ends, since, H)
        mask &= self.used[which, None, None]
        mask[:, : self.first] = False
        x0, sd, floor = self.start[which], self.start_sd[which], self.floor
        groups = [self.logs[k].group for k in self.pieces[which, 0]]
        group = np.asarray(groups, np.int32)
        outputs = self.outputs
        return Windows(span, knots, area, y, mask, x0, sd, floor, group, outputs)

    @cached_property
    def _sizes(self) -> tuple[int, int, Float[np.ndarray, "W c"]]:
        """Rows and knots of each window, and the samples of its channels."""
        rows, knots, counts = 1, 1, np.zeros((len(self), len(self.measured)))
        for w, k, i, j in _log_by_log(self.pieces):
            log, time = self._of(k), self.logs[k].time
            first, last = self._knots(log, time[i], time[j - 1] - time[i])
            rows = max(rows, int(log.place[j - 1] - log.place[i]) + 1)
            knots = max(knots, last - first)
            counts[w] = log.valid[i + self.first : j].sum(axis=0)
        return rows, knots, counts

    def _knots(self, log: Cuttable, since: float, length: float) -> tuple[int, int]:
        return knot_range(log.knots[0], since, length, self.system.longest_delay)

    def _of(self, k: int) -> Cuttable:
        """Of the log that was asked for last it is kept: windows come in order."""
        if k not in self._last:
            log, actions = self.logs[k], [c.name for c in self.system.actions]
            values, valid = log.measured(self.measured)
            steps = integration_steps(log.time, self.system.window_substep)
            knots = knots_of(log, actions, self.system.longest_delay)
            self._last.clear()
            self._last[k] = Cuttable(values, valid, *steps, knots)
        return self._last[k]


def _log_by_log(
    pieces: Int[np.ndarray, "W 3"],
) -> Iterator[tuple[int, int, int, int]]:
    """Number, log, first and last row of each, those of a log together."""
    for w in np.argsort(pieces[:, 0], kind="stable").tolist():
        k, i, j = pieces[w].tolist()
        yield w, k, i, j


def integration_steps(
    time: Float[np.ndarray, " N"], longest: float
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, " S"]]:
    """Integration steps of at most ``longest`` seconds that meet every stamp.

    Returns each stamp's place among the steps' ends, and the steps' lengths.
    """
    gaps = np.round(np.diff(time), 9)  # those that are equal differ by rounding
    count = steps_in(gaps, longest)
    place = np.concatenate([[0], np.cumsum(count)])
    return place, np.repeat(gaps / count, count)


def inputs_since(
    logs: Sequence[Log],
    actions: Sequence[str],
    spans: Sequence[tuple[int, float, float]],
    delay: float,
) -> tuple[Float[np.ndarray, "W H"], Float[np.ndarray, "W H m"]]:
    """Padded knots and integrals of the inputs for each (log, since, length) in s.

    They reach ``delay`` seconds (and a blur's width) back; knots count from ``since``.
    Spans come log by log.
    """
    held = lru_cache(maxsize=1)(lambda k: knots_of(logs[k], actions, delay))
    ends = [knot_range(held(k)[0], since, s, delay) for k, since, s in spans]
    H = max(last - first for first, last in ends)
    rows = [
        padded_knots(held(k), own, since, H)
        for (k, since, _), own in zip(spans, ends, strict=True)
    ]
    knots, area = (np.stack(x) for x in zip(*rows, strict=True))
    return knots, area


def knot_range(
    time: Float[np.ndarray, " K"], since: float, length: float, delay: float
) -> tuple[int, int]:
    """First and last (not included) of the knots that a stretch of inputs needs."""
    back = delay + DELAY_BLUR
    first = int(np.searchsorted(time, since - back, side="right")) - 1
    last = int(np.searchsorted(time, since + length + DELAY_BLUR)) + 1
    return max(first, 0), min(last, len(time))


def padded_knots(
    held: tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K m"]],
    ends: tuple[int, int],
    since: float,
    count: int,
) -> tuple[Float[np.ndarray, " H"], Float[np.ndarray, "H m"]]:
    """``count`` knots of which those between the ``ends`` are the inputs' own."""
    (time, integral), (a, b), knots = held, ends, np.zeros(count)
    knots[: b - a] = time[a:b] - since
    knots[b - a :] = knots[b - a - 1] + np.arange(1.0, count - (b - a) + 1)
    area = integral[np.minimum(np.arange(a, a + count), b - 1)] - integral[a]
    return knots, area


def knots_of(
    log: Log, actions: Sequence[str], delay: float
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K m"]]:
    """Times and integral of the held inputs; before the log, its first input holds."""
    u, t = log.commanded(actions), log.time
    before = delay + 1.0
    time = np.concatenate([[t[0] - before], t, [t[-1] + 1.0]])
    held = np.concatenate([u[:1], u])
    area = np.concatenate([0.0 * u[:1], np.cumsum(held * np.diff(time)[:, None], 0)])
    return time, area
