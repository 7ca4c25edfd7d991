"""What a comparison computes: each model without each group of logs, a cell each."""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool

from sim2gp.belief import AbstractModel
from sim2gp.commands.compare_setup import Setup, prepare_comparison
from sim2gp.commands.folds import recording_of_windows
from sim2gp.commands.recordings import Recordings
from sim2gp.data.one_step_log import smoothed_states, stride_of, transitions
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts import scoring
from sim2gp.identification.forecasts.baselines import regression_errors
from sim2gp.identification.forecasts.forecast import new_log_inflation
from sim2gp.identification.forecasts.forecast_machine import fit_forecast_machine
from sim2gp.identification.forecasts.prediction import recording_names, subset
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import NLM, FunctionSpace, Residual, ResidualFunctionSpace, Sim2GP
from sim2gp.models.auto import log_scores
from sim2gp.models.ensemble import ensemble
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.runs.plain import exact
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Key

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


@dataclass(frozen=True, eq=False)
class ModelCell(AbstractCell):
    """A model fitted without the logs ``left``, and judged on them.

    ``models`` None are the library's; others stay in this process.
    """

    recordings: Recordings
    horizons: tuple[float, ...]
    seed: int
    number: int
    left: tuple[int, ...]
    model: str
    models: Learners | None = None

    @property
    def name(self) -> str:
        """By the number of its fold."""
        return f"fold_{self.number}_{self.model}"

    @property
    def note(self) -> str:
        """What is left out, for people."""
        return f"{self.model} {self.recordings.without(self.left)}"

    @property
    def arguments(self) -> Values:
        """The project and its logs, by their digest."""
        return {
            "recordings": self.recordings.digest,
            "horizons": list(self.horizons),
            "seed": self.seed,
            "left": list(self.left),
            "model": self.model,
        }

    @property
    def program(self) -> tuple[Hashable, ...]:
        """Models of a fold share the simulator's fit."""
        return self.number, self.model

    def compute(self, needed: Values | None) -> Values:
        """Errors and sd of the forecasts of what is left out."""
        del needed
        setup, _ = prepared(self.recordings, self.horizons)
        models = self.models or MODELS
        first, *keys = jax.random.split(
            fold_key(self.seed, self.number), 1 + len(models)
        )
        fold = self.recordings.kept(
            "fold",
            (self.horizons, self.seed, self.left),
            lambda: fitted_fold(setup, self.left, first),
        )
        key = keys[list(models).index(self.model)]
        return exact(judge(setup, fold, models[self.model], key))


def prepared(
    recordings: Recordings, horizons: tuple[float, ...]
) -> tuple[Setup, list[list[int]]]:
    def prepare() -> tuple[Setup, list[list[int]]]:
        return prepare_comparison(recordings.project, recordings.logs, horizons)

    return recordings.kept("setup", horizons, prepare)


def fold_key(seed: int, number: int) -> Key:
    return jax.random.fold_in(jax.random.key(seed), number)


class FittedFold(NamedTuple):
    """The simulator without some logs, and the smoothed steps of all logs.

    ``out`` are the steps that are left out, ``test`` the windows to forecast, and
    ``training`` counts the recordings that are left.
    """

    likelihood: WindowsLikelihood
    fit: Estimate
    rows: Transitions
    out: Bool[np.ndarray, " N"]
    test: Bool[np.ndarray, " W"]
    training: int


def fitted_fold(setup: Setup, left: Sequence[int], key: Key) -> FittedFold:
    """The fit without the logs ``left``.

    They are masked, not removed, so that folds share their compilations.
    """
    likelihood, fit = fit_without(setup, left, key)
    smooth = smoothed_states(setup.project.system, fit.posterior.mean, setup.samples)
    training = set(recording_names(setup.logs)) - {setup.logs[k].source for k in left}
    return FittedFold(
        likelihood,
        fit,
        transitions(setup.samples, smooth),
        np.isin(setup.samples.step_log(), left),
        np.isin(setup.steps.log, left),
        len(training),
    )


def judge(setup: Setup, fold: FittedFold, learner: ModelFactory, key: Key) -> Values:
    """Errors, their sd, and nats per step, of a model that has not seen some logs."""
    begin, learn, roll = jax.random.split(key, 3)
    train = eqx.tree_at(lambda t: t.mask, fold.rows, ~fold.out)
    held = eqx.tree_at(lambda t: t.mask, fold.rows, fold.out)
    model = learner.make(_simulator_of(setup, fold, learner.forces), setup.reach)
    fitted = model.fit(model.init(begin), train, key=learn)
    start_sd = _start_sd(setup.grid.lag[~fold.test])
    found = ensemble(fitted, setup.steps, start_sd, draws=DRAWS, key=roll)
    off = found.point - setup.steps.y
    if found.finite():
        counts = setup.steps.valid & ~fold.test[:, None, None]
        resolution = np.asarray(setup.windows.floor)
        inflation = new_log_inflation(fold.training)
        sd = scoring.predicted_spread(off, found.draws, counts, resolution, inflation)
    else:  # an infinite error: such a model loses, and has no numbers
        off, sd = np.full_like(off, math.inf), np.ones_like(off)
    scores = np.asarray(log_scores(fitted, held))[fold.out]
    return {
        "error": off[fold.test],
        "sd": sd[fold.test],
        "step_score": float(np.mean(scores)),
    }


def trivial_errors(setup: Setup, test: np.ndarray) -> np.ndarray:
    """Errors of the start held and of the linear regression, as `Held.trivial`."""
    train, tested = subset(setup.grid, ~test), subset(setup.grid, test)
    rows = stride_of(setup.period) * np.asarray(setup.steps.steps)
    start = np.asarray(tested.windows.start)[:, list(setup.steps.outputs)]
    hold = start[:, None] - setup.steps.y[test]
    return np.stack([hold, regression_errors(train, tested, rows)])


def _simulator_of(setup: Setup, fold: FittedFold, forces: bool) -> Sim2GP:
    """With its parameters given; with ``forces``, and those that predict recordings."""
    if not forces:
        return _simulator(setup, setup.project.system, fold.fit.posterior)
    known = fold.fit.with_measurements(setup.project.system.parameters)
    recording = recording_of_windows(setup.logs, setup.of)
    robust = setup.project.spec.likelihood.robust
    start = at_zero(fold.likelihood, known, recording)
    wider = fit_forecast_machine(start, recording, robust=robust)
    return _simulator(setup, wider.system, wider.posterior)


def _simulator(setup: Setup, system: AbstractSystem, known: Gaussian) -> Sim2GP:
    """In steps of the comparison, its parameters given."""
    stepper = carrying_inputs(system, setup.period)
    return Sim2GP(stepper, dt=setup.period, prior=known, frozen=True)


def fit_without(
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
