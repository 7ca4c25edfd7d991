"""Model-predictive control by sampling: plan from the real state at every step.

`MPC` owns the horizon, the rollouts and the warm start; how a batch of returns becomes
a better plan is the update rule's business (`ICEM`, `MPPI`). Plans live in the unit box
``[-1, 1]^m`` and are mapped to the machine's box at the edge.

Long plans find a swing that short ones do not see, and drop the pole that short ones
balance: what noise does to an unstable machine late in a plan says nothing about its
first action. Hence plans of several lengths compete (`promising`), at no cost: a short
plan is the beginning of a long one.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim2gp.planning.base import AbstractPlanner, World, masked, rollout
from sim2gp.planning.icem import ICEM
from sim2gp.planning.update import AbstractUpdate, Plan
from sim2gp.types import Action, Box, Key, State


class MPC(AbstractPlanner):
    """Sampling MPC; ``horizon`` None takes the world's planning default (in steps).

    lengths: of the plans that compete, as shares of the horizon.
    """

    update: AbstractUpdate = ICEM()
    horizon: int | None = eqx.field(static=True, default=None)
    lengths: tuple[float, ...] = eqx.field(static=True, default=(0.5, 0.75, 1.0))

    def init(self, world: World, *, key: Key) -> Plan:
        box = world.actions
        horizon = self.horizon or world.planning_horizon
        return self.update.init(horizon, box.low.size, box.low.dtype)

    def prepare(self, state: Plan, world: World, data: Any, *, key: Key) -> Plan:
        """Forget: a plan made in one world is no start for another."""
        return self.init(world, key=key)

    def act(
        self, state: Plan, world: World, s: State, *, key: Key
    ) -> tuple[Action, Plan]:
        def evaluate(U: Float[Array, "N H m"]) -> tuple[Array, Array]:
            rewards, valid = jax.vmap(
                lambda u: rollout(world, s, from_unit(u, world.actions))
            )(U)
            steps = [max(1, round(x * U.shape[1])) for x in self.lengths]
            return promising(rewards, valid, steps), valid

        sequence, plan = self.update.improve(state, evaluate, world, key=key)
        return from_unit(sequence[:1], world.actions)[0], plan.shift()

    def failed(self, state: Plan) -> Bool[Array, ""]:
        return state.valid == 0


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
