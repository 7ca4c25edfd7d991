"""Compare: which model do the logs support, the simulator, a residual, a black box?

Recordings are left out in turn. A fit of the others' windows gives the simulator's
constants, as `identify` does; smoothed one-step data of the same logs
(`sim2gp.data.one_step_log`) then train what is learned beside it, with those constants
given. All models forecast the recording left out, open loop, from the same causal
starts: the best single prediction, and draws for the spread.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from sim2gp.belief import AbstractModel
from sim2gp.commands.compare_summary import Held, summarise
from sim2gp.commands.evaluate import check_horizon, windows_for
from sim2gp.commands.result import AbstractResult
from sim2gp.data.grid import CURVE, PERIOD, Grid
from sim2gp.data.logs import Log, note_lines
from sim2gp.data.one_step_log import (
    Samples,
    Steps,
    samples_of,
    smoothed_states,
    steps_of_grid,
    stride_of,
    transitions,
)
from sim2gp.data.split_log import measured_states
from sim2gp.data.windows import Windows
from sim2gp.errors import InputError
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts import scoring
from sim2gp.identification.forecasts.baselines import regression_errors
from sim2gp.identification.forecasts.forecast import inflation_of
from sim2gp.identification.forecasts.prediction import channels, recordings, subset
from sim2gp.inference.estimate import Estimate
from sim2gp.models import NLM, FunctionSpace, Residual, ResidualFunctionSpace, Sim2GP
from sim2gp.models.auto import log_scores
from sim2gp.models.ensemble import ensemble
from sim2gp.project import Project
from sim2gp.project.in_memory import Logs, project_and_logs
from sim2gp.project.training_windows import cut_logs
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.base import AbstractSystem

HORIZONS = (0.2, 0.5)  # s
STEP = 0.02  # s, the period of one-step models where the log's own is shorter
DRAWS = 32
MOST_FOLDS = 6  # more recordings are left out in groups
LAST = 0.25  # of a single recording is left out
REACH = 1.2  # half-width of a state without limits, in the largest seen


class Learner(NamedTuple):
    """How a model is made of the simulator and a reach, and what it is in words."""

    make: Callable[[Sim2GP, dict[str, float]], AbstractModel]
    what: str


Learners = Mapping[str, Learner]
WITH_RESIDUAL = "the simulator plus a learned residual"
#: From simple to complex; each from the simulator with its constants given.
MODELS: Learners = {
    "SIM2GP": Learner(lambda sim, reach: sim, "the simulator alone"),
    "RES": Learner(lambda sim, reach: Residual(sim, reach=reach), WITH_RESIDUAL),
    "RES-FS": Learner(
        lambda sim, reach: ResidualFunctionSpace(sim, reach=reach), WITH_RESIDUAL
    ),
    "FS": Learner(
        lambda sim, reach: FunctionSpace(sim, reach=reach),
        "a network that starts from the simulator",
    ),
    "NLM": Learner(
        lambda sim, reach: NLM(sim.system, reach=reach),
        "a black box rather than the simulator",
    ),
}


@dataclass(frozen=True)
class Setup:
    """Everything of a comparison that is the same in all folds."""

    project: Project
    logs: tuple[Log, ...]
    windows: Windows  # to fit the simulator
    of: np.ndarray  # log of each of these
    grid: Grid
    stepper: AbstractSystem
    period: float
    samples: Samples  # to train what is learned
    steps: Steps  # to be judged by
    horizons: tuple[float, ...]  # s, in whole periods
    reach: dict[str, float]


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
    progress: Progress | None = None,
) -> Comparison:
    """Fit, train and judge all models fold by fold, at open-loop ``horizons`` in s.

    ``logs`` None are the project's own. ``models`` are given from simple to complex,
    the simulator first; ``seed`` draws networks and forecasts. Raises `InputError` E103
    for a position that no log measures, E116 for too short logs, E160 for several
    configurations.
    """
    started = time.perf_counter()
    for horizon in horizons:
        check_horizon(horizon)
    project, logs = project_and_logs(machine, logs, alike=True)
    setup, folds = prepare(project, logs, horizons)
    total = len(folds) * len(models) + 1
    with (progress or Progress()).task("compare", total) as task:
        key = jax.random.key(seed)
        parts = []
        for number, left in enumerate(folds):
            fold_key = jax.random.fold_in(key, number)
            parts.append(fold(setup, left, models, fold_key, task.advance))
        whole = _fit(setup, [], jax.random.fold_in(key, len(folds)))
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
        "n_logs": len(set(recordings(setup.logs))),
        "n_transitions": len(setup.samples.first),
        "units": units,
    }
    summary["warnings"] += note_lines(setup.logs)
    return Comparison(summary | provenance(started), arrays)


def prepare(
    project: Project, logs: Sequence[Log], horizons: Sequence[float]
) -> tuple[Setup, list[list[int]]]:
    """Windows, one-step data and folds (each the indices of the logs left out)."""
    system = project.system
    logs, folds = _folds(logs)
    _check_measured(logs, system, project)
    recorded = float(np.median([log.period for log in logs]))
    period = PERIOD * stride_of(max(recorded, STEP))
    horizons = [period * max(1, round(h / period)) for h in sorted(set(horizons))]
    longest = max(horizons)
    grid = windows_for(logs, project, longest, longest)
    windows, of = cut_logs(project, logs)
    stepper = carrying_inputs(system, period)
    samples = samples_of(logs, stepper, period)
    row_log = samples.step_log()
    curve = {round(h / period) for h in (*horizons, *CURVE) if h <= longest + 1e-9}
    steps = steps_of_grid(grid, logs, stepper, period, sorted(curve - {0}))
    for left in folds:
        trained = int(np.sum(~np.isin(row_log, left)))
        tested = int(np.sum(steps.valid[np.isin(steps.log, left)][:, -1]))
        if not trained or not tested:
            raise InputError(
                "E116",
                "nothing to learn from or to predict",
                where=logs[left[0]].source,
                got=f"{trained} smoothed steps without it, {tested} windows in it",
                expected=f"stretches longer than the horizon of {longest:g} s",
                fix="shorten --horizon, or record longer",
            )
    reach = _reach(stepper, samples)
    return Setup(
        project,
        logs,
        windows,
        of,
        grid,
        stepper,
        period,
        samples,
        steps,
        tuple(horizons),
        reach,
    ), folds


def fold(
    setup: Setup,
    left: Sequence[int],
    models: Learners,
    key: jax.Array,
    done: Callable[[str], None],
) -> Held:
    """All models without the logs ``left``, judged on them.

    What is left out is masked, not removed, so that folds share their compilations.
    """
    first, *keys = jax.random.split(key, 1 + len(models))
    belief = _fit(setup, left, first)
    out = np.isin(setup.samples.step_log(), left)
    test = np.isin(setup.steps.log, left)
    tt = belief.posterior.mean
    rows = transitions(
        setup.samples, smoothed_states(setup.project.system, tt, setup.samples)
    )
    train = eqx.tree_at(lambda t: t.mask, rows, ~out)
    held = eqx.tree_at(lambda t: t.mask, rows, out)
    sim = Sim2GP(setup.stepper, dt=setup.period, prior=belief.posterior, frozen=True)
    start_sd = _start_sd(setup.grid.lag[~test])
    resolution = np.asarray(setup.windows.floor)
    training = set(recordings(setup.logs)) - {setup.logs[k].source for k in left}
    inflation = inflation_of(len(training))
    error, sd, steps = [], [], []
    for (name, learner), key in zip(models.items(), keys, strict=True):
        begin, learn, roll = jax.random.split(key, 3)
        model = learner.make(sim, setup.reach)
        fitted = model.fit(model.init(begin), train, key=learn)
        found = ensemble(fitted, setup.steps, start_sd, draws=DRAWS, key=roll)
        off = found.point - setup.steps.y
        if found.finite():
            counts = setup.steps.valid & ~test[:, None, None]
            wide = scoring.spread(off, found.draws, counts, resolution, inflation)
        else:  # an infinite error: such a model loses, and has no numbers
            off, wide = np.full_like(off, math.inf), np.ones_like(off)
        error.append(off[test])
        sd.append(wide[test])
        steps.append(float(np.mean(np.asarray(log_scores(fitted, held))[out])))
        done(f"{name} without {setup.logs[left[0]].name}")
    return Held(
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


def _fit(setup: Setup, left: Sequence[int], key: jax.Array) -> Estimate:
    """The simulator's constants from the windows of all logs but ``left``."""
    mask = np.asarray(setup.windows.mask) & ~np.isin(setup.of, left)[:, None, None]
    kept = eqx.tree_at(lambda w: w.mask, setup.windows, mask)
    robust = setup.project.spec.likelihood.robust
    system = setup.project.system
    # One start: the folds are small changes of one problem, and share a compilation.
    return fit_windows(system, kept, key=key, robust=robust, starts=1)


