"""The search: the commands whose worth, over draws of the belief, is largest.

Worth is averaged over draws of the constants, because information depends on them. A
random motion is improved along gradients through simulator and information. Those draws
that it takes nearest to the limits guard them: to leave costs little at first and much
in the end, for the way to a better motion may lead outside. What is returned has passed
on draws that had no part in the search, made smaller where it did not.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.compilation import compile_async
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
from sim2gp.errors import InputError, NotFinite
from sim2gp.models.training import adamw, descend
from sim2gp.types import Key, in_float64, single

GRID, SUBSTEP = 0.01, 0.0025  # s, the shortest period and substep that a search sees
BLOCK, BLOCKS, RATE = 15, 5, 0.015  # of Adam's steps along the gradient
STARTS = 1  # random motions
BEGIN, LEAVING = 0.1, 0.2  # their coefficients' sd, less where more trials leave limits
DRAWS = 4  # of the constants, that information is averaged over, its mean first
TRIALS = 300  # of them, that must keep the limits while searching
GUARDS = 24  # of those, the nearest to the limits, that a block of steps looks at
MARGIN = 0.05  # of a box's half, kept free while searching
TURN = 0.25  # s, in which a motion leaves its limits about once
LOST = 0.3  # halves of the box: so far outside, a plan is given up
CHEAP, COST = 2.0, 15.0  # at first and at last, for a half of the box, in nats of
#: each direction that is asked about
CHECKED = 1000  # draws that the result is held against
ALLOWED = 0.01  # the share of them that may leave the limits
SMALLER = 0.97  # times the commands, where too many still do
MILD = 0.03  # of an input's range, the sd of each tone of a random motion


class Designed(eqx.Module):
    """Commands, and what they are expected to do and to tell.

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
def design(
    experiment: Experiment,
    goal: AbstractGoal,
    limits: Limits,
    signal: AbstractSignal,
    *,
    key: Key,
    draws: int = DRAWS,
    starts: int = STARTS,
) -> Designed:
    """The best commands found.

    Raises `InputError` E150 where none of them keeps the limits, E148 for no draws or
    starts.

    Their worth is averaged over ``draws`` of the constants, the mean being the first.
    The best of what is found from so many random motions.
    """
    checks.count("design", draws=draws, starts=starts)
    experiment, goal, limits = jax.tree.map(jnp.asarray, (experiment, goal, limits))
    p = experiment.belief.mean.size
    search, *others = jax.random.split(key, 4)
    informed, trials, held_out = (
        jax.random.normal(k, (count, p))
        for k, count in zip(others, (draws, TRIALS, CHECKED), strict=True)
    )
    informed = informed.at[0].set(0.0)
    nothing = jnp.zeros((experiment.steps, limits.low.size))
    rough, coarse = _coarser(experiment, signal)
    improve = _climber(rough, coarse, goal, limits, informed, trials)
    _checked.compile_for(experiment, limits, nothing, held_out)
    _worth.compile_for(experiment, goal, informed, nothing)

    def one(key: Key) -> Designed:
        U = signal.commands(improve(key).astype(float), limits)
        U, states, bad = _kept(experiment, limits, U, held_out)
        worth, scale, middle = _worth(experiment, goal, informed, U)
        low, high = np.quantile(np.asarray(states), [0.05, 0.95], axis=0)
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

    found = _of_starts(one, search, starts)
    best = max(found, key=lambda f: f.nats if math.isfinite(f.nats) else -math.inf)
    if not math.isfinite(best.nats):
        raise NotFinite(
            "E203",
            "information of the experiment",
            got=best.nats,
            fix="narrow the limits of the states: the simulation is lost within them",
        )
    return best


