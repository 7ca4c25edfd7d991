"""Compare: which model do the logs support, the simulator, a residual, a black box?

Recordings are left out in turn. A fit of the others' windows gives the simulator's
parameters, as `identify` does. Smoothed one-step data of the same logs
(`sim2gp.data.one_step_log`) then train the networks, with those parameters given. All
models forecast the recording left out, open loop, from the same causal starts: the best
single prediction, and draws for the spread.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from sim2gp.commands.compare_folds import (
    HORIZONS,
    MODELS,
    Learners,
    ModelCell,
    fit_without,
    fold_key,
    prepared,
    trivial_errors,
)
from sim2gp.commands.compare_setup import check_measured
from sim2gp.commands.compare_summary import FoldForecasts, summarise
from sim2gp.commands.evaluation import check_horizon
from sim2gp.commands.recordings import AbstractFolds, Recordings
from sim2gp.commands.result import AbstractResult
from sim2gp.commands.window_length import chosen_window
from sim2gp.data.logs import Log, note_lines
from sim2gp.identification.forecasts.prediction import channels, recording_names
from sim2gp.project import Project
from sim2gp.project.in_memory import Logs, project_and_logs
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.runs.executors import Workers
from sim2gp.runs.plain import from_exact
from sim2gp.runs.progress import Task
from sim2gp.runs.provenance import provenance
from sim2gp.systems.base import AbstractSystem


@dataclass(frozen=True, repr=False)
class Comparison(AbstractResult):
    """Which model predicts recordings that it has not seen."""

    @property
    def best(self) -> str:
        """The model that the logs support."""
        return str(self.summary["best"])

    @property
    def models(self) -> dict[str, dict[str, Any]]:
        """Of each model its held-out errors and log density, as in ``summary.json``."""
        return dict(self.summary["models"])


def compare(
    machine: Project | AbstractSystem,
    logs: Logs | None = None,
    *,
    horizons: Sequence[float] = HORIZONS,
    models: Learners = MODELS,
    seed: int = 0,
    workers: Workers = 1,
    progress: Progress | None = None,
) -> Comparison:
    """Fit, train and judge all models fold by fold, at open-loop ``horizons`` in s.

    ``logs`` None are the project's own. ``models`` are given from simple to complex,
    the simulator first; ``seed`` draws networks and forecasts. Of a project file the
    folds go to so many processes, ``workers``; networks then differ by the rounding of
    their sums, which depends on the cores of a process.

    Raises `InputError` E103 for a position that no log measures, E116 for too short
    logs, E160 for several configurations.
    """
    work = CompareWork(
        *project_and_logs(machine, logs, alike=True),
        horizons=tuple(horizons),
        models=models,
        seed=seed,
    )
    return work.run(workers, progress)


class CompareWork(AbstractFolds[Comparison]):
    """A cell for each model without each group of logs; a comparison, of their values.

    Raises what `prepare_comparison` raises, E103, and E160 for a horizon.
    """

    title, after = "compare", 1

    def __init__(
        self,
        project: Project,
        logs: tuple[Log, ...],
        *,
        horizons: tuple[float, ...] = HORIZONS,
        models: Learners = MODELS,
        seed: int = 0,
    ) -> None:
        self.started, self.models, self.seed = time.perf_counter(), models, seed
        for horizon in horizons:
            check_horizon(horizon)
        check_measured(logs, project)
        project = chosen_window(project, logs, key=jax.random.key(seed))
        self.recordings = Recordings(project, logs)
        self.setup, self.folds = prepared(self.recordings, horizons)
        self.alone = models is not MODELS
        about = self.recordings, horizons, seed
        own = models if self.alone else None
        self.cells = [
            ModelCell(*about, number, tuple(left), name, own)
            for number, left in enumerate(self.folds)
            for name in models
        ]

    def result(self, values: Mapping[AbstractCell, Values], task: Task) -> Comparison:
        """Of the values of all cells; a fit of all logs gives the evidence."""
        setup, seed = self.setup, self.seed
        _, whole = fit_without(setup, [], fold_key(seed, len(self.folds)))
        task.advance("evidence")
        units = {c.name: c.unit for c in setup.project.system.physical_states}
        summary, arrays = summarise(
            self._forecasts([from_exact(values[cell]) for cell in self.cells]),
            {name: learner.what for name, learner in self.models.items()},
            channels(setup.project.system, setup.windows),
            setup.logs,
            np.asarray(setup.steps.steps) * setup.period,
            setup.horizons,
            np.random.default_rng(seed),
            units,
        )
        summary["models"]["SIM2GP"]["log_evidence"] = float(whole.log_evidence)
        summary |= {
            "command": "compare",
            "title": f"{setup.project.name}: which model its logs support",
            "seed": seed,
            "period": setup.period,
            "folds": len(self.folds),
            "n_logs": len(set(recording_names(setup.logs))),
            "n_transitions": len(setup.samples.first),
            "units": units,
        }
        summary["warnings"] += note_lines(setup.logs)
        return Comparison(summary | provenance(self.started), arrays)

    def _forecasts(self, found: Sequence[Values]) -> list[FoldForecasts]:
        """Those of all models, fold by fold."""
        setup, count = self.setup, len(self.models)
        parts = []
        for number, left in enumerate(self.folds):
            test = np.isin(setup.steps.log, left)
            each = found[number * count : (number + 1) * count]
            parts.append(
                FoldForecasts(
                    np.stack([one["error"] for one in each]),
                    np.stack([one["sd"] for one in each]),
                    trivial_errors(setup, test),
                    setup.steps.valid[test],
                    setup.steps.log[test],
                    setup.grid.since[test],
                    np.asarray([one["step_score"] for one in each]),
                    int(np.isin(setup.samples.step_log(), left).sum()),
                )
            )
        return parts
