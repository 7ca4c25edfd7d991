"""What identify and evaluate share: forecasts, scores, traces.

A forecast is judged at the last sample of its window, errors pooled over windows as a
root mean square, next to those of two predictors without mechanics
(`sim2gp.identification.forecasts.baselines`).
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.data.cuts import Cuts
from sim2gp.data.grid import CURVE, PERIOD, Grid, steps_of
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.identification.forecasts.baselines import compare_baselines, loss_sentence
from sim2gp.identification.forecasts.forecast import Band, Forecast, forecast_windows
from sim2gp.identification.forecasts.scoring import masked_mean
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.base import AbstractSystem

TRACE = 0.5  # s, the windows that are drawn
_FINEST = 5  # grid samples from one point of a curve to the next
Picture = dict[str, tuple[np.ndarray, ...]]


def recording_names(logs: Sequence[Log]) -> list[str]:
    """The recording of each log; a file cut at its gaps is one recording."""
    return [log.source for log in logs]


def channels(system: AbstractSystem, windows: Windows | Cuts) -> list[str]:
    """Names of the measured states, in the windows' order."""
    return [system.physical_states[i].name for i in windows.outputs]


def channel_units(system: AbstractSystem) -> dict[str, str]:
    """Units of all channels, for the report."""
    return {c.name: c.unit for c in (*system.physical_states, *system.actions)}


def scored_rows(horizon: float) -> Int[np.ndarray, " R"]:
    """Grid samples to be judged: one step, the error curve, the horizon."""
    steps = {1, steps_of(horizon), *(steps_of(h) for h in CURVE)}
    return np.asarray(sorted(steps))


def _rows_of_traces(grid: Grid) -> Int[np.ndarray, " R"]:
    """Grid samples of a curve that is drawn, such as every simulation passes."""
    return np.arange(0, steps_of(TRACE) + 1, int(np.lcm(_FINEST, grid.every)))


def forecast_grid(
    system: AbstractSystem, posterior: Gaussian, grid: Grid, horizon: float
) -> Forecast:
    """Forecasts of ``grid``'s windows, at all that is judged or drawn of them."""
    rows = np.union1d(scored_rows(horizon), _rows_of_traces(grid))
    return forecast_windows(system, posterior, grid, rows)


class ScoredForecasts(eqx.Module):
    """Held-out forecasts with their bands, and the trivial predictors' errors.

    The regression's are NaN where it had too few windows to learn from.
    """

    rows: Int[np.ndarray, " R"]
    valid: Bool[np.ndarray, "W R c"]
    error: Float[np.ndarray, "W R c"]
    scale: Float[np.ndarray, "W R c"]
    log_prob: Float[np.ndarray, "W R c"]
    hold: Float[np.ndarray, "W R c"]
    regression: Float[np.ndarray, "W R c"]
    log: Int[np.ndarray, " W"]
    inside90: Bool[np.ndarray, "W R c"]
    inside95: Bool[np.ndarray, "W R c"]


def score_forecasts(
    rows: np.ndarray,
    grid: Grid,
    found: Forecast,
    band: Band,
    regression: Float[np.ndarray, "W R c"],
) -> ScoredForecasts:
    """Forecasts of ``grid``'s windows held against their band."""
    y, found = np.asarray(grid.windows.y), found.at(rows)
    start = np.asarray(grid.windows.start)[:, list(grid.windows.outputs)]
    scale, error = band.scale(found), np.abs(found.error)
    return ScoredForecasts(
        rows,
        found.valid,
        found.error,
        scale,
        band.log_prob(found),
        start[:, None] - y[:, rows],
        regression,
        grid.log,
        error <= band.half_width(0.9) * scale,
        error <= band.half_width(0.95) * scale,
    )


def join_folds(parts: Sequence[ScoredForecasts]) -> ScoredForecasts:
    """The folds of a leave-one-out side by side."""
    first = parts[0]
    fields = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in first.__dataclass_fields__
        if name != "rows"
    }
    return ScoredForecasts(rows=first.rows, **fields)