def _folds(logs: Sequence[Log]) -> tuple[tuple[Log, ...], list[list[int]]]:
    """The logs, and which of them each fold leaves out.

    Pieces of one recording go together. A single recording is split in time, and its
    last quarter is the only one left out.
    """
    files = list(dict.fromkeys(recordings(logs)))
    if len(files) == 1:
        first, last = logs[0].time[0], logs[-1].time[-1]
        split = last - LAST * (last - first)
        before = [_piece(log, log.time < split, "") for log in logs]
        after = [_piece(log, log.time >= split, ", last quarter") for log in logs]
        kept = tuple(log for log in (*before, *after) if len(log) > 1)
        return kept, [[k for k, log in enumerate(kept) if log.time[0] >= split]]
    count = min(MOST_FOLDS, len(files))
    groups = [files[k::count] for k in range(count)]
    return tuple(logs), [
        [k for k, log in enumerate(logs) if log.source in group] for group in groups
    ]


def _piece(log: Log, rows: np.ndarray, word: str) -> Log:
    """Some rows of a log, as a recording of its own."""

    def some(table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: values[rows] for name, values in table.items()}

    return replace(
        log,
        name=log.name + word,
        source=log.source + word,
        time=log.time[rows],
        channels=some(log.channels),
        inputs=some(log.inputs),
        mask=some(log.mask),
    )


