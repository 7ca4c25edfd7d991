"""Evaluate: how well does a fit predict what it was not shown, and does it know?

A finished identification is held against other logs, or all of a project's logs but one
are fitted and that one is predicted, in turn. The protocol is that of
`sim2gp.data.grid`; the bands are those of `identification.forecasts.forecast`, fitted
to the training logs alone.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sim2gp.commands.folds import fit_fold, leave_out
from sim2gp.commands.identification import Identification
from sim2gp.commands.result import AbstractResult, numeric_entries
from sim2gp.data.grid import CURVE, Grid, evaluation_windows, steps_of
from sim2gp.data.logs import Log, Note, note_lines, shared_rows
from sim2gp.data.windows import Windows
from sim2gp.errors import InputError, error
from sim2gp.identification.forecasts.baselines import (
    forecast_sentence,
    regression_errors,
)
from sim2gp.identification.forecasts.calibration import calibrate_forecasts
from sim2gp.identification.forecasts.forecast_machine import (
    forces_sentence,
    forces_table,
)
from sim2gp.identification.forecasts.prediction import (
    ScoredForecasts,
    channel_units,
    channels,
    forecast_grid,
    forecast_scores,
    forecast_traces,
    join_folds,
    recording_names,
    score_forecasts,
    scored_rows,
    trace_arrays,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.project import Project, load_project
from sim2gp.project.in_memory import Logs, as_logs, project_and_logs
from sim2gp.project.training_windows import cut_logs
from sim2gp.reports.motion import film
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.runs.workers import in_order
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import in_float64


@dataclass(frozen=True, repr=False)
class Evaluation(AbstractResult):
    """How well logs were forecast that a fit had not seen, at one horizon (s)."""

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square error of open-loop forecasts, by channel in its unit."""
        return numeric_entries(self.summary["open_loop_rmse"])

    @property
    def hold_rmse(self) -> dict[str, float]:
        """The same of the measured start, predicted to stay."""
        return numeric_entries(self.summary["hold_rmse"])

    @property
    def regression_rmse(self) -> dict[str, float]:
        """The same of a linear regression; empty if it had too few windows."""
        return numeric_entries(self.summary.get("regression_rmse"))

    @property
    def coverage90(self) -> dict[str, float]:
        """The share of samples inside 90 % bands, by channel."""
        return numeric_entries(self.summary["coverage90"])


def evaluate(
    fit: Identification | Project | AbstractSystem,
    logs: Logs | None = None,
    *,
    horizon: float = 0.2,
    workers: int = 1,
    progress: Progress | None = None,
) -> Evaluation:
    """Open-loop forecasts over ``horizon`` s of logs that a fit has not seen.

    Of an identification the ``logs`` are forecast. Of a project, or of a machine and
    its logs, all recordings but one are fitted and that one is forecast, in turn; of a
    project file in so many processes, ``workers``, with the same result.
    Raises `InputError` E116 where no log is as long as the horizon, E160.
    """
    check_horizon(horizon)
    progress = progress or Progress()
    if not isinstance(fit, Identification):
        found = project_and_logs(fit, logs)
        return _leave_one_out(*found, horizon, workers, progress)
    if logs is None:
        got = "an identification alone"
        raise error("no_logs_to_evaluate", where="logs", got=got)
    assert fit.project is not None
    return _forecast_logs(fit, as_logs(fit.project, logs), horizon, progress)


