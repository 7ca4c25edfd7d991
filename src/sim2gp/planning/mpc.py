"""Model-predictive control by sampling: plan from the real state at every step.

`MPC` owns the horizon, the rollouts and the warm start; how a batch of returns becomes
a better plan is the update rule's business (`ICEM`, `MPPI`). Plans live in the unit box
``[-1, 1]^m`` and are mapped to the machine's box at the edge.

Long plans find a swing that short ones do not see, and drop the pole that short ones
balance: what noise does to an unstable machine late in a plan says nothing about its
first action. Hence plans of several lengths compete (`promising`), at no cost: a short
plan is the beginning of a long one.
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp import checks
from sim2gp.planning.icem import ICEM
from sim2gp.planning.update import AbstractUpdate, Plan
from sim2gp.planning.world import AbstractPlanner, World, masked, rollout
from sim2gp.types import Action, Box, Key, State


class Underway(eqx.Module):
    """A plan, the sequence that is being executed, and how many steps were made."""

    plan: Plan
    sequence: Float[Array, "H m"]
    steps: Int[Array, ""]


class MPC(AbstractPlanner):
    """Sampling MPC; ``horizon`` None takes the world's planning default (in steps).

    lengths: of the plans that compete, as shares of the horizon.
    every: steps of a plan that are executed before the next one is made.

    Raises `InputError` E148 for a setting that cannot be.
    """

    update: AbstractUpdate = ICEM()
    horizon: int | None = eqx.field(static=True, default=None)
    lengths: tuple[float, ...] = eqx.field(static=True, default=(0.5, 0.75, 1.0))
    every: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        checks.count("MPC", horizon=self.horizon, every=self.every)
        checks.positive_share("MPC", lengths=self.lengths or math.nan)

    def init(self, world: World, *, key: Key) -> Underway:
        box = world.actions
        horizon = self.horizon or world.planning_horizon
        plan = self.update.init(horizon, box.low.size, box.low.dtype)
        return Underway(plan, jnp.zeros_like(plan.mean), jnp.zeros((), int))

    def prepare(
        self, state: Underway, world: World, data: Any, *, key: Key
    ) -> Underway:
        """Forget: a plan made in one world is no start for another."""
        return self.init(world, key=key)

    def act(
        self, state: Underway, world: World, s: State, *, key: Key
    ) -> tuple[Action, Underway]:
        def evaluate(U: Float[Array, "N H m"]) -> tuple[Array, Array]:
            rewards, valid = jax.vmap(
                lambda u: rollout(world, s, from_unit(u, world.actions))
            )(U)
            steps = [max(1, round(x * U.shape[1])) for x in self.lengths]
            return promising(rewards, valid, steps), valid

        def planned() -> tuple[Array, Plan]:
            return self.update.improve(state.plan, evaluate, world, key=key)

        if self.every == 1:
            sequence, plan = planned()
        else:
            kept = state.sequence, state.plan
            sequence, plan = jax.lax.cond(
                state.steps % self.every == 0, planned, lambda: kept
            )
        later = jnp.concatenate([sequence[1:], sequence[-1:]])
        after = Underway(plan.shift(), later, state.steps + 1)
        return from_unit(sequence[:1], world.actions)[0], after

    def failed(self, state: Underway) -> Bool[Array, ""]:
        return state.plan.valid == 0


def promising(
    rewards: Float[Array, "N H"], valid: Bool[Array, " N"], steps: Sequence[int]
) -> Float[Array, " N"]:
    """Returns over the number of steps whose best sequence promises most per step.

    On a tie over the first, that is the shortest one given.
    """
    returns = jnp.stack([jnp.sum(rewards[:, :h], axis=1) for h in steps])
    best = jax.vmap(lambda r: jnp.max(masked(r, valid)))(returns)
    return returns[jnp.argmax(best / jnp.asarray(steps, best.dtype))]


def from_unit(u: Float[Array, "H m"], box: Box) -> Float[Array, "H m"]:
    """Unit-box actions in the machine's units, never outside its box by rounding."""
    middle, half = 0.5 * (box.high + box.low), 0.5 * (box.high - box.low)
    a = middle[None] + half[None] * u
    return jnp.clip(a, box.low[None], box.high[None])