def _check_measured(
    logs: Sequence[Log], system: AbstractSystem, project: Project
) -> None:
    """One-step models need every state, or the position whose rate it is (E103)."""
    measured = measured_states(logs, system)
    names = [channel.name for channel in system.physical_states]
    missing = [
        name
        for name in names
        if name not in measured and name.removesuffix(".velocity") not in measured
    ]
    if missing:
        raise InputError(
            "E103",
            "unmeasured position",
            where=project.source.where("logs", 0, "columns"),
            got=", ".join(measured),
            expected=f"also {missing[0].removesuffix('.velocity')}",
            fix="name its column; a network cannot learn from a state it never sees",
        )


def _reach(stepper: AbstractSystem, samples: Samples) -> dict[str, float]:
    """Half-widths of the box of states and inputs that have no limits, from the data.

    Angles keep their circle.
    """
    past = samples.held[:, ::-1].reshape(len(samples.held), -1)
    # Newest first: the action itself, then what the state carries of the past.
    m = len(stepper.actions)
    largest = [
        *np.max(np.abs(samples.rough), axis=0),
        *np.max(np.abs(past[:, m:]), axis=0),
        *np.max(np.abs(past[:, :m]), axis=0),
    ]
    return {
        c.name: REACH * float(half)
        for c, half in zip((*stepper.states, *stepper.actions), largest, strict=True)
        if not (c.angle or math.isfinite(c.high - c.low)) and half > 0.0
    }


def _start_sd(lag: np.ndarray) -> np.ndarray:
    """How far causal starts are off, as a root mean square over windows."""
    known = np.isfinite(lag)
    squares = np.sum(np.where(known, lag, 0.0) ** 2, axis=0)
    return np.asarray(np.sqrt(squares / np.maximum(known.sum(axis=0), 1)))
