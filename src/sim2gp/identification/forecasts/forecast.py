"""Open-loop forecasts of windows, and the band that they are predicted to stay in.

A forecast has errors from its start, from its parameters, and from what the model does
not know. For a window's output at horizon h, to first order,

    V(h) = max over h' <= h of
           J_s S_s J_s^T + J_d S_d J_d^T + J_z S_z J_z^T + resolution^2

with S_s the second moment of (causal - centred) start states, S_z the posterior, and
S_d one constant, unknown input disturbance per window and input, whose standard
deviations are fitted to the training logs' own forecast errors. The machine's errors
need not grow like that (a pendulum's swing back): at each horizon V is scaled to the
training errors' own mean square (`Band.shape`). The noise of the windows' likelihood is
left out: it *is* those errors, averaged over horizons.

What replicates is the log, not the sample. A mean square over m training logs is made
unbiased by m / (m - 1), and a new log adds its own deviation, 1 + 1/m: together the
variance is raised by (m + 1) / (m - 1).
"""

import dataclasses
import math
from dataclasses import dataclass
from statistics import NormalDist

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.compilation import compile_async
from sim2gp.data.grid import PERIOD, Grid
from sim2gp.data.window_slopes import HostRun, SlopeInputs
from sim2gp.data.windows import Windows
from sim2gp.inference.gaussian import LOG_2PI, Gaussian
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import simulator_of
from sim2gp.systems.plants.external import AbstractSimulator
from sim2gp.systems.simulate import simulate
from sim2gp.types import AnyArray, in_float64

_BATCH = 64  # windows at a time: bounds the memory of sensitivities


class Forecast(eqx.Module):
    """Predictions of windows at some rows, their errors and their sensitivities."""

    mean: Float[np.ndarray, "W R c"]
    error: Float[np.ndarray, "W R c"]  # prediction minus measurement
    valid: Bool[np.ndarray, "W R c"]
    by_start: Float[np.ndarray, "W R c n"]
    by_input: Float[np.ndarray, "W R c m"]
    by_constants: Float[np.ndarray, "W R c"]  # variance
    rows: tuple[int, ...] = eqx.field(static=True)  # of the grid

    def of(self, which: Bool[np.ndarray, " W"] | Int[np.ndarray, " w"]) -> "Forecast":
        """The forecasts of some of the windows, chosen by a mask or by number."""
        chosen: Forecast = jax.tree.map(lambda x: x[which], self)
        return chosen

    def at(self, rows: Int[np.ndarray, " r"]) -> "Forecast":
        """The forecasts at some of the rows, named as in the grid."""
        places = [self.rows.index(row) for row in rows.tolist()]
        chosen: Forecast = jax.tree.map(lambda x: x[:, places], self)
        return dataclasses.replace(chosen, rows=tuple(rows.tolist()))

    def rmse(self) -> Float[np.ndarray, "R c"]:
        """Root mean square over windows; NaN where nothing was measured."""
        count = self.valid.sum(axis=0)
        squares = np.sum(np.where(self.valid, self.error, 0.0) ** 2, axis=0)
        return np.sqrt(squares / np.where(count > 0, count, np.nan))


@in_float64
def forecast_windows(
    system: AbstractSystem,
    posterior: Gaussian,
    grid: Grid,
    rows: Int[np.ndarray, " R"],
) -> Forecast:
    """Simulate every window from its start at the posterior mean, to some samples.

    Batches of one size, the last one filled up: all forecasts of a run share one
    compilation, and memory is bounded however long the logs are. What a simulator on
    the host compiles is small, so there a batch need not be full.
    """
    windows, W = grid.windows, len(grid.windows)
    simulator, passed = simulator_of(system), np.union1d(_passed(grid), rows)
    if simulator is not None:  # a compiled program serves all horizons
        passed = passed[passed <= rows.max(initial=0)]
    places = np.searchsorted(passed, rows)
    size = _BATCH if simulator is None else math.ceil(W / math.ceil(W / _BATCH))
    parts = []
    for first in range(0, W, size):
        which = np.minimum(np.arange(first, first + size), W - 1)
        some = _window_batch(grid, which, passed)
        if simulator is not None:
            found = _forecast_on_host(simulator, system, posterior, some)
        else:
            found = _forecast_batch(system, posterior, jax.device_put(some))
        parts.append([np.asarray(x)[: W - first, places] for x in found])
    mean, by_start, by_input, by_constants = map(
        np.concatenate, zip(*parts, strict=True)
    )
    y, valid = np.asarray(windows.y)[:, rows], np.asarray(windows.mask)[:, rows]
    at = tuple(rows.tolist())
    return Forecast(mean, mean - y, valid, by_start, by_input, by_constants, at)


