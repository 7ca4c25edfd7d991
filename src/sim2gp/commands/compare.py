"""Compare: which model do the logs support, the simulator, a residual, a black box?

Recordings are left out in turn. A fit of the others' windows gives the simulator's
parameters, as `identify` does. Smoothed one-step data of the same logs
(`sim2gp.data.one_step_log`) then train the networks, with those parameters given. All
models forecast the recording left out, open loop, from the same causal starts: the best
single prediction, and draws for the spread.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from sim2gp.belief import AbstractModel
from sim2gp.commands.compare_setup import Setup, prepare_comparison
from sim2gp.commands.compare_summary import FoldForecasts, summarise
from sim2gp.commands.folds import recording_of_windows
from sim2gp.commands.result import AbstractResult
from sim2gp.data.logs import Log, note_lines
from sim2gp.data.one_step_log import (
    smoothed_states,
    stride_of,
    transitions,
)
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts import scoring
from sim2gp.identification.forecasts.baselines import regression_errors
from sim2gp.identification.forecasts.forecast import new_log_inflation
from sim2gp.identification.forecasts.forecast_machine import fit_forecast_machine
from sim2gp.identification.forecasts.prediction import channels, recording_names, subset
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import NLM, FunctionSpace, Residual, ResidualFunctionSpace, Sim2GP
from sim2gp.models.auto import log_scores
from sim2gp.models.ensemble import ensemble
from sim2gp.project import Project, load_project
from sim2gp.project.in_memory import Logs, project_and_logs
from sim2gp.runs import Progress
from sim2gp.runs.progress import Task
from sim2gp.runs.provenance import provenance
from sim2gp.runs.workers import in_order
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.base import AbstractSystem

HORIZONS = (0.2, 0.5)  # s
DRAWS = 32


class ModelFactory(NamedTuple):
    """How a model is made of the simulator and a reach, and what it is in words.

    With ``forces`` the simulator has those that predict recordings left out of its fit
    (`fit_forecast_machine`), if there are any.
    """

    make: Callable[[Sim2GP, dict[str, float]], AbstractModel]
    what: str
    forces: bool = False


Learners = Mapping[str, ModelFactory]
WITH_RESIDUAL = "the simulator plus a learned residual"
#: From simple to complex; each from the simulator with its parameters given.
MODELS: Learners = {
    "SIM2GP": ModelFactory(lambda sim, reach: sim, "the simulator alone"),
    "MissingForces": ModelFactory(
        lambda sim, reach: sim, "the simulator plus missing forces", forces=True
    ),
    "RES": ModelFactory(lambda sim, reach: Residual(sim, reach=reach), WITH_RESIDUAL),
    "RES-FS": ModelFactory(
        lambda sim, reach: ResidualFunctionSpace(sim, reach=reach), WITH_RESIDUAL
    ),
    "FS": ModelFactory(
        lambda sim, reach: FunctionSpace(sim, reach=reach),
        "a network that starts from the simulator",
    ),
    "NLM": ModelFactory(
        lambda sim, reach: NLM(sim.system, reach=reach),
        "a black box rather than the simulator",
    ),
}


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
    workers: int = 1,
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
    started = time.perf_counter()
    project, logs = project_and_logs(machine, logs, alike=True)
    setup, folds = prepare_comparison(project, logs, horizons)
    jobs = [
        CompareJob(project.path, logs, tuple(horizons), seed, k, left)
        for k, left in enumerate(folds)
    ]
    total = len(folds) * len(models) + 1
    with (progress or Progress()).task("compare", total) as task:
        if workers > 1 and models is MODELS and project.can_be_loaded:
            parts = _folds_in_processes(jobs, workers, task)
        else:
            parts = [_run_fold(setup, job, models, task.advance) for job in jobs]
        _, whole = _fit_without(setup, [], _fold_key(seed, len(folds)))
        task.advance("evidence")
    names = channels(project.system, setup.windows)
    units = {c.name: c.unit for c in project.system.physical_states}
    summary, arrays = summarise(
        parts,
        {name: learner.what for name, learner in models.items()},
        names,
        setup.logs,
        np.asarray(setup.steps.steps) * setup.period,
        setup.horizons,
        np.random.default_rng(seed),
        units,
    )
    summary["models"]["SIM2GP"]["log_evidence"] = float(whole.log_evidence)
    summary |= {
        "command": "compare",
        "title": f"{project.name}: which model its logs support",
        "seed": seed,
        "period": setup.period,
        "folds": len(folds),
        "n_logs": len(set(recording_names(setup.logs))),
        "n_transitions": len(setup.samples.first),
        "units": units,
    }
    summary["warnings"] += note_lines(setup.logs)
    return Comparison(summary | provenance(started), arrays)


class CompareJob(NamedTuple):
    """One fold of a comparison, as another process needs it; ``left`` are its logs."""

    path: Path
    logs: tuple[Log, ...]
    horizons: tuple[float, ...]
    seed: int
    number: int
    left: list[int]


def _folds_in_processes(
    jobs: Sequence[CompareJob], workers: int, task: Task
) -> list[FoldForecasts]:
    """The folds, computed as processes are free."""

    def done(job: CompareJob) -> None:
        task.advance(f"without {job.logs[job.left[0]].name}", len(MODELS))

    return in_order(_fold_in_process, jobs, workers, done)


def _run_fold(
    setup: Setup, job: CompareJob, models: Learners, done: Callable[[str], None]
) -> FoldForecasts:
    return compare_fold(setup, job.left, models, _fold_key(job.seed, job.number), done)


def _fold_key(seed: int, number: int) -> jax.Array:
    return jax.random.fold_in(jax.random.key(seed), number)


def _fold_in_process(job: CompareJob) -> FoldForecasts:
    """The same in a process of its own."""
    setup, _ = prepare_comparison(load_project(job.path), job.logs, job.horizons)
    return _run_fold(setup, job, MODELS, lambda done: None)


def compare_fold(
    setup: Setup,
    left: Sequence[int],
    models: Learners,
    key: jax.Array,
    done: Callable[[str], None],
) -> FoldForecasts:
    """All models without the logs ``left``, judged on them.

    What is left out is masked, not removed, so that folds share their compilations.
    """
    first, *keys = jax.random.split(key, 1 + len(models))
    likelihood, belief = _fit_without(setup, left, first)
    out = np.isin(setup.samples.step_log(), left)
    test = np.isin(setup.steps.log, left)
    tt = belief.posterior.mean
    rows = transitions(
        setup.samples, smoothed_states(setup.project.system, tt, setup.samples)
    )
    train = eqx.tree_at(lambda t: t.mask, rows, ~out)
    held = eqx.tree_at(lambda t: t.mask, rows, out)
    sims = _simulators(setup, likelihood, belief, models)
    start_sd = _start_sd(setup.grid.lag[~test])
    resolution = np.asarray(setup.windows.floor)
    training = set(recording_names(setup.logs)) - {setup.logs[k].source for k in left}
    inflation = new_log_inflation(len(training))
    error, sd, steps = [], [], []
    for (name, learner), key in zip(models.items(), keys, strict=True):
        begin, learn, roll = jax.random.split(key, 3)
        model = learner.make(sims[learner.forces], setup.reach)
        fitted = model.fit(model.init(begin), train, key=learn)
        found = ensemble(fitted, setup.steps, start_sd, draws=DRAWS, key=roll)
        off = found.point - setup.steps.y
        if found.finite():
            counts = setup.steps.valid & ~test[:, None, None]
            wide = scoring.predicted_spread(
                off, found.draws, counts, resolution, inflation
            )
        else:  # an infinite error: such a model loses, and has no numbers
            off, wide = np.full_like(off, math.inf), np.ones_like(off)
        error.append(off[test])
        sd.append(wide[test])
        steps.append(float(np.mean(np.asarray(log_scores(fitted, held))[out])))
        done(f"{name} without {setup.logs[left[0]].name}")
    return FoldForecasts(
        np.stack(error),
        np.stack(sd),
        _trivial(setup, test),
        setup.steps.valid[test],
        setup.steps.log[test],
        setup.grid.since[test],
        np.asarray(steps),
        held.count,
    )


def _trivial(setup: Setup, test: np.ndarray) -> np.ndarray:
    """Errors of the start held and of the linear regression, as `Held.trivial`."""
    train, tested = subset(setup.grid, ~test), subset(setup.grid, test)
    rows = stride_of(setup.period) * np.asarray(setup.steps.steps)
    start = np.asarray(tested.windows.start)[:, list(setup.steps.outputs)]
    hold = start[:, None] - setup.steps.y[test]
    return np.stack([hold, regression_errors(train, tested, rows)])


def _simulators(
    setup: Setup, likelihood: WindowsLikelihood, fit: Estimate, models: Learners
) -> dict[bool, Sim2GP]:
    """Without missing forces, and with them if a model asks for these."""
    sims = {False: _simulator(setup, setup.project.system, fit.posterior)}
    if any(learner.forces for learner in models.values()):
        known = fit.with_measurements(setup.project.system.parameters)
        recording = recording_of_windows(setup.logs, setup.of)
        robust = setup.project.spec.likelihood.robust
        start = at_zero(likelihood, known)
        wider = fit_forecast_machine(start, recording, robust=robust)
        sims[True] = _simulator(setup, wider.system, wider.posterior)
    return sims


def _simulator(setup: Setup, system: AbstractSystem, known: Gaussian) -> Sim2GP:
    """In steps of the comparison, its parameters given."""
    stepper = carrying_inputs(system, setup.period)
    return Sim2GP(stepper, dt=setup.period, prior=known, frozen=True)


def _fit_without(
    setup: Setup, left: Sequence[int], key: jax.Array
) -> tuple[WindowsLikelihood, Estimate]:
    """The simulator's parameters from the windows of all logs but ``left``."""
    mask = np.asarray(setup.windows.mask) & ~np.isin(setup.of, left)[:, None, None]
    kept = eqx.tree_at(lambda w: w.mask, setup.windows, mask)
    robust = setup.project.spec.likelihood.robust
    system = setup.project.system
    # One start: the folds are small changes of one problem, and share a compilation.
    found = fit_windows(system, kept, key=key, robust=robust, starts=1)
    return WindowsLikelihood(system, kept), found


def _start_sd(lag: np.ndarray) -> np.ndarray:
    """How far causal starts are off, as a root mean square over windows."""
    known = np.isfinite(lag)
    squares = np.sum(np.where(known, lag, 0.0) ** 2, axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(known.sum(axis=0), 1)))