def forecast_scores(
    found: ScoredForecasts, names: Sequence[str], logs: Sequence[Log], horizon: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary keys, tables and curves of a held-out evaluation."""
    at = int(np.searchsorted(found.rows, steps_of(horizon)))
    one = int(np.searchsorted(found.rows, 1))
    each = (found.error, found.hold, found.regression)
    model, hold, regression = (_rms(x, found.valid) for x in each)
    share90 = _share(found.inside90, found.valid)
    share95 = _share(found.inside95, found.valid)
    nll = masked_mean(-found.log_prob, found.valid)

    def named(values: np.ndarray) -> dict[str, float]:
        return dict(zip(names, map(float, values), strict=True))

    summary: dict[str, Any] = {
        "horizon": horizon,
        "windows": int(found.valid[:, at].any(axis=1).sum()),
        "open_loop_rmse": named(model[at]),
        "one_step_rmse": named(model[one]),
        "nll": named(nll[at]),
        "coverage90": named(share90[at]),
        "coverage95": named(share95[at]),
        "hold_rmse": named(hold[at]),
    }
    if np.isfinite(regression[at]).all():
        summary["regression_rmse"] = named(regression[at])
    measured = found.valid[:, at].any(axis=0)
    error = np.where(measured, model[at], np.nan)
    summary["trivial"] = compare_baselines(names, error, hold[at], regression[at])
    by_log = _against_by_log(found, names, logs, at)
    summary["losses"] = loss_sentence(by_log, summary["trivial"])
    some = np.asarray(found.valid.any(axis=(0, 2)))
    curve = np.asarray([i for i in np.flatnonzero(some) if i != one or at == one])
    seconds = found.rows[curve] * PERIOD
    trivial = hold, regression
    summary["tables"] = [
        _scores_by_horizon(
            found, names, curve, seconds, model, trivial, share90, share95
        ),
        _scores_by_log(found, names, logs, at, horizon),
    ]
    arrays: dict[str, np.ndarray] = {"curve/horizon": seconds}
    for c, name in enumerate(names):
        arrays[f"curve/model/{name}"] = model[curve, c]
        arrays[f"curve/hold/{name}"] = hold[curve, c]
        arrays[f"curve/coverage90/{name}"] = share90[curve, c]
    return summary, {k: v for k, v in arrays.items() if "coverage" not in k} | {
        k.replace("curve/coverage90", "coverage90"): v
        for k, v in arrays.items()
        if "coverage" in k
    }


def _scores_by_horizon(
    found: ScoredForecasts,
    names: Sequence[str],
    curve: np.ndarray,
    seconds: np.ndarray,
    model: np.ndarray,
    trivial: tuple[np.ndarray, np.ndarray],
    share90: np.ndarray,
    share95: np.ndarray,
) -> dict[str, Any]:
    columns = ["horizon, s", "windows"]
    for name in names:
        columns += [name, f"{name}, held", f"{name}, regression"]
        columns += [f"{name} in 90 %", f"{name} in 95 %"]
    hold, regression = trivial
    rows = []
    for i, s in zip(curve, seconds, strict=True):
        row: list[Any] = [f"{s:.3g}", str(int(found.valid[:, i].any(axis=1).sum()))]
        for c in range(len(names)):
            row += [
                f"{model[i, c]:.4f}",
                f"{hold[i, c]:.4f}",
                _regression_text(regression[i, c]),
            ]
            row += [f"{share90[i, c]:.3f}", f"{share95[i, c]:.3f}"]
        rows.append(row)
    return {
        "title": "Error and coverage by horizon, pooled over logs",
        "columns": columns,
        "rows": rows,
        "note": "For each channel: the root mean square error of the model, one "
        "horizon after each start (every 0.1 s); of holding still (held); of a linear "
        "regression on start and inputs (-: too few windows to learn from); and the "
        "shares of samples inside the 90 % and the 95 % band.",
    }


def _scores_by_log(
    found: ScoredForecasts,
    names: Sequence[str],
    logs: Sequence[Log],
    at: int,
    horizon: float,
) -> dict[str, Any]:
    columns = ["log", "windows"]
    for name in names:
        columns += [name, f"{name}, held", f"{name}, regression", f"{name} in 90 %"]
    rows = []
    for k in [*range(len(logs)), None]:
        which = np.ones(len(found.log), bool) if k is None else found.log == k
        valid = found.valid[which, at]
        each = (found.error, found.hold, found.regression)
        model, hold, regression = (_rms(x[which, at], valid) for x in each)
        share = _share(found.inside90[which, at], valid)
        row = ["pooled" if k is None else logs[k].name, str(int(valid.any(1).sum()))]
        for c in range(len(names)):
            row += [
                f"{model[c]:.4f}",
                f"{hold[c]:.4f}",
                _regression_text(regression[c]),
            ]
            row.append(f"{share[c]:.3f}")
        rows.append(row)
    return {
        "title": f"Error at {horizon:g} s, log by log",
        "columns": columns,
        "rows": rows,
        "note": "The regression knows all inputs of the window. If a controller made "
        "them, they depend on the angles that are to be predicted. -: too few windows "
        "to learn from.",
    }


def _against_by_log(
    found: ScoredForecasts, names: Sequence[str], logs: Sequence[Log], at: int
) -> dict[str, dict[str, dict[str, Any]]]:
    """What `compare_baselines` finds in every log that was measured at the horizon."""
    out = {}
    for k in np.unique(found.log).tolist():
        valid = found.valid[which := found.log == k, at]
        each = (found.error, found.hold, found.regression)
        model, hold, regression = (_rms(x[which, at], valid) for x in each)
        model = np.where(valid.any(axis=0), model, np.nan)
        out[logs[k].name] = compare_baselines(names, model, hold, regression)
    return out


def _regression_text(regression: float) -> str:
    """An error of the regression, which may have had too few windows to learn from."""
    return f"{regression:.4f}" if np.isfinite(regression) else "-"


def forecast_traces(found: Forecast, band: Band, grid: Grid) -> Picture:
    """Forecasts of half a second, for pictures: (which, time, measured, mean, half)."""
    which, rows = _pictured(grid), _rows_of_traces(grid)
    shown = found.of(which).at(rows)
    half = band.half_width(0.9) * band.scale(shown)
    y = np.where(shown.valid, np.asarray(grid.windows.y)[which][:, rows], np.nan)
    time = grid.since[which][:, None] + PERIOD * rows[None]
    return {"which": (which,), "trace": (time, y, shown.mean, half)}


def trace_arrays(
    picture: Picture,
    grid: Grid,
    logs: Sequence[Log],
    names: Sequence[str],
    prefix: str = "trace",
) -> dict[str, np.ndarray]:
    """The report's ``trace/...`` arrays; windows are parted by a NaN."""
    (which,), (time, y, mean, half) = picture["which"], picture["trace"]
    arrays = {}
    for k, log in enumerate(logs):
        rows = grid.log[which] == k
        if not rows.any():
            continue
        base = f"{prefix}/{log.name}"
        arrays[f"{base}/time"] = _flat(time[rows])
        for c, name in enumerate(names):
            curves = {
                "measured": y[rows, :, c],
                "predicted": mean[rows, :, c],
                "low": (mean - half)[rows, :, c],
                "high": (mean + half)[rows, :, c],
            }
            for kind, curve in curves.items():
                arrays[f"{base}/{kind}/{name}"] = _flat(curve)
    return arrays


def _pictured(grid: Grid) -> np.ndarray:
    """Windows that follow each other without overlap and are half a second long."""
    apart = _windows_apart(grid)
    whole = np.asarray(grid.windows.mask)[apart, steps_of(TRACE)].any(axis=1)
    return apart[whole]


def thin_windows(grid: Grid) -> Grid:
    """The windows that start half a second apart."""
    return subset(grid, _windows_apart(grid))


def _windows_apart(grid: Grid) -> Int[np.ndarray, " w"]:
    """Windows of each log that start half a second apart, by number."""
    chosen = []
    for k in np.unique(grid.log):
        inside = np.flatnonzero(grid.log == k)
        closest = np.diff(grid.since[inside]).min(initial=TRACE)
        chosen.append(inside[:: max(1, round(TRACE / closest))])
    return np.concatenate(chosen)


def subset(grid: Grid, which: np.ndarray) -> Grid:
    """The evaluation windows chosen by a mask or by number."""
    return Grid(
        grid.windows.some(which),
        grid.log[which],
        grid.since[which],
        grid.lag[which],
        grid.every,
    )


def _flat(x: np.ndarray) -> np.ndarray:
    """Windows one after the other, each followed by a NaN."""
    gap = np.full((len(x), 1), np.nan)
    return np.concatenate([x, gap], axis=1).ravel()


def _rms(x: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.sqrt(masked_mean(x**2, valid))


def _share(inside: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return masked_mean(inside.astype(float), valid)