@in_float64
def compile_forecast(system: AbstractSystem, grid: Grid) -> None:
    """Compile `forecast_windows` early, for windows like these and any posterior.

    It serves where the samples asked for are such as every simulation passes.
    """
    if simulator_of(system) is not None:
        return  # its programs are small
    first = _window_batch(grid, np.zeros(_BATCH, int), _passed(grid))
    arrays = jax.device_put(first)
    _forecast_batch.compile_for(system, system.parameters.prior(), arrays)


@compile_async
def _forecast_batch(
    system: AbstractSystem, posterior: Gaussian, windows: Windows
) -> tuple[Array, Array, Array, Array]:
    """Outputs at all rows, their slopes in start and input, variance by parameters."""
    n, m = windows.start.shape[1], windows.area.shape[2]

    def one(window: Windows) -> tuple[Array, Array, Array, Array]:
        def states(x: Array) -> Array:
            tt = posterior.mean + posterior.scale @ x[n + m :]
            params = system.record(system.values(tt, window.configuration))
            return simulate(system, params, window, window.start + x[:n], x[n : n + m])

        x = jnp.zeros(n + m + posterior.scale.shape[1])
        return _forecast_parts(window, *value_and_jacobian(states, x))

    found: tuple[Array, Array, Array, Array] = windows.each(one)
    return found


