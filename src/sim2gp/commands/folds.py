"""A fit of some of the windows, held against data that it has not seen.

`evaluate` leaves one recording out after the other; `identify` leaves out one, so that
its report can show forecasts of data that no parameter was fitted to. Windows are
masked, not removed: fits of all and of some share one compilation.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Int

from sim2gp.data.cuts import Cuts
from sim2gp.data.grid import CURVE, PERIOD, Grid, steps_of
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import likelihood_of
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts.baselines import regression_errors
from sim2gp.identification.forecasts.forecast import Band, Forecast, fit_band
from sim2gp.identification.forecasts.forecast_machine import (
    ForecastMachine,
    fit_forecast_machine,
)
from sim2gp.identification.forecasts.prediction import (
    ScoredForecasts,
    forecast_grid,
    recording_names,
    score_forecasts,
    scored_rows,
    subset,
)
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.project import Project
from sim2gp.types import Key

LAST = 0.25  # of a single recording, the share at its end that is held out


class Part(NamedTuple):
    """What a fit may see, and what it is judged by; of training and forecast windows.

    ``recording`` numbers those of the training windows. The band is made of the windows
    ``known`` up to ``until`` (s, on the log's clock), which lie in ``recordings``
    recordings.
    """

    train: Bool[np.ndarray, " W"]
    known: Bool[np.ndarray, " V"]
    test: Bool[np.ndarray, " V"]
    recording: Int[np.ndarray, " W"]
    recordings: int
    words: str
    until: float = math.inf


class Fold(NamedTuple):
    """A fit of a part of the windows and its forecasts of the others."""

    posterior: Gaussian  # of the parameters, without missing forces
    machine: ForecastMachine
    band: Band
    judged: ScoredForecasts
    tested: Grid
    forecast: Forecast  # of what is tested


def leave_out(
    left: Sequence[int], logs: Sequence[Log], of: np.ndarray, grid: Grid
) -> Part:
    """All but the logs with these indices."""
    test = np.isin(grid.log, left)
    others = {log.source for k, log in enumerate(logs) if k not in left}
    words = f"the log {logs[left[0]].name}"
    recording = recording_of_windows(logs, of)
    return Part(~np.isin(of, left), ~test, test, recording, len(others), words)


def recording_of_windows(
    logs: Sequence[Log], of: Int[np.ndarray, " W"]
) -> Int[np.ndarray, " W"]:
    """The number of each window's recording, from that of its log."""
    files = recording_names(logs)
    return np.asarray([files.index(source) for source in files])[of]


def split_held_out(
    logs: Sequence[Log],
    windows: Windows | Cuts,
    places: Int[np.ndarray, "W 2"],
    grid: Grid,
) -> Part | None:
    """The last recording, or the last quarter of the only one; None if too short."""
    files, of = recording_names(logs), places[:, 0]
    if len(set(files)) > 1:
        last = [k for k, source in enumerate(files) if source == files[-1]]
        found = leave_out(last, logs, of, grid)
    else:
        first, end = float(logs[0].time[0]), float(logs[-1].time[-1])
        split = end - LAST * (end - first)
        since = np.asarray([logs[k].time[row] for k, row in places])
        train = since + windows.seconds <= split
        known, test = grid.since + CURVE[0] <= split, grid.since >= split
        words = f"the last {100 * LAST:.0f} % of the log {logs[0].name}"
        recording = recording_of_windows(logs, of)
        found = Part(train, known, test, recording, 1, words, split)
    seen = windows.counts[found.train].any()
    judged_by = np.asarray(grid.windows.mask)[
        found.test, scored_rows(CURVE[0])[0]
    ].any()
    return found if seen and found.known.any() and judged_by else None


def fit_fold(
    project: Project,
    windows: Windows | Cuts,
    grid: Grid,
    part: Part,
    horizon: float,
    *,
    key: Key,
    starts: int,
    warm_start: Estimate | None = None,
) -> Fold:
    """The fit of what ``part`` may see, begun at ``warm_start``, judged by the rest.

    Forecasts have the missing forces that predict recordings left out of the fit.
    Raises as `sim2gp.identification.fit.fit_windows` does.
    """
    rows = scored_rows(horizon)
    kept = windows.masked(part.train)
    robust = project.spec.likelihood.robust
    fitted = fit_windows(
        project.system,
        kept,
        key=key,
        robust=robust,
        starts=starts,
        warm_start=warm_start,
    )
    known = fitted.with_measurements(project.system.parameters)
    start = at_zero(likelihood_of(project.system, kept), known, part.recording)
    machine = fit_forecast_machine(start, part.recording, robust=robust)
    result = forecast_grid(machine.system, machine.posterior, grid, horizon)
    train, tested = subset(grid, part.known), subset(grid, part.test)
    curve = np.asarray([steps_of(h) for h in CURVE])
    before = train.since[:, None] + PERIOD * curve <= part.until
    seen = result.of(part.known).at(curve)
    seen = eqx.tree_at(lambda f: f.valid, seen, seen.valid & before[..., None])
    band = fit_band(seen, train, part.recordings)
    linear = regression_errors(train, tested, rows)
    result = result.of(part.test)
    found = score_forecasts(rows, tested, result, band, linear)
    return Fold(fitted.posterior, machine, band, found, tested, result)
