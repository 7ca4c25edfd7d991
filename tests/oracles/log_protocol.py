"""How well a model of a machine predicts a recorded log: the protocol, in numpy.

A log is put on a grid of 2 ms: angles by linear interpolation between their time
stamps, inputs held between theirs. A window starts every 0.1 s. Its start angle is the
recorded one, its start velocity comes from a causal Savitzky-Golay filter (quadratic,
25 samples), and the model then runs open loop, q'' = f(q, q', u), by fourth-order
Runge-Kutta with one step per sample. The error of a window is that of its last sample;
errors are pooled over windows, and over logs, as a root mean square per angle.

Held inputs and grid do not share their stamps (the period recorded is 2.0001 ms, with
gaps), so a step is driven by the mean over the step of the held input,
(U(t + h) - U(t)) / h with U its integral. Reading the sample at the start of the step
instead is one sample late for most of a log. A delay of the input shifts U.

Independent of the package on purpose: nothing here imports it.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

PERIOD = 0.002  # s, of the grid
SPACING = 50  # samples between the starts of two windows: 0.1 s
FILTER_SAMPLES = 25
FILTER_ORDER = 2
FIRST = SPACING  # the first start: a multiple of 0.1 s with a full filter behind it
HORIZONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)  # s, of the error curve

Array = np.ndarray
Acceleration = Callable[[Array, Array, Array], Array]
"""(angle (W, d) rad, velocity (W, d) rad/s, input (W, m)) -> (W, d) rad/s^2."""


class Recording(NamedTuple):
    """A log as recorded: time (N,) s, angle (N, d) rad, held input (N, m)."""

    time: Array
    angle: Array
    input: Array


class Gridded(NamedTuple):
    """A log on the grid: angle and velocity (N, d), mean input per step (N, m)."""

    angle: Array
    velocity: Array
    input: Array


def read(
    path: Path, time: str, angles: Sequence[str], inputs: Sequence[str]
) -> Recording:
    """The columns of a csv file as a `Recording`; blanks in the header are dropped."""
    table = np.genfromtxt(path, delimiter=",", names=True, autostrip=True)
    return Recording(
        table[time],
        np.stack([table[name] for name in angles], axis=1),
        np.stack([table[name] for name in inputs], axis=1),
    )


def read_arm(path: Path) -> Recording:
    """A log of the two-link arm: joint angles in rad, commanded torques in N m."""
    return read(path, "time", ("pos_meas1", "pos_meas2"), ("tau_con1", "tau_con2"))


def read_qube(path: Path) -> Recording:
    """A log of the Qube: arm and pendulum (0 = upright) in rad, input in V."""
    return read(path, "t", ("theta", "alpha"), ("plant_input",))


def mean_held_input(time: Array, held: Array, edges: Array) -> Array:
    """The mean of one held input (N,) between successive edges (K + 1,): (K,).

    Before the first stamp the input is taken as zero, after the last as still held.
    """
    integral = np.concatenate([[0.0], np.cumsum(held[:-1] * np.diff(time))])
    beyond = time[-1] + 1.0
    time = np.append(time, beyond)
    integral = np.append(integral, integral[-1] + held[-1])
    return np.diff(np.interp(edges, time, integral)) / np.diff(edges)


def on_grid(recording: Recording, delay: Sequence[float] | None = None) -> Gridded:
    """The log on the grid, its inputs acting `delay` (m,) seconds late."""
    time = recording.time - recording.time[0]
    count = int(np.floor(time[-1] / PERIOD + 1e-9)) + 1
    edges = PERIOD * np.arange(count + 1)
    angle = np.stack(
        [np.interp(edges[:-1], time, column) for column in recording.angle.T], axis=1
    )
    late = np.zeros(recording.input.shape[1]) if delay is None else np.asarray(delay)
    drive = np.stack(
        [
            mean_held_input(time, column, edges - shift)
            for column, shift in zip(recording.input.T, late, strict=True)
        ],
        axis=1,
    )
    return Gridded(angle, causal_velocity(angle), drive)


def causal_velocity(angle: Array) -> Array:
    """Slope at the newest of the last 25 samples of a quadratic fit; NaN before."""
    age = PERIOD * np.arange(1 - FILTER_SAMPLES, 1)
    powers = np.vander(age, FILTER_ORDER + 1, increasing=True)
    slope = np.linalg.pinv(powers)[1]
    past = np.lib.stride_tricks.sliding_window_view(angle, FILTER_SAMPLES, axis=0)
    velocity = np.full_like(angle, np.nan)
    velocity[FILTER_SAMPLES - 1 :] = past @ slope
    return velocity


def window_starts(samples: int, steps: int, spacing: int = SPACING) -> Array:
    """First samples of all windows of `steps` steps that lie inside the log."""
    return np.arange(FIRST, samples - steps, spacing)


def window_inputs(log: Gridded, starts: Array, steps: int) -> Array:
    """Inputs (steps, W, m) of the windows."""
    return log.input[starts[None, :] + np.arange(steps)[:, None]]


def rollout(acceleration: Acceleration, q: Array, v: Array, inputs: Array) -> Array:
    """Angles (steps + 1, W, d) of all windows from (q, v), by Runge-Kutta."""
    h = PERIOD
    angles = [q]
    for u in inputs:
        a1 = acceleration(q, v, u)
        a2 = acceleration(q + h / 2 * v, v + h / 2 * a1, u)
        a3 = acceleration(q + h / 2 * v + h**2 / 4 * a1, v + h / 2 * a2, u)
        a4 = acceleration(q + h * v + h**2 / 2 * a2, v + h * a3, u)
        q = q + h * v + h**2 / 6 * (a1 + a2 + a3)
        v = v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        angles.append(q)
    return np.stack(angles)


def steps_of(horizon: float) -> int:
    """Number of grid steps in `horizon` seconds."""
    return round(horizon / PERIOD)


def errors(acceleration: Acceleration, log: Gridded, horizon: float) -> Array:
    """Predicted minus recorded angle (W, d) in rad at the last sample of each window.

    `horizon` in s.
    """
    steps = steps_of(horizon)
    starts = window_starts(len(log.angle), steps)
    predicted = rollout(
        acceleration,
        log.angle[starts],
        log.velocity[starts],
        window_inputs(log, starts, steps),
    )[-1]
    return predicted - log.angle[starts + steps]


def rms(error: Array) -> Array:
    """Root mean square over windows (d,) of errors (W, d)."""
    return np.sqrt(np.mean(error**2, axis=0))


def pooled_rms(error: Iterable[Array]) -> Array:
    """Root mean square (d,) over the windows of several logs together."""
    return rms(np.concatenate(list(error)))


def error_curve(
    acceleration: Acceleration,
    log: Gridded,
    horizons: Sequence[float] = HORIZONS,
) -> Array:
    """Root mean square error (len(horizons), d) in rad at each horizon in s."""
    return np.stack([rms(errors(acceleration, log, h)) for h in horizons])
