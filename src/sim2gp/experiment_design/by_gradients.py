"""The search along gradients through simulator and information, for machines of JAX.

A random motion is improved. Those draws that it takes nearest to the limits guard them:
to leave costs little at first and much in the end, for the way to a better motion may
lead outside.
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

from sim2gp.compilation import compile_async
from sim2gp.experiment_design.experiment import (
    Experiment,
    information,
    posterior_scale,
    trajectory,
)
from sim2gp.experiment_design.experiment import (
    sensitivity_at as sensitivity_at,
)
from sim2gp.experiment_design.goals import AbstractGoal
from sim2gp.experiment_design.limits import LimitBox, all_excess, excess, narrow_limits
from sim2gp.experiment_design.search_method import SearchProblem, SearchPrograms
from sim2gp.experiment_design.signals import AbstractCommandSignal
from sim2gp.models.training import adamw, descend
from sim2gp.types import Key, single

GRID, SUBSTEP = 0.01, 0.0025  # s, the shortest period and substep that a search sees
BLOCK, BLOCKS, RATE = 15, 5, 0.015  # of Adam's steps along the gradient
BEGIN, LEAVING = 0.1, 0.2  # their coefficients' sd, less where more trials leave limits
TRIALS = 300  # draws that must keep the limits while searching
GUARDS = 24  # of those, the nearest to the limits, that a block of steps looks at
TURN = 0.25  # s, in which a motion leaves its limits about once
LOST = 0.3  # halves of the box: so far outside, a plan is given up
CHEAP, COST = 2.0, 15.0  # at first and at last, for a half of the box, in nats of
#: each direction that is asked about
CHECKED = 1000  # draws that the result is held against


def search_programs(problem: SearchProblem) -> SearchPrograms:
    """Programs of JAX; they begin to be compiled here."""
    experiment, signal, goal, limits, informed, trials, held_out = problem
    nothing = jnp.zeros((experiment.steps, limits.low.size))
    rough, coarse = _coarser(experiment, signal)
    improve = _climber(rough, coarse, goal, limits, informed, trials)
    _plausible_states.compile_for(experiment, limits, nothing, held_out)
    _worth.compile_for(experiment, goal, informed, nothing)
    return SearchPrograms(
        improve,
        lambda U: _plausible_states(experiment, limits, U, held_out),
        lambda U: _worth(experiment, goal, informed, U),
    )


def _coarser(
    experiment: Experiment, signal: AbstractCommandSignal
) -> tuple[Experiment, AbstractCommandSignal]:
    """As long and as informative, with periods of `GRID`: enough for a search."""
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
    signal: AbstractCommandSignal,
    goal: AbstractGoal,
    limits: LimitBox,
    draws: Float[Array, "D p"],
    trials: Float[Array, "N p"],
) -> Callable[[Key], Float[Array, "k m"]]:
    """From a random motion to a better one, in blocks of steps with guards each."""
    experiment, goal, limits, draws, trials = single(
        (experiment, goal, limits, draws, trials)
    )
    inner, inputs = narrow_limits(limits), limits.low.size
    costs = goal.directions(experiment.belief.scale) * np.geomspace(CHEAP, COST, BLOCKS)
    total = jnp.asarray(BLOCK * BLOCKS)

    def beyond(C: Array) -> Array:
        return _plausible_states(experiment, inner, signal.commands(C, limits), trials)[
            1
        ]

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
    signal: AbstractCommandSignal,
    experiment: Experiment,
    goal: AbstractGoal,
    limits: LimitBox,
    draws: Float[Array, "D p"],
    guards: Float[Array, "G p"],
    cost: Array,
    C: Float[Array, "k m"],
    state: optax.OptState,
    first: Array,
    total: Array,
) -> tuple[Float[Array, "k m"], optax.OptState]:
    """Steps of Adam on the worth at one draw after the other, less what guards pay."""
    beyond = _beyond_of(experiment, narrow_limits(limits))

    near = jax.vmap(experiment.plausible.at)(guards)

    def loss(C: Float[Array, "k m"], z: Float[Array, " p"]) -> Array:
        U, own = signal.commands(C, limits), experiment.belief.at(z)
        states = _trajectories(experiment, U, jnp.concatenate([own[None], near]))
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


def _beyond_of(experiment: Experiment, limits: LimitBox) -> Callable[[Array], Array]:
    """How far machines leave the limits in all of their turns, on average."""
    turn = min(max(1, round(TURN / experiment.period)), experiment.steps)
    turns = experiment.steps // turn

    def one(states: Float[Array, "times n"]) -> Array:
        S = states[: turns * turn].reshape(turns, turn, -1)
        worst = jax.vmap(lambda S: excess(limits, S))(S)
        return jnp.sum(jnp.maximum(worst, 0.0))

    return lambda states: jnp.mean(jax.vmap(one)(states))


def _worth_at(
    experiment: Experiment, goal: AbstractGoal, z: Array, U: Array, states: Array
) -> tuple[Array, Array]:
    """Nats of the goal at one machine, and the scale of the belief after it."""
    scale = posterior_scale(experiment.belief, information(experiment, z, U, states))
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


def _trajectories(experiment: Experiment, U: Array, machines: Array) -> Array:
    """Of every machine, at its virtual values."""
    return jax.vmap(lambda tt: trajectory(experiment, tt, U))(machines)


@compile_async
def _plausible_states(
    experiment: Experiment, limits: LimitBox, U: Array, draws: Array
) -> tuple[Array, Array]:
    """Of plausible machines, and how far each leaves the limits; infinite when lost."""
    states = _trajectories(experiment, U, jax.vmap(experiment.plausible.at)(draws))
    return states, all_excess(limits, states)


sensitivity = eqx.filter_jit(sensitivity_at)


@eqx.filter_jit
def scale_after(experiment: Experiment, U: Array) -> Float[Array, "p p"]:
    """Square root of the covariance that commands leave, at the belief's mean."""
    belief = experiment.belief
    states = trajectory(experiment, belief.mean, U)
    A = information(experiment, jnp.zeros_like(belief.mean), U, states)
    return posterior_scale(belief, A)
