"""Each recording of a project predicted by a fit of the others: a cell each."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from sim2gp.commands.evaluation import (
    Evaluation,
    check_horizon,
    evaluation_of,
    windows_for,
)
from sim2gp.commands.folds import fit_fold, leave_out
from sim2gp.commands.recordings import AbstractFolds, Recordings
from sim2gp.commands.window_length import chosen_window
from sim2gp.data.grid import CURVE, Grid
from sim2gp.data.logs import Log, Note, note_lines, shared_rows
from sim2gp.data.windows import Windows
from sim2gp.errors import error
from sim2gp.identification.forecasts.calibration import calibrate_forecasts
from sim2gp.identification.forecasts.forecast import new_log_inflation
from sim2gp.identification.forecasts.forecast_machine import forces_table
from sim2gp.identification.forecasts.prediction import (
    ScoredForecasts,
    channels,
    forecast_scores,
    forecast_traces,
    join_folds,
    recording_names,
    trace_arrays,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.project import Project
from sim2gp.project.training_windows import cut_logs
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.runs.plain import exact, from_exact
from sim2gp.runs.progress import Task
from sim2gp.types import in_float64


class Cut(NamedTuple):
    """What all folds share: windows to fit, the log of each, windows to forecast."""

    windows: Windows
    of: np.ndarray
    grid: Grid


class LeaveOneOut(AbstractFolds[Evaluation]):
    """Of each file of logs a cell; their values are an evaluation.

    Raises `InputError` E160 where there is only one, and E116 where none is as long as
    ``horizon``, in s.
    """

    title = "logs"

    def __init__(self, project: Project, logs: tuple[Log, ...], horizon: float) -> None:
        check_horizon(horizon)
        self.started, self.horizon = time.perf_counter(), horizon
        names = recording_names(logs)
        self.files = list(dict.fromkeys(names))
        if len(self.files) < 2:
            where, got = project.source.where("logs"), f"{len(self.files)} file"
            raise error("one_recording", where=where, got=got)
        project = chosen_window(project, logs, key=jax.random.key(0))
        self.recordings = Recordings(project, logs)
        self.cut = _cut_for_folds(self.recordings, horizon)
        self.cells = [
            FoldCell(self.recordings, horizon, places_of(file, names))
            for file in self.files
        ]

    def result(self, values: Mapping[AbstractCell, Values], task: Task) -> Evaluation:
        """Of the values of all cells."""
        del task
        project, logs = self.recordings.project, self.recordings.logs
        folds = [from_exact(values[cell]) for cell in self.cells]
        parts = [ScoredForecasts(**fold["judged"]) for fold in folds]
        names = channels(project.system, self.cut.windows)
        whole = join_folds(parts)
        summary, arrays = forecast_scores(whole, names, logs, self.horizon)
        summary["calibration"], shares = calibrate_forecasts(
            whole, names, logs, self.horizon, new_log_inflation(len(self.files) - 1)
        )
        for fold in folds:
            arrays |= fold["traced"]
        names_of = {log.source: log.name for log in logs}
        left = [names_of[file] for file in self.files]
        constants = [fold["constants"] for fold in folds]
        summary["tables"].append(_constants_table(project, left, constants))
        forces = {name: fold["scales"] for name, fold in zip(left, folds, strict=True)}
        if any(forces.values()):
            summary["tables"].append(forces_table(forces))
            summary["forecast_forces"] = forces
        summary |= {
            "command": "evaluate",
            "title": f"{project.name}: each log predicted by a fit of the others",
            "folds": len(self.files),
            "warnings": note_lines(logs, _repeated(logs, self.files)),
        }
        kinds = [kind for scales in forces.values() for kind in scales]
        return evaluation_of(summary, arrays | shares, project, self.started, kinds)


def places_of(file: str, names: Sequence[str]) -> tuple[int, ...]:
    """The logs that are pieces of a file."""
    return tuple(k for k, name in enumerate(names) if name == file)


def _cut_for_folds(recordings: Recordings, horizon: float) -> Cut:
    project, logs = recordings.project, recordings.logs

    def cut() -> Cut:
        grid = windows_for(logs, project, max(horizon, CURVE[-1]), horizon)
        return Cut(*cut_logs(project, logs), grid)

    return recordings.kept("cut", horizon, cut)


@dataclass(frozen=True, eq=False)
class FoldCell(AbstractCell):
    """The logs ``left`` predicted by a fit of the others."""

    recordings: Recordings
    horizon: float
    left: tuple[int, ...]

    @property
    def name(self) -> str:
        """By the first log that it leaves out."""
        return f"without_{self.left[0]}"

    @property
    def note(self) -> str:
        """What is left out."""
        return self.recordings.without(self.left)

    @property
    def arguments(self) -> Values:
        """The project and its logs, by their digest."""
        about = {"recordings": self.recordings.digest, "horizon": self.horizon}
        return about | {"left": list(self.left)}

    def compute(self, needed: Values | None) -> Values:
        """Forecasts and traces, the parameters, and the scales of missing forces."""
        del needed
        project, logs = self.recordings.project, self.recordings.logs
        windows, of, grid = _cut_for_folds(self.recordings, self.horizon)
        part = leave_out(self.left, logs, of, grid)
        # One start: the folds are small changes of one problem.
        key = jax.random.key(0)
        found = fit_fold(project, windows, grid, part, self.horizon, key=key, starts=1)
        picture = forecast_traces(found.forecast, found.band, found.tested)
        names = channels(project.system, windows)
        return exact(
            {
                "judged": vars(found.judged),
                "traced": trace_arrays(picture, found.tested, logs, names),
                "constants": _constrain(project.system, found.posterior),
                "scales": dict(found.machine.scales),
            }
        )


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


def _repeated(logs: Sequence[Log], files: Sequence[str]) -> list[Note]:
    """Rows that a fold both learns from and is judged by (W128)."""
    sets = [[log for log in logs if log.source == file] for file in files]
    notes: list[Note] = []
    for i, tested in enumerate(sets):
        others = [log for group in sets[:i] + sets[i + 1 :] for log in group]
        notes += shared_rows(others, tested)
    return notes
