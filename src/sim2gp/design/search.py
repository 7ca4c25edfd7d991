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

from sim2gp.design.experiment import Experiment, after, information, trajectory
from sim2gp.design.goals import AbstractGoal
from sim2gp.design.limits import Limits, excess
from sim2gp.design.signals import AbstractSignal
from sim2gp.errors import InputError
from sim2gp.planning import ICEM
from sim2gp.types import Key, in_float64

ROUNDS, SAMPLES, ELITES = 24, 48, 8
DRAWS = 3  # of the constants, that information is averaged over
GUARDS = 16  # more of them, that must keep the limits while searching
MARGIN = 0.03  # of a box's half, kept free while searching
COST = 100.0  # nats for leaving the limits by a whole half of the box
CHECKED = 1000  # draws that the result is held against
ALLOWED = 0.01  # the share of them that may leave the limits
SMALLER = 0.93  # times the commands, where more do


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
) -> Designed:
    """The best commands found. Raises E150 where none of them keeps the limits."""
    experiment, goal, limits = jax.tree.map(jnp.asarray, (experiment, goal, limits))
    search, guard, check = jax.random.split(key, 3)
    p = experiment.belief.mean.size
    draws = jax.random.normal(jax.random.fold_in(search, 1), (DRAWS - 1, p))
    draws = jnp.concatenate([jnp.zeros((1, p)), draws])
    guards = jax.random.normal(guard, (GUARDS, p))
    C = _search(experiment, goal, limits, signal, draws, guards, search)
    checks = jax.random.normal(check, (CHECKED, p))
    for _ in range(40):
        U = signal.commands(C, limits)
        states = np.asarray(_states(experiment, U, checks))
        beyond = np.asarray(jax.vmap(lambda S: excess(limits, S))(jnp.asarray(states)))
        bad = float(np.mean(~(beyond <= 0.0)))
        if bad <= ALLOWED:
            break
        C = SMALLER * C
    else:
        raise InputError(
            "E150",
            "no commands keep the limits",
            got=f"{bad:.0%} of {CHECKED} draws leave them however small the commands",
            expected=f"at most {ALLOWED:.0%}",
            fix="widen the limits of the states, or know the machine better first",
        )
    worth, scale = _worth(experiment, goal, draws, U)
    middle = _states(experiment, U, jnp.zeros((1, p)))[0]
    low, high = np.quantile(states, [0.05, 0.95], axis=0)
    return Designed(
        np.asarray(U),
        float(worth),
        np.asarray(scale),
        np.asarray(middle),
        low,
        high,
        bad,
        CHECKED,
    )


@eqx.filter_jit
def _search(
    experiment: Experiment,
    goal: AbstractGoal,
    limits: Limits,
    signal: AbstractSignal,
    draws: Float[Array, "D p"],
    guards: Float[Array, "G p"],
    key: Key,
) -> Float[Array, "k m"]:
    rule = ICEM(samples=SAMPLES, elites=ELITES, finest=0.05)
    inner = eqx.tree_at(
        lambda l: (l.state_low, l.state_high), limits, _narrowed(limits)
    )

    def one(C: Array) -> Array:
        U = signal.commands(C, limits)
        worth, _ = _mean_worth(experiment, goal, draws, U)
        beyond = jax.vmap(lambda z: excess(inner, trajectory(experiment, z, U)))(guards)
        return worth - COST * jnp.mean(beyond)

    def evaluate(C: Float[Array, "N k m"]) -> tuple[Array, Array]:
        # One after the other: a plan's own simulations fill the machine.
        returns = jax.lax.map(one, C)
        return returns, jnp.isfinite(returns)

    plan = rule.init(signal.coefficients, limits.low.size, jnp.zeros(()).dtype)
    plan = rule.search(plan, evaluate, rounds=ROUNDS, colour=1.0, key=key)
    return plan.elites[0]


def _narrowed(limits: Limits) -> tuple[Array, Array]:
    low, high = jnp.asarray(limits.state_low), jnp.asarray(limits.state_high)
    off = 0.5 * MARGIN * jnp.where(jnp.isfinite(high - low), high - low, 0.0)
    return low + off, high - off


def _mean_worth(
    experiment: Experiment, goal: AbstractGoal, draws: Array, U: Array
) -> tuple[Array, Array]:
    """Nats of the goal over the draws, and the scale after, at the first of them."""
    A = jax.vmap(lambda z: information(experiment, z, U))(draws)
    scales = jax.vmap(lambda a: after(experiment.belief, a))(A)
    nats = jax.vmap(lambda s: goal.nats(experiment.belief.scale, s))(scales)
    return jnp.mean(nats), scales[0]


_worth = eqx.filter_jit(_mean_worth)


@eqx.filter_jit
def _states(experiment: Experiment, U: Array, draws: Array) -> Array:
    """Of every drawn machine."""
    return jax.vmap(lambda z: trajectory(experiment, z, U))(draws)
