"""The search: the commands whose worth, over draws of the belief, is largest.

Worth is averaged over draws of the parameters, because information depends on them. A
random motion is improved along gradients (`by_gradients`), or where a simulator on the
host moves the machine, by samples (`by_samples`). What is returned has passed on draws
that had no part in the search, made smaller where it did not.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import InputError, NotFinite, error
from sim2gp.experiment_design import by_gradients, by_samples
from sim2gp.experiment_design.experiment import Experiment
from sim2gp.experiment_design.goals import AbstractGoal
from sim2gp.experiment_design.limits import LimitBox
from sim2gp.experiment_design.search_method import SearchMethod, SearchProblem
from sim2gp.experiment_design.signals import AbstractCommandSignal, MultisineCommands
from sim2gp.systems.host import simulator_of
from sim2gp.types import AnyArray, Key, in_float64

STARTS = 1  # random motions
DRAWS = 4  # of the parameters, to average information over; the mean is first
ALLOWED = 0.01  # the share of draws that may leave the limits
SMALLER = 0.97  # times the commands, where too many still do
MILD = 0.03  # of an input's range, the sd of each tone of a random motion


class DesignResult(eqx.Module):
    """Commands, and their expected motion and information.

    nats: of the goal, on average over draws.
    scale: square root of the expected covariance at the belief's mean.
    states: at the mean of what is plausible; ``low`` and ``high`` are the 5 % and 95 %
        of its draws.
    violations: the share of checked draws that leave the limits.
    """

    commands: Float[np.ndarray, "T m"]
    nats: float
    scale: Float[np.ndarray, "p p"]
    states: Float[np.ndarray, "times n"]
    low: Float[np.ndarray, "times n"]
    high: Float[np.ndarray, "times n"]
    violations: float
    checked: int


@in_float64
def optimise_commands(
    experiment: Experiment,
    goal: AbstractGoal,
    limits: LimitBox,
    signal: AbstractCommandSignal,
    *,
    key: Key,
    draws: int = DRAWS,
    starts: int = STARTS,
) -> DesignResult:
    """The best commands found.

    Raises `InputError` E150 where none of them keeps the limits, E148 for no draws or
    starts.

    Their worth is averaged over ``draws`` of the parameters; the mean is the first. The
    best of what is found from so many random motions.
    """
    checks.count("design", draws=draws, starts=starts)
    experiment, goal, limits = jax.tree.map(jnp.asarray, (experiment, goal, limits))
    by, p = _by(experiment), experiment.belief.mean.size
    search, *others = jax.random.split(key, 4)
    informed, trials, held_out = (
        jax.random.normal(k, (count, p))
        for k, count in zip(others, (draws, by.TRIALS, by.CHECKED), strict=True)
    )
    informed = informed.at[0].set(0.0)
    problem = SearchProblem(
        experiment, signal, goal, limits, informed, trials, held_out
    )
    improve, check, information = by.search_programs(problem)

    def one(key: Key) -> DesignResult:
        U = signal.commands(jnp.asarray(improve(key), float), limits)
        U, states, bad = _kept(check, U)
        worth, scale, middle = information(U)
        low, high = np.quantile(np.asarray(states), [0.05, 0.95], axis=0)
        return DesignResult(
            np.asarray(U),
            float(worth),
            np.asarray(scale),
            np.asarray(middle),
            low,
            high,
            bad,
            len(states),
        )

    found = _of_starts(one, search, starts)
    best = max(found, key=lambda f: f.nats if math.isfinite(f.nats) else -math.inf)
    if not math.isfinite(best.nats):
        raise error("information_not_finite", NotFinite, got=best.nats)
    return best


def _of_starts(
    one: Callable[[Key], DesignResult], key: Key, starts: int
) -> list[DesignResult]:
    """What each start ends with; E150 of the last one where none keeps the limits."""
    found: list[DesignResult] = []
    refused: InputError | None = None
    for i in range(starts):
        try:
            found.append(one(jax.random.fold_in(key, i)))
        except InputError as error:  # another start may end within the limits
            refused = error
    if refused and not found:
        raise refused
    return found


def _kept(
    check: Callable[[Array], tuple[AnyArray, AnyArray]], U: Array
) -> tuple[Array, AnyArray, float]:
    """Commands that keep the limits; the draws' states, and the share that leaves."""
    for _ in range(100):
        states, beyond = check(U)
        bad = float(np.mean(np.asarray(beyond) > 0.0))
        if bad <= ALLOWED:
            return U, states, bad
        U = SMALLER * U
    got = f"{bad:.0%} of {len(states)} draws leave them however small the commands"
    raise error("no_commands_keep_limits", got=got, share=f"{ALLOWED:.0%}")


@in_float64
def prediction_rows(
    experiment: Experiment, limits: LimitBox, horizon: float, key: Key
) -> Float[Array, "k p"]:
    """What predictions ``horizon`` seconds ahead depend on, along small random motions.

    Raises E151 where the experiment is shorter than the horizon.
    """
    periods = max(1, round(horizon / experiment.period))
    if periods > experiment.steps:
        longest = f"{experiment.period * experiment.steps:g}"
        raise error("prediction_too_long", got=f"{horizon:g} s", longest=longest)
    experiment, limits = jax.tree.map(jnp.asarray, (experiment, limits))
    signal = MultisineCommands(experiment.period, experiment.steps)
    U = signal.commands(MILD * signal.random(key, limits.low.size), limits)
    rows: Array = _by(experiment).sensitivity_at(experiment, U, periods)
    return rows


@in_float64
def scale_after(
    experiment: Experiment, commands: Float[AnyArray, "T m"]
) -> Float[AnyArray, "p p"]:
    """Square root of the covariance that commands leave, at the belief's mean."""
    experiment = jax.tree.map(jnp.asarray, experiment)
    return _by(experiment).scale_after(experiment, jnp.asarray(commands))


def _by(experiment: Experiment) -> SearchMethod:
    """The kind of search that a machine admits."""
    if simulator_of(experiment.system) is None:
        return by_gradients  # each is checked: of both at once a type says nothing
    return by_samples