def _forecast_logs(
    fit: Identification, tested: Sequence[Log], horizon: float, progress: Progress
) -> Evaluation:
    """Logs predicted by a fit of others."""
    started = time.perf_counter()
    found = fit.project
    assert found is not None
    machine = fit.forecast_machine
    system = machine.system
    with progress.task("evaluate", 1) as task:
        rows, longest = scored_rows(horizon), max(horizon, CURVE[-1])
        grid = windows_for(tested, found, longest, horizon)
        result = forecast_grid(system, machine.posterior, grid, horizon)
        train = _training(fit)
        linear = np.full((len(grid.windows), len(rows), len(result.mean[0, 0])), np.nan)
        if train is not None:
            known = evaluation_windows(train, system, longest=longest)
            linear = regression_errors(known, grid, rows)
        task.advance("forecasts")
    names = channels(system, grid.windows)
    whole = score_forecasts(rows, grid, result, fit.band, linear)
    summary, arrays = forecast_scores(whole, names, tested, horizon)
    summary["calibration"], shares = calibrate_forecasts(whole, names, tested, horizon)
    picture = forecast_traces(result, fit.band, grid)
    arrays |= shares | trace_arrays(picture, grid, tested, names)
    notes = note_lines(tested, shared_rows(train or (), tested))
    if train is None:
        notes.append("the training logs were not found: no regression to compare")
    title = "Forecasts over what was recorded"
    about, moves = film(system, machine.posterior, picture, grid, tested, title)
    if machine.scales:
        summary["forecast_forces"] = dict(machine.scales)
    if about:
        summary["animation"] = about
        arrays |= moves
    summary |= {
        "command": "evaluate",
        "title": f"{fit.name}: prediction of logs it was not fitted to",
        "warnings": notes,
    }
    return _evaluation(summary, arrays, found, started, machine.scales)


class Cut(NamedTuple):
    """What all folds share: windows to fit, the log of each, windows to forecast."""

    windows: Windows
    of: np.ndarray
    grid: Grid


class EvaluateJob(NamedTuple):
    """One fold of a leave-one-out, as another process needs it."""

    path: Path
    logs: tuple[Log, ...]
    horizon: float
    left: tuple[int, ...]


class FoldResult(NamedTuple):
    """Forecasts and traces of a fold, its parameters and the scales of its forces."""

    judged: ScoredForecasts
    traced: dict[str, np.ndarray]
    constants: np.ndarray
    scales: dict[str, float]


def _leave_one_out(
    project: Project,
    logs: tuple[Log, ...],
    horizon: float,
    workers: int,
    progress: Progress,
) -> Evaluation:
    """Each recording predicted by a fit of the others."""
    started = time.perf_counter()
    files = list(dict.fromkeys(recording_names(logs)))
    if len(files) < 2:
        where, got = project.source.where("logs"), f"{len(files)} file"
        raise error("one_recording", where=where, got=got)
    of_file = (
        tuple(k for k, source in enumerate(recording_names(logs)) if source == file)
        for file in files
    )
    jobs = [EvaluateJob(project.path, logs, horizon, left) for left in of_file]
    apart = workers if project.can_be_loaded else 1
    cut = _cut_for_fold(project, jobs[0])
    work = _forecast_in_process if apart > 1 else partial(_forecast_fold, project, cut)
    with progress.task("logs", len(jobs)) as task:
        found = in_order(
            work,
            jobs,
            apart,
            lambda job: task.advance(f"without {logs[job.left[0]].name}"),
        )
    parts, traced, constants, scales = zip(*found, strict=True)
    arrays: dict[str, np.ndarray] = {}
    for each in traced:
        arrays |= each
    names = channels(project.system, cut.windows)
    whole = join_folds(list(parts))
    summary, curves = forecast_scores(whole, names, logs, horizon)
    summary["calibration"], shares = calibrate_forecasts(whole, names, logs, horizon)
    arrays |= shares
    names_of = {log.source: log.name for log in logs}
    left = [names_of[file] for file in files]
    summary["tables"].append(_constants_table(project, left, list(constants)))
    forces = dict(zip(left, scales, strict=True))
    if any(scales):
        summary["tables"].append(forces_table(forces))
        summary["forecast_forces"] = forces
    summary |= {
        "command": "evaluate",
        "title": f"{project.name}: each log predicted by a fit of the others",
        "folds": len(files),
        "warnings": note_lines(logs, _repeated(logs, files)),
    }
    kinds = [kind for each in scales for kind in each]
    return _evaluation(summary, curves | arrays, project, started, kinds)


