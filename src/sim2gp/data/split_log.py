"""Logs become windows: consecutive ones to learn from, overlapping ones to be judged.

The time column alone says when a row was taken; no rate is ever assumed. Each recorded
input is held until the next row.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float

from sim2gp import checks
from sim2gp.data.clock import on_even_clock
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.errors import error
from sim2gp.systems.base import DELAY_BLUR, AbstractSystem, index_of, steps_in

HALF_WIDTH = 0.025  # s, half the span of the local parabola that guesses a start
PAST = 0.049  # s, the span of the causal one: 25 samples of 2 ms
SPACING = 0.1  # s, between the starts of forecasts
#: A start's unmeasured rate may lie so many times its rms away, or what slopes over
#: different times differ by. A servo forgets its start's rate at once: only this prior
#: keeps it from where forces saturate, where a simulation jumps (with 10 in place of 3
#: one of the thirty windows of an arm's log began there, and the parameters followed
#: it).
FAR = 3.0
Start = Literal["smoothed", "causal"]


def cut(
    logs: Sequence[Log],
    system: AbstractSystem,
    *,
    window: float,
    start_sd: dict[str, float] | None = None,
    floor: dict[str, float] | None = None,
    start: Start = "smoothed",
) -> tuple[Windows, list[tuple[int, int]]]:
    """Windows of ``window`` seconds that use every row once, and (log, row) of each.

    ``window = 0`` gives the one-step likelihood, which needs every state measured.
    A ``causal`` start knows the past alone. It is where forecasts start, first 0.1 s
    into the log: an excitation that switches on that grid makes the error of a filtered
    start depend on its phase (measured: twice the error between).
    Raises `InputError` E116 where nothing can be cut, E103 where a state is missing or
    unknown, E144 for a sd or a floor that is not positive, E145 for another ``start``,
    E148 for a length that is negative.
    """
    checks.not_negative("cut", window=window)
    checks.one_of("cut", get_args(Start), start=start)
    checks.deviation("start_sd", **(start_sd or {}))
    checks.deviation("floor", **(floor or {}))
    logs = [on_even_clock(log, system) for log in logs]
    measured = measured_states(logs, system, every=window == 0.0)
    pieces = []
    for k, log in enumerate(logs):
        if window == 0.0:
            _, mask = log.measured(measured)
            whole = np.asarray(mask.all(axis=1))
            rows = np.flatnonzero(whole[:-1] & whole[1:])
            pieces += [(k, int(i), int(i) + 2) for i in rows]
        else:
            past = SPACING if start == "causal" else 0.0
            pieces += [(k, i, j) for i, j in _consecutive(log.time, window, past)]
    pieces = [p for p in pieces if _has_data(logs[p[0]], measured, p)]
    if not pieces:
        raise error(
            "no_window_to_learn_from",
            got=f"{sum(len(log) for log in logs)} rows",
            window=f"{window:g}",
        )
    windows = assemble(logs, system, pieces, measured, start)
    if window == 0.0:  # the first row is the start itself, not a measurement of it
        x0 = np.zeros_like(windows.start)
        x0[:, windows.outputs] = windows.y[:, 0]
        mask = windows.mask.copy()
        mask[:, 0] = False
        sd = np.zeros_like(x0)
        windows = dataclasses.replace(windows, start=x0, start_sd=sd, mask=mask)
    return _with_stated(windows, system, measured, start_sd, floor), [
        (k, i) for k, i, _ in pieces
    ]


def measured_states(
    logs: Sequence[Log], system: AbstractSystem, *, every: bool = False
) -> list[str]:
    """States that any log measures; with ``every``, all of them or E103."""
    names = [channel.name for channel in system.physical_states]
    measured = [name for name in names if any(name in log.channels for log in logs)]
    missing = [name for name in names if name not in measured]
    if (every and missing) or not measured:
        raise error(
            "unmeasured_state",
            where="the one-step likelihood" if every else "the logs",
            got=", ".join(measured) or "no state",
            missing=", ".join(missing),
        )
    return measured


def assemble(
    logs: Sequence[Log],
    system: AbstractSystem,
    pieces: Sequence[tuple[int, int, int]],
    measured: Sequence[str],
    start: Start = "smoothed",
) -> Windows:
    """Padded windows of rows ``i .. j - 1`` of log ``k``, for each piece (k, i, j).

    The start's prior is a local parabola's value and slope, with a spread far wider
    than its error, so that the same rows are not believed twice, and no slope that a
    coarse clock blurs pulls at the parameters. A causal start is the recorded value and
    the slope of the parabola through the past alone.
    """
    actions = [channel.name for channel in system.actions]
    names = [channel.name for channel in system.physical_states]
    W, c = len(pieces), len(measured)
    held = [knots_of(log, actions, system.longest_delay) for log in logs]
    guesses = [_local_parabolas(log, measured, start) for log in logs]
    twice = [_local_parabolas(log, measured, start, 2.0) for log in logs]
    steps = [_integration_steps(log.time, system.window_substep) for log in logs]
    L = max(int(steps[k][0][j - 1] - steps[k][0][i]) + 1 for k, i, j in pieces)
    spans = [
        (k, logs[k].time[i], logs[k].time[j - 1] - logs[k].time[i])
        for k, i, j in pieces
    ]
    knots, area = inputs_since(held, spans, system.longest_delay)
    y, mask = np.zeros((W, L, c)), np.zeros((W, L, c), bool)
    span, (x0, wider) = np.zeros((W, L)), np.zeros((2, W, len(names)))
    for w, (k, i, j) in enumerate(pieces):
        values, valid = logs[k].measured(measured)
        row, lengths = steps[k]
        at = row[i:j] - row[i]
        y[w, at], mask[w, at] = values[i:j], valid[i:j]
        span[w, 1 : at[-1] + 1] = lengths[row[i] : row[j - 1]]
        x0[w] = start_of(names, measured, *guesses[k](i))
        wider[w] = start_of(names, measured, *twice[k](i))
    floor = np.asarray([resolution(logs, name) for name in measured])
    outputs = tuple(names.index(name) for name in measured)
    # Slopes over twice the time differ by about what either is wrong by.
    doubt = np.sqrt(np.mean((x0 - wider) ** 2, axis=0))
    spread = FAR * np.minimum(np.sqrt(np.mean(x0**2, axis=0)), doubt)
    for index, quantum in zip(outputs, floor, strict=True):
        spread[index] = 100.0 * quantum
    spread = np.where(spread > 0.0, spread, 1.0)
    sd = np.broadcast_to(spread, x0.shape)
    which = np.asarray([logs[k].group for k, _, _ in pieces], np.int32)
    return Windows(span, knots, area, y, mask, x0, sd, floor, which, outputs)


def inputs_since(
    held: Sequence[tuple[np.ndarray, np.ndarray]],
    spans: Sequence[tuple[int, float, float]],
    delay: float,
) -> tuple[Float[np.ndarray, "W H"], Float[np.ndarray, "W H m"]]:
    """Padded knots and integrals of the inputs for each (log, since, length) in s.

    They reach ``delay`` seconds (and a blur's width) back; knots count from ``since``.
    """
    ranges = []
    for k, since, length in spans:
        time = held[k][0]
        back = delay + DELAY_BLUR
        first = int(np.searchsorted(time, since - back, side="right")) - 1
        last = int(np.searchsorted(time, since + length + DELAY_BLUR)) + 1
        ranges.append((max(first, 0), min(last, len(time))))
    W, H = len(spans), max(b - a for a, b in ranges)
    knots, area = np.zeros((W, H)), np.zeros((W, H, held[0][1].shape[1]))
    for w, ((k, since, _), (a, b)) in enumerate(zip(spans, ranges, strict=True)):
        knots[w, : b - a] = held[k][0][a:b] - since
        knots[w, b - a :] = knots[w, b - a - 1] + np.arange(1.0, H - (b - a) + 1)
        area[w] = held[k][1][np.minimum(np.arange(a, a + H), b - 1)]
        area[w] -= held[k][1][a]
    return knots, area


def _with_stated(
    windows: Windows,
    system: AbstractSystem,
    measured: Sequence[str],
    start_sd: Mapping[str, float] | None,
    floor: Mapping[str, float] | None,
) -> Windows:
    """What the user states replaces what was guessed from the data."""
    states = system.physical_states
    channels = [c for name in measured for c in states if c.name == name]
    sd, quantum = windows.start_sd.copy(), windows.floor.copy()
    for name, value in (start_sd or {}).items():
        sd[:, index_of(name, states, where="start_sd")] = value
    for name, value in (floor or {}).items():
        quantum[index_of(name, channels, where="floor")] = value
    return dataclasses.replace(windows, start_sd=sd, floor=quantum)


def _consecutive(
    time: np.ndarray, window: float, past: float = 0.0
) -> list[tuple[int, int]]:
    """Rows [i, j) of windows that do not overlap; a short rest is left out."""
    slack = 0.5 * float(np.median(np.diff(time)))
    out, i = [], int(np.searchsorted(time, time[0] + past - min(slack, past)))
    while i < len(time):
        j = int(np.searchsorted(time, time[i] + window - slack))
        if time[min(j, len(time) - 1)] - time[i] >= 0.5 * window - slack:
            out.append((i, j))
        i = max(j, i + 1)
    return out


def _has_data(log: Log, measured: Sequence[str], piece: tuple[int, int, int]) -> bool:
    _, mask = log.measured(measured)
    return bool(mask[piece[1] : piece[2]].any()) and piece[2] - piece[1] > 1


def _integration_steps(
    time: Float[np.ndarray, " N"], longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Integration steps of at most ``longest`` seconds that meet every stamp.

    Returns each stamp's place among the steps' ends, and the steps' lengths.
    """
    gaps = np.round(np.diff(time), 9)  # those that are equal differ by rounding
    count = steps_in(gaps, longest)
    place = np.concatenate([[0], np.cumsum(count)])
    return place, np.repeat(gaps / count, count)


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


def _local_parabolas(
    log: Log, measured: Sequence[str], start: Start, width: float = 1.0
) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """Value and slope of each measured channel at a row, from the rows around it."""
    values, mask = log.measured(measured)
    before, after = (PAST, 0.0) if start == "causal" else (HALF_WIDTH, HALF_WIDTH)
    before, after = width * before, width * after

    def at(i: int) -> tuple[np.ndarray, np.ndarray]:
        t = log.time - log.time[i]
        # As long a span at the log's ends: half of it knows slopes ten times worse.
        early = max(0.0, t[0] + before) if start == "smoothed" else 0.0
        late = max(0.0, after - t[-1])
        near = slice(
            int(np.searchsorted(t, -before - late)),
            int(np.searchsorted(t, after + early, side="right")),
        )
        value, slope = np.zeros(len(measured)), np.zeros(len(measured))
        for c in range(len(measured)):
            value[c], slope[c] = fit_parabola(
                t[near], values[near, c], mask[near, c], values[i, c]
            )
            if start == "causal" and mask[i, c]:
                value[c] = values[i, c]
        return value, slope

    return at


def fit_parabola(
    t: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
    valid: Bool[np.ndarray, " N"],
    otherwise: float,
) -> tuple[float, float]:
    """Value and slope at ``t = 0`` of the least-squares parabola through ``y``."""
    t, y = t[valid], y[valid]
    if len(t) < 2:
        return otherwise, 0.0
    degree = min(2, len(t) - 1)
    unit = max(float(np.abs(t).max()), 1e-12)
    basis = (t[:, None] / unit) ** np.arange(degree + 1)
    coefficients = np.linalg.lstsq(basis, y, rcond=None)[0]
    return float(coefficients[0]), float(coefficients[1]) / unit


def start_of(
    names: Sequence[str], measured: Sequence[str], value: np.ndarray, slope: np.ndarray
) -> Float[np.ndarray, " n"]:
    """The state at a row: measured values, and slopes for unmeasured velocities."""
    known = dict(zip(measured, value, strict=True))
    rates = {f"{name}.velocity": s for name, s in zip(measured, slope, strict=True)}
    return np.asarray([known.get(name, rates.get(name, 0.0)) for name in names])


def resolution(logs: Sequence[Log], name: str) -> float:
    """Standard deviation of the rounding: quantum / sqrt(12), or a share of the rms."""
    recorded = [log for log in logs if name in log.channels]
    y = np.concatenate([log.channels[name][log.mask[name]] for log in recorded])
    if not len(y):
        return 1.0
    steps = np.diff(np.unique(y))
    spread = float(np.std(y)) or 1.0
    steps = steps[steps > 1e-9 * spread]  # what is closer is one number, printed twice
    if len(steps) and len(steps) < 0.5 * len(y):
        return float(np.median(steps)) / math.sqrt(12.0)
    return 1e-4 * spread
