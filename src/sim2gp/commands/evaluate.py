"""Evaluate: how well does a fit predict what it was not shown, and does it know?

A finished identification is held against other logs, or all of a project's logs but one
are fitted and that one is predicted, in turn. The protocol is that of
`sim2gp.data.grid`; the bands are those of `identification.forecasts.forecast`, fitted
to the training logs alone.
"""

import time
from collections.abc import Sequence

import numpy as np

from sim2gp.commands.evaluation import (
    Evaluation,
    check_horizon,
    evaluation_of,
    windows_for,
)
from sim2gp.commands.identification import Identification
from sim2gp.commands.leave_one_out import LeaveOneOut
from sim2gp.data.grid import CURVE, evaluation_windows
from sim2gp.data.logs import Log, note_lines, shared_rows
from sim2gp.errors import InputError, error
from sim2gp.identification.forecasts.baselines import regression_errors
from sim2gp.identification.forecasts.calibration import calibrate_forecasts
from sim2gp.identification.forecasts.prediction import (
    channels,
    forecast_grid,
    forecast_scores,
    forecast_traces,
    score_forecasts,
    scored_rows,
    trace_arrays,
)
from sim2gp.project import Project
from sim2gp.project.in_memory import Logs, as_logs, project_and_logs
from sim2gp.reports.motion import film
from sim2gp.runs import Progress
from sim2gp.runs.executors import Workers
from sim2gp.systems.base import AbstractSystem


def evaluate(
    fit: Identification | Project | AbstractSystem,
    logs: Logs | None = None,
    *,
    horizon: float = 0.2,
    workers: Workers = 1,
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
        work = LeaveOneOut(*project_and_logs(fit, logs), horizon)
        return work.run(workers, progress)
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
    summary["calibration"], shares = calibrate_forecasts(
        whole, names, tested, horizon, fit.band.inflation
    )
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
    return evaluation_of(summary, arrays, found, started, machine.scales)


def _training(fit: Identification) -> tuple[Log, ...] | None:
    """The logs that a run was fitted to, if they are still in their places."""
    try:
        return fit.training_logs()
    except InputError:
        return None