def _cut_for_fold(project: Project, job: EvaluateJob) -> Cut:
    windows, of = cut_logs(project, job.logs)
    longest = max(job.horizon, CURVE[-1])
    return Cut(windows, of, windows_for(job.logs, project, longest, job.horizon))


def _forecast_fold(project: Project, cut: Cut, job: EvaluateJob) -> FoldResult:
    """Of the fit without the logs ``job.left``."""
    windows, of, grid = cut
    part = leave_out(job.left, job.logs, of, grid)
    # One start: the folds are small changes of one problem.
    key = jax.random.key(0)
    found = fit_fold(project, windows, grid, part, job.horizon, key=key, starts=1)
    picture = forecast_traces(found.forecast, found.band, found.tested)
    names = channels(project.system, windows)
    traced = trace_arrays(picture, found.tested, job.logs, names)
    constants = _constrain(project.system, found.posterior)
    return FoldResult(found.judged, traced, constants, dict(found.machine.scales))


def _forecast_in_process(job: EvaluateJob) -> FoldResult:
    """The same in a process of its own."""
    project = load_project(job.path)
    return _forecast_fold(project, _cut_for_fold(project, job), job)


@in_float64
def _constrain(system: Any, posterior: Gaussian) -> np.ndarray:
    return np.asarray(system.parameters.constrain(posterior.mean))


def _constants_table(
    project: Project, left: Sequence[str], values: list[np.ndarray]
) -> dict[str, Any]:
    """The parameters of every fold: one that moves between folds is not determined."""
    return {
        "title": "Parameters of each fit (most probable values)",
        "columns": ["without", *project.system.parameters.names],
        "rows": [
            [name, *(f"{x:.3g}" for x in row)]
            for name, row in zip(left, values, strict=True)
        ],
        "note": "One log fewer should not move a parameter that the logs determine.",
    }


def windows_for(
    logs: Sequence[Log], project: Project, longest: float, horizon: float
) -> Grid:
    """Evaluation windows; E116 where no log is as long as the horizon."""
    if max(log.duration for log in logs) > horizon + CURVE[0]:
        grid = evaluation_windows(logs, project.system, longest=longest)
        if np.asarray(grid.windows.mask)[:, steps_of(horizon)].any():
            return grid
    got = f"{max(log.duration for log in logs):.3g} s"
    raise error("no_window_to_predict", got=got, horizon=f"{horizon:g}")


def _repeated(logs: Sequence[Log], files: Sequence[str]) -> list[Note]:
    """Rows that a fold both learns from and is judged by (W128)."""
    sets = [[log for log in logs if log.source == file] for file in files]
    notes: list[Note] = []
    for i, tested in enumerate(sets):
        others = [log for group in sets[:i] + sets[i + 1 :] for log in group]
        notes += shared_rows(others, tested)
    return notes


def _training(fit: Identification) -> tuple[Log, ...] | None:
    """The logs that a run was fitted to, if they are still in their places."""
    try:
        return fit.training_logs()
    except InputError:
        return None


def check_horizon(horizon: float) -> None:
    """E160 for a horizon that is not some seconds."""
    if not 0.0 < horizon <= 60.0:
        raise error("horizon_out_of_range", where="--horizon", got=f"{horizon:g} s")


def _evaluation(
    summary: dict[str, Any],
    arrays: dict[str, np.ndarray],
    project: Project,
    started: float,
    kinds: Iterable[str],
) -> Evaluation:
    """The result with its headline; forecasts have missing forces of these kinds."""
    unit = channel_units(project.system)
    summary["headline"] = forecast_sentence(
        f"Open-loop error at {summary['horizon']:g} s",
        summary["open_loop_rmse"],
        summary["trivial"],
        unit,
        summary["coverage90"],
    )
    if summary["losses"]:
        summary["headline"] += f" {summary['losses']}"
    summary["headline"] += forces_sentence(kinds)
    summary["units"] = unit
    summary["trace_note"] = (
        "Forecasts of half a second from causal starts, of logs that the fit has not "
        "seen; they know the recorded inputs and nothing else of the future."
    )
    return Evaluation(summary | provenance(started), arrays)