def _forecast_on_host(
    simulator: AbstractSimulator,
    system: AbstractSystem,
    posterior: Gaussian,
    windows: Windows,
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    mean, scale = np.asarray(posterior.mean), np.asarray(posterior.scale)
    n, m = windows.start.shape[1], windows.area.shape[2]
    by_start, by_input, by_constants = np.split(
        np.eye(n + m + scale.shape[1]), [n, n + m]
    )
    asked = SlopeInputs(mean, windows.start, scale @ by_constants, by_start, by_input)
    run = HostRun(simulator, system, windows, asked)
    return _forecast_parts(windows, run.states, run.slopes())


def _forecast_parts(
    window: Windows,
    states: Float[AnyArray, "*W L n"],
    slopes: Float[AnyArray, "*W L n k"],
) -> tuple[AnyArray, AnyArray, AnyArray, AnyArray]:
    """Outputs, their slopes in start and input, and their variance by parameters."""
    outputs = np.asarray(window.outputs)
    n, J = states.shape[-1], slopes[..., outputs, :]
    inputs = n + window.area.shape[-1]
    rest = (J[..., inputs:] ** 2).sum(axis=-1)
    return states[..., outputs], J[..., :n], J[..., n:inputs], rest


def _passed(grid: Grid) -> Int[np.ndarray, " L"]:
    """Samples that every simulation passes: of its own steps, and the first."""
    return np.union1d([1], np.arange(0, grid.windows.span.shape[1], grid.every))


def _window_batch(grid: Grid, which: np.ndarray, rows: np.ndarray) -> Windows:
    """Some of the windows, in steps from one of ``rows`` to the next."""
    chosen = grid.windows.some(which)
    new = np.diff(which, prepend=-1) > 0  # what fills a batch up does not move
    span = new[:, None] * PERIOD * np.diff(rows, prepend=0)
    thin: Windows = eqx.tree_at(
        lambda w: (w.span, w.y, w.mask),
        chosen,
        (span, chosen.y[:, rows], chosen.mask[:, rows]),
    )
    return thin


@dataclass(frozen=True)
class Band:
    """What a forecast's spread is made of, in addition to the posterior."""

    start_sd: Float[np.ndarray, " n"]
    input_sd: Float[np.ndarray, " m"]
    resolution: Float[np.ndarray, " c"]
    rows: Float[np.ndarray, " R"]  # of the grid, where the shape was learned
    shape: Float[np.ndarray, "R c"]  # observed over modelled variance
    inflation: float

    def scale(self, found: Forecast) -> Float[np.ndarray, "W R c"]:
        """The square root of V, shaped and raised, at every row; rows in rising order.

        Between its rows the shape is interpolated, beyond them it stays; at the start
        it is 1, for the start's own variance is known.
        """
        V = _variance(found, self.start_sd, self.resolution, self.input_sd)
        shape = [np.interp(found.rows, self.rows, column) for column in self.shape.T]
        return np.sqrt(self.inflation * np.stack(shape, axis=1) * V)

    def half_width(self, level: float) -> float:
        """How many scales a central band of this probability reaches to each side."""
        return NormalDist().inv_cdf(0.5 + 0.5 * level)

    def log_prob(self, found: Forecast) -> Float[np.ndarray, "W R c"]:
        """Log density of each measurement, nats."""
        scale = self.scale(found)
        return -0.5 * (found.error / scale) ** 2 - np.log(scale) - 0.5 * LOG_2PI


def fit_band(found: Forecast, grid: Grid, recordings: int) -> Band:
    """The band of a model from its forecasts of the logs that it was fitted to.

    The disturbances' standard deviations maximise the Gaussian likelihood of the
    errors at all rows, taken as if they were independent.
    """
    import scipy.optimize  # late, as in `sim2gp.inference.parameters`

    start_sd = np.sqrt(np.nanmean(grid.lag**2, axis=0))
    resolution = np.asarray(grid.windows.floor)
    valid, m = found.valid, recordings

    def variance(log_sd: np.ndarray) -> np.ndarray:
        return _variance(found, start_sd, resolution, np.exp(log_sd))

    def cost(log_sd: np.ndarray) -> float:
        V = variance(log_sd)
        return float(np.mean((found.error**2 / V + np.log(V))[valid]))

    reach = np.sqrt(np.mean(found.by_input**2, axis=(0, 1, 2)))
    error = np.sqrt(np.mean(found.error[valid] ** 2))
    guess = np.log(error / np.where(reach > 0.0, reach, 1.0) + 1e-300)
    best = scipy.optimize.minimize(cost, guess, method="Nelder-Mead").x
    squares = np.where(valid, found.error**2 / variance(best), 0.0).sum(axis=0)
    count = valid.sum(axis=0)
    shape = np.where(count > 0, squares / np.maximum(count, 1), 1.0)
    rows = np.asarray((0.0, *found.rows))
    shape = np.concatenate([np.ones_like(shape[:1]), shape])
    return Band(start_sd, np.exp(best), resolution, rows, shape, new_log_inflation(m))


def new_log_inflation(recordings: int) -> float:
    """By what a variance seen in ``m`` training logs is raised for another log.

    One log says nothing of another: then twice the sd is as good as any.
    """
    return (recordings + 1) / (recordings - 1) if recordings > 1 else 4.0


def _variance(
    found: Forecast,
    start_sd: Float[np.ndarray, " n"],
    resolution: Float[np.ndarray, " c"],
    input_sd: Float[np.ndarray, " m"],
) -> Float[np.ndarray, "W R c"]:
    V = np.einsum("wrcn,n->wrc", found.by_start**2, start_sd**2)
    V = V + np.einsum("wrcm,m->wrc", found.by_input**2, input_sd**2)
    V = V + found.by_constants + resolution**2
    return np.asarray(np.maximum.accumulate(V, axis=1))
