"""Logs become windows: consecutive ones to learn from, overlapping ones to be judged.

The time column alone says when a row was taken; no rate is ever assumed. Each recorded
input is held until the next row.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp import checks
from sim2gp.data.clock import on_even_clock
from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.errors import error
from sim2gp.systems.base import AbstractSystem, index_of

HALF_WIDTH = 0.025  # s, half the span of the local parabola that guesses a start
PAST = 0.049  # s, the span of the causal one: 25 samples of 2 ms
SPACING = 0.1  # s, between the starts of forecasts
#: Prior sd of a start's unmeasured rate in windows of LONG seconds: so many times its
#: rms, or what slopes over different times differ by. A servo forgets its start's rate
#: at once: only this prior keeps it from where forces saturate, where a simulation
#: jumps (with 10 in place of 3 one of the thirty windows of an arm's log began there,
#: and the parameters followed it). A guess is wrong where the input jumps, so its
#: prior pulls at the parameters: of shorter windows, as there are more of them, it is
#: wider, and a second of log has the same share of pulls.
FAR, LONG = 3.0, 2.0
NOISES = 3.0  # of a measured state's start: so many times the noise of a row
SORTED = 10**6  # values of a channel whose distances are looked at
Start = Literal["smoothed", "causal"]


def cut(
    logs: Sequence[Log],
    system: AbstractSystem,
    *,
    window: float,
    start_sd: dict[str, float] | None = None,
    floor: dict[str, float] | None = None,
    start: Start = "smoothed",
) -> tuple[Windows, Int[np.ndarray, "W 2"]]:
    """Windows of ``window`` seconds that use every row once, and (log, row) of each.

    ``window = 0`` gives the one-step likelihood, which needs every state measured.
    A ``causal`` start knows the past alone. It is where forecasts start, first 0.1 s
    into the log: an excitation that switches on that grid makes the error of a filtered
    start depend on its phase (measured: twice the error between).
    Raises `InputError` E116 where nothing can be cut, E103 where a state is missing or
    unknown, E144 for a sd or a floor that is not positive, E145 for another ``start``,
    E148 for a length that is negative.
    """
    cuts = cuts_of(
        logs, system, window=window, start_sd=start_sd, floor=floor, start=start
    )
    return cuts.whole(), cuts.places


def cuts_of(
    logs: Sequence[Log],
    system: AbstractSystem,
    *,
    window: float,
    start_sd: dict[str, float] | None = None,
    floor: dict[str, float] | None = None,
    start: Start = "smoothed",
) -> Cuts:
    """Where `cut` cuts, as which it raises; its windows are made when asked for."""
    checks.not_negative("cut", window=window)
    checks.one_of("cut", get_args(Start), start=start)
    checks.deviation("start_sd", **(start_sd or {}))
    checks.deviation("floor", **(floor or {}))
    logs = [on_even_clock(log, system) for log in logs]
    measured = measured_states(logs, system, every=window == 0.0)
    past = SPACING if start == "causal" else 0.0
    each = [_pieces(k, log, measured, window, past) for k, log in enumerate(logs)]
    pieces = np.concatenate(each)
    if not len(pieces):
        raise error(
            "no_window_to_learn_from",
            got=f"{sum(len(log) for log in logs)} rows",
            window=f"{window:g}",
        )
    quantum = np.asarray([resolution(logs, name) for name in measured])
    if window == 0.0:
        x0 = _recorded_starts(logs, pieces, measured, system)
        sd = np.zeros_like(x0)
    else:
        x0, sd = _guessed_starts(logs, pieces, measured, system, start, quantum, window)
    # A first row that is the start itself is no measurement of it.
    first, used = int(window == 0.0), np.ones(len(pieces), bool)
    cuts = Cuts(system, logs, pieces, measured, x0, sd, quantum, used, first)
    return _with_stated(cuts, start_sd, floor)


def _pieces(
    k: int, log: Log, measured: Sequence[str], window: float, past: float
) -> Int[np.ndarray, "w 3"]:
    """Where a log is cut: rows of windows in which something was measured."""
    _, mask = log.measured(measured)
    if window == 0.0:
        whole = np.asarray(mask.all(axis=1))
        rows = np.flatnonzero(whole[:-1] & whole[1:])
        ends = np.stack([rows, rows + 2], axis=1)
    else:
        ends = np.asarray(_consecutive(log.time, window, past), int).reshape(-1, 2)
    known = np.concatenate([[0], np.cumsum(mask.any(axis=1))])
    i, j = ends.T
    kept = ends[(known[j] > known[i]) & (j - i > 1)]
    return np.concatenate([np.full((len(kept), 1), k), kept], axis=1)


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


def _recorded_starts(
    logs: Sequence[Log],
    pieces: Int[np.ndarray, "W 3"],
    measured: Sequence[str],
    system: AbstractSystem,
) -> Float[np.ndarray, "W n"]:
    """The first rows of windows in which every state is measured."""
    names = [channel.name for channel in system.physical_states]
    x0 = np.zeros((len(pieces), len(names)))
    where = [names.index(name) for name in measured]
    for k in np.unique(pieces[:, 0]):
        own = pieces[:, 0] == k
        x0[np.ix_(own, where)] = logs[k].measured(measured)[0][pieces[own, 1]]
    return x0


def _guessed_starts(
    logs: Sequence[Log],
    pieces: Int[np.ndarray, "W 3"],
    measured: Sequence[str],
    system: AbstractSystem,
    start: Start,
    quantum: Float[np.ndarray, " c"],
    window: float,
) -> tuple[Float[np.ndarray, "W n"], Float[np.ndarray, "W n"]]:
    """Starts of windows, and the sd of their prior.

    It is a local parabola's value and slope, with a spread far wider than its error, so
    that the same rows are not believed twice, and no slope that a coarse clock blurs
    pulls at the parameters. A causal start is the recorded value and the slope of the
    parabola through the past alone.
    """
    names = [channel.name for channel in system.physical_states]
    x0, wider = np.zeros((2, len(pieces), len(names)))
    for k in np.unique(pieces[:, 0]):
        guesses = _local_parabolas(logs[k], measured, start)
        twice = _local_parabolas(logs[k], measured, start, 2.0)
        for w in np.flatnonzero(pieces[:, 0] == k):
            i = int(pieces[w, 1])
            x0[w] = start_of(names, measured, *guesses(i))
            wider[w] = start_of(names, measured, *twice(i))
    # Slopes over twice the time differ by about what either is wrong by.
    doubt = np.sqrt(np.mean((x0 - wider) ** 2, axis=0))
    far = FAR * math.sqrt(max(LONG / window, 1.0))
    spread = far * np.minimum(np.sqrt(np.mean(x0**2, axis=0)), doubt)
    for name, step in zip(measured, quantum, strict=True):
        # Of a noisy sensor the guess is as wrong as a row is.
        noise = NOISES * roughness(logs, name)
        spread[names.index(name)] = max(100.0 * step, noise)
    spread = np.where(spread > 0.0, spread, 1.0)
    return x0, np.broadcast_to(spread, x0.shape)


def _with_stated(
    cuts: Cuts, start_sd: Mapping[str, float] | None, floor: Mapping[str, float] | None
) -> Cuts:
    """What the user states replaces what was guessed from the data."""
    states = cuts.system.physical_states
    channels = [states[i] for i in cuts.outputs]
    sd, quantum = cuts.start_sd.copy(), cuts.floor.copy()
    for name, value in (start_sd or {}).items():
        sd[:, index_of(name, states, where="start_sd")] = value
    for name, value in (floor or {}).items():
        quantum[index_of(name, channels, where="floor")] = value
    return dataclasses.replace(cuts, start_sd=sd, floor=quantum)


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


def _local_parabolas(
    log: Log, measured: Sequence[str], start: Start, width: float = 1.0
) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """Value and slope of each measured channel at a row, from the rows around it."""
    values, mask = log.measured(measured)
    before, after = (PAST, 0.0) if start == "causal" else (HALF_WIDTH, HALF_WIDTH)
    before, after = width * before, width * after

    def at(i: int) -> tuple[np.ndarray, np.ndarray]:
        time, now = log.time, log.time[i]
        # As long a span at the log's ends: half of it knows slopes ten times worse.
        early = max(0.0, time[0] - now + before) if start == "smoothed" else 0.0
        late = max(0.0, after - (time[-1] - now))
        # Of a long log a part that has all rows in question.
        least, most = now - 2.0 * (before + late), now + 2.0 * (after + early)
        first, last = np.searchsorted(time, (least, most + 1e-6))
        t = time[first:last] - now
        ends = (
            np.searchsorted(t, -before - late),
            np.searchsorted(t, after + early, "right"),
        )
        near, t = slice(first + ends[0], first + ends[1]), t[slice(*ends)]
        value, slope = np.zeros(len(measured)), np.zeros(len(measured))
        for c in range(len(measured)):
            value[c], slope[c] = fit_parabola(
                t, values[near, c], mask[near, c], values[i, c]
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


def roughness(logs: Sequence[Log], name: str) -> float:
    """An upper bound of a channel's noise: the rms of its second differences / sqrt(6).

    Of white noise it is the sd; what bends within two periods adds to it.
    """
    found = [np.zeros(0)]
    for log in logs:
        if name in log.channels:
            i = np.arange(1, len(log) - 1, max(1, len(log) // SORTED))
            y, seen = log.channels[name], log.mask[name]
            valid = seen[i - 1] & seen[i] & seen[i + 1]
            i = i[valid]
            found.append(y[i - 1] - 2.0 * y[i] + y[i + 1])
    bent = np.concatenate(found)
    return float(np.sqrt(np.mean(bent**2) / 6.0)) if len(bent) else 0.0


def resolution(logs: Sequence[Log], name: str) -> float:
    """Standard deviation of the rounding: quantum / sqrt(12), or a share of the rms.

    Of many rows of evenly spread ones: to sort them all takes four times their memory.
    """
    recorded = [log for log in logs if name in log.channels]
    every = max(1, sum(map(len, recorded)) // SORTED)
    each = [log.channels[name][log.mask[name]][::every] for log in recorded]
    y = np.concatenate(each)
    if not len(y):
        return 1.0
    steps = np.diff(np.unique(y))
    spread = float(np.std(y)) or 1.0
    steps = steps[steps > 1e-9 * spread]  # what is closer is one number, printed twice
    if len(steps) and len(steps) < 0.5 * len(y):
        return float(np.median(steps)) / math.sqrt(12.0)
    return 1e-4 * spread
