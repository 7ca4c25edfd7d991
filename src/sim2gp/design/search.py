"""The search: the commands whose worth, over draws of the belief, is largest.

Worth is averaged over draws of the constants, because information depends on them; a
plan that takes some drawn machine beyond its limits pays for it. What is returned was
then held against many more draws, and made smaller until it passed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.design.experiment import (
    Experiment,
    after,
    information,
    sensitivity_at,
    trajectory,
)
from sim2gp.design.goals import AbstractGoal
from sim2gp.design.limits import Limits, excess
from sim2gp.design.signals import AbstractSignal, Multisine
from sim2gp.errors import InputError
from sim2gp.planning import ICEM
from sim2gp.types import Key, in_float64, single

ROUNDS, SAMPLES, ELITES = 20, 40, 8
DRAWS = 2  # of the constants, that information is averaged over, its mean first
GUARDS = 8  # more of them, that must keep the limits while searching
MARGIN = 0.03  # of a box's half, kept free while searching
COST = 100.0  # nats for leaving the limits by a whole half of the box
CHECKED = 1000  # draws that the result is held against
ALLOWED = 0.01  # the share of them that may leave the limits
SMALLER = 0.93  # times the commands, where more do
MILD = 0.03  # of an input's range, the sd of each tone of a random motion


class Designed(eqx.Module):
    """Commands, and what they are expected to do and to tell.

    nats: of the goal, on average over draws.
    scale: square root of the expected covariance at the belief's mean.
    states: at the belief's mean; ``low`` and ``high`` are the draws' 5 % and 95 %.
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
def design(
    experiment: Experiment,
    goal: AbstractGoal,
    limits: Limits,
    signal: AbstractSignal,
    *,
    key: Key,
    draws: int = DRAWS,
) -> Designed:
    """The best commands found. Raises E150 where none of them keeps the limits.

    Their worth is averaged over ``draws`` of the constants, the mean being the first.
    """
    experiment, goal, limits = jax.tree.map(jnp.asarray, (experiment, goal, limits))
    search, guard, check = jax.random.split(key, 3)
    p = experiment.belief.mean.size
    others = jax.random.normal(jax.random.fold_in(search, 1), (draws - 1, p))
    informed = jnp.concatenate([jnp.zeros((1, p)), others])
    guards = jax.random.normal(guard, (GUARDS, p))
    rough = single((experiment, goal, limits, informed, guards))
    U = signal.commands(_search(signal, *rough, search).astype(float), limits)
    checks = jax.random.normal(check, (CHECKED, p))
    for _ in range(40):
        states, outside = _checked(experiment, limits, U, checks)
        bad = float(jnp.mean(outside))
        if bad <= ALLOWED:
            break
        U = SMALLER * U
    else:
        raise InputError(
            "E150",
            "no commands keep the limits",
            got=f"{bad:.0%} of {CHECKED} draws leave them however small the commands",
            expected=f"at most {ALLOWED:.0%}",
            fix="widen the limits of the states, or know the machine better first",
        )
    middle = _states(experiment, U, informed)
    worth, scale = _worth(experiment, goal, informed, U, middle)
    low, high = np.quantile(np.asarray(states), [0.05, 0.95], axis=0)
    return Designed(
        np.asarray(U),
        float(worth),
        np.asarray(scale),
        np.asarray(middle[0]),
        low,
        high,
        bad,
        CHECKED,
    )


@in_float64
def prediction_rows(
    experiment: Experiment, limits: Limits, horizon: float, key: Key
) -> Float[Array, "k p"]:
    """What predictions ``horizon`` seconds ahead depend on, along small random motions.

    Raises E151 where the experiment is shorter than the horizon.
    """
    periods = max(1, round(horizon / experiment.period))
    if periods > experiment.steps:
        raise InputError(
            "E151",
            "prediction longer than the experiment",
            got=f"{horizon:g} s",
            expected=f"at most {experiment.period * experiment.steps:g} s",
            fix="predict less far, or design more seconds",
        )
    experiment, limits = jax.tree.map(jnp.asarray, (experiment, limits))
    signal = Multisine(experiment.period, experiment.steps)
    shape = (signal.coefficients, limits.low.size)
    U = signal.commands(MILD * jax.random.normal(key, shape), limits)
    return _sensitivity(experiment, U, periods)


@eqx.filter_jit
def _search(
    signal: AbstractSignal,
    experiment: Experiment,
    goal: AbstractGoal,
    limits: Limits,
    draws: Float[Array, "D p"],
    guards: Float[Array, "G p"],
    key: Key,
) -> Float[Array, "k m"]:
    rule = ICEM(samples=SAMPLES, elites=ELITES, finest=0.05)
    inner = eqx.tree_at(
        lambda l: (l.state_low, l.state_high), limits, _narrowed(limits)
    )

    def flown(U: Array) -> tuple[Array, Array]:
        states = _states(experiment, U, jnp.concatenate([draws, guards]))
        beyond = jax.vmap(lambda S: excess(inner, S))(states[len(draws) :])
        return states[: len(draws)], jnp.mean(beyond)

    def evaluate(C: Float[Array, "N k m"]) -> tuple[Array, Array]:
        # Trajectories are long and narrow, so all candidates' at once; the windows of
        # one candidate fill the machine by themselves.
        U = jax.vmap(lambda c: signal.commands(c, limits))(C)
        states, beyond = jax.vmap(flown)(U)
        worth = jax.lax.map(
            lambda x: _mean_worth(experiment, goal, draws, *x)[0], (U, states)
        )
        returns = worth - COST * beyond
        return returns, jnp.isfinite(returns)

    plan = rule.init(signal.coefficients, limits.low.size, draws.dtype)
    plan = rule.search(plan, evaluate, rounds=ROUNDS, colour=1.0, key=key)
    return plan.elites[0]


def _narrowed(limits: Limits) -> tuple[Array, Array]:
    low, high = jnp.asarray(limits.state_low), jnp.asarray(limits.state_high)
    off = 0.5 * MARGIN * jnp.where(jnp.isfinite(high - low), high - low, 0.0)
    return low + off, high - off


def _mean_worth(
    experiment: Experiment, goal: AbstractGoal, draws: Array, U: Array, states: Array
) -> tuple[Array, Array]:
    """Nats of the goal over the draws, and the scale after, at the first of them."""
    A = jax.vmap(lambda z, S: information(experiment, z, U, S))(draws, states)
    scales = jax.vmap(lambda a: after(experiment.belief, a))(A)
    nats = jax.vmap(lambda s: goal.nats(experiment.belief.scale, s))(scales)
    return jnp.mean(nats), scales[0]


_worth = eqx.filter_jit(_mean_worth)
_sensitivity = eqx.filter_jit(sensitivity_at)


@eqx.filter_jit
def _states(experiment: Experiment, U: Array, draws: Array) -> Array:
    """Of every drawn machine."""
    return jax.vmap(lambda z: trajectory(experiment, z, U))(draws)


@eqx.filter_jit
def _checked(
    experiment: Experiment, limits: Limits, U: Array, draws: Array
) -> tuple[Array, Array]:
    """Of every drawn machine, and whether it leaves the limits or is lost."""
    states = _states(experiment, U, draws)
    return states, ~(jax.vmap(lambda S: excess(limits, S))(states) <= 0.0)
