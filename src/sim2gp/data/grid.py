"""Windows to be judged by: a log on an even grid, forecasts from causal starts.

Angles are interpolated linearly on a grid of 2 ms, inputs stay held between their own
stamps. A window starts every 0.1 s, where its past is complete: measured states are
taken as recorded, an unmeasured velocity is the slope of the parabola through the last
25 samples (a causal Savitzky-Golay filter of order 2), so that nothing of the future
enters a forecast but the inputs. Windows overlap; they end with their log.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp import checks
from sim2gp.data.clock import step_between
from sim2gp.data.cuts import inputs_since
from sim2gp.data.logs import Log
from sim2gp.data.split_log import SPACING, measured_states, resolution
from sim2gp.data.windows import Windows
from sim2gp.systems.base import LONGEST_MEAN, AbstractSystem

PERIOD = 2e-3  # s
SAMPLES = 25  # of the filter
ORDER = 2
MOST = 10_000  # windows: of longer logs they start further apart
CURVE = tuple(round(0.1 * k, 1) for k in range(1, 11))  # s, horizons of the error curve


class Grid(eqx.Module):
    """Evaluation windows, and for each its log and how far a causal start is off.

    ``lag`` is the start used minus the centred estimate, which knows the future too
    (NaN at the end of a log, where there is none). Every ``every``-th sample is one
    that a simulation passes: a simulator is not stepped finer than it is in a fit.
    """

    windows: Windows
    log: Int[np.ndarray, " W"]
    since: Float[np.ndarray, " W"]  # s, on the log's clock
    lag: Float[np.ndarray, "W n"]
    every: int = eqx.field(static=True, default=1)


def steps_of(horizon: float) -> int:
    """The number of grid steps in ``horizon`` seconds, at least one."""
    return max(1, round(horizon / PERIOD))


def evaluation_windows(
    logs: Sequence[Log], system: AbstractSystem, *, longest: float
) -> Grid:
    """Windows of up to ``longest`` seconds of all logs; rows are grid samples.

    A window whose start rests on a masked sample is left out; a masked row is not
    compared. Of logs of more than 1,000 s together they start further apart.
    Raises `InputError` E148 for a length that is not positive.
    """
    checks.positive("evaluation_windows", longest=longest)
    states = [channel.name for channel in system.physical_states]
    actions = [channel.name for channel in system.actions]
    measured = measured_states(logs, system)
    L, apart = steps_of(longest) + 1, between_starts(logs)
    parts, spans = [], []
    for k, log in enumerate(logs):
        y, valid = on_grid(log, measured)
        first = _starts(valid, apart)
        starts, centred = _start_states(y, states, measured)
        rows = first[:, None] + np.arange(L)[None]
        inside = rows < len(y)
        rows = np.minimum(rows, len(y) - 1)
        mask = valid[rows] & inside[..., None]
        lag = starts[first] - centred[first]
        parts.append((y[rows], mask, starts[first], lag, np.full(len(first), k)))
        since = log.time[0] + PERIOD * first
        spans += [(k, float(s), PERIOD * (L - 1)) for s in since]
    y, mask, start, lag, which = (np.concatenate(x) for x in zip(*parts, strict=True))
    knots, area = inputs_since(logs, actions, spans, system.longest_delay)
    windows = Windows(
        even_spans(*mask.shape[:2]),
        knots,
        area,
        y,
        mask,
        start,
        np.zeros_like(start),
        np.asarray([resolution(logs, name) for name in measured]),
        np.asarray([logs[k].group for k, _, _ in spans], np.int32),
        tuple(states.index(name) for name in measured),
    )
    since = np.asarray([s for _, s, _ in spans])
    return Grid(windows, which, since, lag, _every(logs, system))


def even_spans(count: int, rows: int) -> Float[np.ndarray, "count rows"]:
    """Of windows whose rows are grid samples: in memory one row for all."""
    span = np.full(rows, PERIOD)
    span[0] = 0.0
    return np.broadcast_to(span, (count, rows))


def _every(logs: Sequence[Log], system: AbstractSystem) -> int:
    """Samples to a row of a simulation, whose steps are most like those of the fit.

    A divisor of the samples in 0.1 s, so that every horizon is passed. A simulator with
    a step of its own takes several to a row, and no row is longer than a log's.
    """
    stamps = min(float(np.median(np.diff(log.time))) for log in logs)
    whole, longest = steps_of(SPACING), system.window_substep
    fitted = step_between(stamps, longest)
    rows = longest if system.own_step is None else max(longest, LONGEST_MEAN)
    rows = max(1.0, min(rows, stamps) / PERIOD + 1e-6)
    divisors = [k for k in range(1, whole + 1) if whole % k == 0 and k <= rows]
    if system.own_step is None:
        return divisors[-1]

    def away(k: int) -> float:
        return abs(step_between(k * PERIOD, longest) - fitted)

    return min(divisors, key=lambda k: (round(away(k), 9), -k))


def on_grid(
    log: Log, measured: Sequence[str]
) -> tuple[Float[np.ndarray, "N c"], Bool[np.ndarray, "N c"]]:
    """Measured channels on the grid; a sample counts if both its neighbours do."""
    values, mask = log.measured(measured)
    time = log.time - log.time[0]
    at = PERIOD * np.arange(int(np.floor(time[-1] / PERIOD + 1e-9)) + 1)
    y = [np.interp(at, time, column) for column in values.T]
    bad = [np.interp(at, time, (~column).astype(float)) for column in mask.T]
    return np.stack(y, axis=1), np.stack(bad, axis=1) < 1e-9


def parabola_weights(age: Float[np.ndarray, " L"]) -> Float[np.ndarray, "3 L"]:
    """Weights of samples at ``age``: value, slope and curvature/2 of their parabola."""
    return np.asarray(np.linalg.pinv(np.vander(age, ORDER + 1, increasing=True)))


def parabola_slopes(
    y: Float[np.ndarray, "N c"], *, causal: bool
) -> tuple[Float[np.ndarray, "N c"], Float[np.ndarray, "N c"]]:
    """Value and slope of the parabola through 25 samples; NaN where some are missing.

    The causal one ends at the sample, the other is centred on it.
    """
    half = 0 if causal else SAMPLES // 2
    age = PERIOD * (np.arange(SAMPLES) - (SAMPLES - 1 - half))
    weights = parabola_weights(age)[:2]
    value, slope = np.full_like(y, np.nan), np.full_like(y, np.nan)
    if len(y) < SAMPLES:
        return value, slope
    near = np.lib.stride_tricks.sliding_window_view(y, SAMPLES, axis=0)
    rows = slice(SAMPLES - 1 - half, len(y) - half)
    value[rows], slope[rows] = near @ weights[0], near @ weights[1]
    return value, slope


def between_starts(logs: Sequence[Log]) -> int:
    """Samples from one start to the next: 0.1 s, or a multiple where logs are long."""
    seconds = sum(float(log.time[-1] - log.time[0]) for log in logs)
    return steps_of(SPACING) * max(1, math.ceil(seconds / SPACING / MOST))


def _starts(valid: Bool[np.ndarray, "N c"], apart: int) -> Int[np.ndarray, " W"]:
    """Samples ``apart``, the first at 0.1 s, with a whole past and some future."""
    every = steps_of(SPACING)
    first = np.arange(every, len(valid) - steps_of(CURVE[0]), apart)
    past = first[:, None] + np.arange(1 - SAMPLES, 1)
    return first[valid[past].all(axis=(1, 2))]


def _start_states(
    y: Float[np.ndarray, "N c"], states: Sequence[str], measured: Sequence[str]
) -> tuple[Float[np.ndarray, "N n"], Float[np.ndarray, "N n"]]:
    """Every sample's state as a forecast would start, and its centred estimate."""
    (_, causal), (value, centred) = (
        parabola_slopes(y, causal=True),
        parabola_slopes(y, causal=False),
    )
    start = states_from(y, causal, states, measured)
    return start, states_from(value, centred, states, measured)


def states_from(
    value: Float[np.ndarray, "N c"],
    slope: Float[np.ndarray, "N c"],
    states: Sequence[str],
    measured: Sequence[str],
) -> Float[np.ndarray, "N n"]:
    """States by measured values, and by slopes where a velocity is not measured.

    Zero where neither it nor its position is.
    """
    out = np.zeros((len(value), len(states)))
    for i, name in enumerate(states):
        position = name.removesuffix(".velocity")
        if name in measured:
            out[:, i] = value[:, measured.index(name)]
        elif position in measured:
            out[:, i] = slope[:, measured.index(position)]
    return out