def _of_starts(one: Callable[[Key], Designed], key: Key, starts: int) -> list[Designed]:
    """What each start ends with; E150 of the last one where none keeps the limits."""
    found: list[Designed] = []
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
    experiment: Experiment, limits: Limits, U: Array, draws: Array
) -> tuple[Array, Array, float]:
    """Commands that keep the limits; the draws' states, and the share that leaves."""
    for _ in range(100):
        states, beyond = _checked(experiment, limits, U, draws)
        bad = float(jnp.mean(beyond > 0.0))
        if bad <= ALLOWED:
            return U, states, bad
        U = SMALLER * U
    raise InputError(
        "E150",
        "no commands keep the limits",
        got=f"{bad:.0%} of {len(draws)} draws leave them however small the commands",
        expected=f"at most {ALLOWED:.0%}",
        fix="widen the limits of the states, or know the machine better first",
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
    U = signal.commands(MILD * signal.random(key, limits.low.size), limits)
    return _sensitivity(experiment, U, periods)


def _coarser(
    experiment: Experiment, signal: AbstractSignal
) -> tuple[Experiment, AbstractSignal]:
    """As long and as telling, with periods of `GRID`: for a search, long enough."""
    k = math.floor(GRID / experiment.period + 1e-9)
    k = max(1, min(k, experiment.steps // 2))
    period, steps = k * experiment.period, experiment.steps // k
    coarse = dataclasses.replace(
        experiment,
        noise=experiment.noise / math.sqrt(k),
        period=period,
        steps=steps,
        window=min(max(2, round(experiment.window / k)), steps),
        substep=SUBSTEP,
    )
    return coarse, dataclasses.replace(signal, period=period, steps=steps)


def _climber(
    experiment: Experiment,
    signal: AbstractSignal,
    goal: AbstractGoal,
    limits: Limits,
    draws: Float[Array, "D p"],
    trials: Float[Array, "N p"],
) -> Callable[[Key], Float[Array, "k m"]]:
    """From a random motion to a better one, in blocks of steps with guards each."""
    experiment, goal, limits, draws, trials = single(
        (experiment, goal, limits, draws, trials)
    )
    inner, inputs = _narrowed(limits), limits.low.size
    costs = goal.directions(experiment.belief.scale) * np.geomspace(CHEAP, COST, BLOCKS)
    total = jnp.asarray(BLOCK * BLOCKS)

    def beyond(C: Array) -> Array:
        return _checked(experiment, inner, signal.commands(C, limits), trials)[1]

    def block(C: Array, state: optax.OptState, guards: Array, i: int) -> Any:
        cost, at = jnp.asarray(costs[i], jnp.float32), jnp.asarray(BLOCK * i)
        about = signal, experiment, goal, limits, draws, guards
        return *about, cost, C, state, at, total

    nothing = jnp.zeros((signal.coefficients, inputs), jnp.float32)
    _climb.compile_for(*block(nothing, adamw().init(nothing), trials[:GUARDS], 0))

    def improved(key: Key) -> Array:
        C = BEGIN * signal.random(key, inputs).astype(jnp.float32)
        far = beyond(C)
        for _ in range(30):
            if jnp.mean(far > 0.0) <= LEAVING:
                break
            C = 0.8 * C
            far = beyond(C)
        state = adamw().init(C)
        for i in range(BLOCKS):
            # Of a machine that is lost no gradient can be had.
            near = jnp.where(jnp.isfinite(far), far, -jnp.inf)
            guards = trials[jnp.argsort(-near)[:GUARDS]]
            moved, after = _climb(*block(C, state, guards, i))
            then = beyond(moved)
            # Over the top there is no way back: the next block, at a higher cost,
            # begins where this one did.
            if jnp.mean(then < LOST) > 1.0 - LEAVING:
                C, state, far = moved, after, then
            else:
                # Nothing is remembered, but how many steps there have been.
                count = jnp.asarray(BLOCK * (i + 1), jnp.int32)
                state = optax.tree.set(adamw().init(C), count=count)
        return C

    return improved


@compile_async
def _climb(
    signal: AbstractSignal,
    experiment: Experiment,
    goal: AbstractGoal,
    limits: Limits,
    draws: Float[Array, "D p"],
    guards: Float[Array, "G p"],
    cost: Array,
    C: Float[Array, "k m"],
    state: optax.OptState,
    first: Array,
    total: Array,
) -> tuple[Float[Array, "k m"], optax.OptState]:
    """Steps of Adam on the worth at one draw after the other, less what guards pay."""
    beyond = _beyond_of(experiment, _narrowed(limits))

    near = jax.vmap(experiment.plausible.at)(guards)

    def loss(C: Float[Array, "k m"], z: Float[Array, " p"]) -> Array:
        U, own = signal.commands(C, limits), experiment.belief.at(z)
        states = _states(experiment, U, jnp.concatenate([own[None], near]))
        worth, _ = _worth_at(experiment, goal, z, U, states[0])
        return cost * beyond(states[1:]) - worth

    def slope(C: Float[Array, "k m"], i: Array, key: Key) -> Array:
        # Only its direction: a plan that is far out for once is not to set the pace.
        g = jax.grad(loss)(C, draws[i % len(draws)])
        return g / (jnp.linalg.norm(g) + 1e-12)

    key = jax.random.key(0)
    return descend(
        slope, C, state, RATE, steps=BLOCK, start=first, total=total, key=key
    )


def _beyond_of(experiment: Experiment, limits: Limits) -> Callable[[Array], Array]:
    """How far machines leave the limits in all of their turns, on average."""
    turn = min(max(1, round(TURN / experiment.period)), experiment.steps)
    turns = experiment.steps // turn

    def one(states: Float[Array, "times n"]) -> Array:
        S = states[: turns * turn].reshape(turns, turn, -1)
        worst = jax.vmap(lambda S: excess(limits, S))(S)
        return jnp.sum(jnp.maximum(worst, 0.0))

    return lambda states: jnp.mean(jax.vmap(one)(states))


def _narrowed(limits: Limits) -> Limits:
    low, high = limits.state_low, limits.state_high
    off = 0.5 * MARGIN * jnp.where(jnp.isfinite(high - low), high - low, 0.0)
    box = low + off, high - off
    return eqx.tree_at(lambda l: (l.state_low, l.state_high), limits, box)


def _worth_at(
    experiment: Experiment, goal: AbstractGoal, z: Array, U: Array, states: Array
) -> tuple[Array, Array]:
    """Nats of the goal at one machine, and the scale of the belief after it."""
    scale = after(experiment.belief, information(experiment, z, U, states))
    return goal.nats(experiment.belief.scale, scale), scale


@compile_async
def _worth(
    experiment: Experiment, goal: AbstractGoal, draws: Array, U: Array
) -> tuple[Array, Array, Array]:
    """The mean over draws, the scale at the first, and the plausible mean's states."""

    def one(z: Array) -> tuple[Array, Array]:
        states = trajectory(experiment, experiment.belief.at(z), U)
        return _worth_at(experiment, goal, z, U, states)

    nats, scales = jax.lax.map(one, draws)
    middle = trajectory(experiment, experiment.plausible.mean, U)
    return jnp.mean(nats), scales[0], middle


def _states(experiment: Experiment, U: Array, machines: Array) -> Array:
    """Of every machine, at its virtual values."""
    return jax.vmap(lambda tt: trajectory(experiment, tt, U))(machines)


_sensitivity = eqx.filter_jit(sensitivity_at)


@compile_async
def _checked(
    experiment: Experiment, limits: Limits, U: Array, draws: Array
) -> tuple[Array, Array]:
    """Of plausible machines, and how far each leaves the limits; infinite when lost."""
    states = _states(experiment, U, jax.vmap(experiment.plausible.at)(draws))
    beyond = jax.vmap(lambda S: excess(limits, S))(states)
    return states, jnp.where(jnp.isfinite(beyond), beyond, jnp.inf)
