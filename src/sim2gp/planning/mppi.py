"""MPPI with the temperature set by the effective sample size.

Williams et al. 2017, doi 10.2514/1.G001921: ``mean <- sum_i w_i A_i`` with
``w_i = softmax(R_i / T)``. A fixed temperature depends on the units of the reward;
here ``T`` solves ``ESS(T) = 1 / sum_i w_i^2 = fraction * N`` by bisection, as in
Monte-Carlo posterior policy iteration (Watson and Peters 2022, arXiv 2210.03512).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim2gp import checks
from sim2gp.planning.coloured_noise import coloured_noise
from sim2gp.planning.update import AbstractUpdate, Evaluate, Plan
from sim2gp.planning.world import World, masked
from sim2gp.types import Key, Scalar

#: Bisections of log T over 28 nepers: more than float32 can resolve.
BISECTIONS = 30


class MPPI(AbstractUpdate):
    """Budget ``samples x horizon x iterations``; None takes the world's default.

    effective: the effective sample size, as a share of the valid samples.
    sd: of the coloured noise, in half-widths of the action box.

    Raises `InputError` E148 for a setting that cannot be.
    """

    samples: int = eqx.field(static=True, default=128)
    iterations: int | None = eqx.field(static=True, default=None)
    effective: float = eqx.field(static=True, default=0.25)
    noise_colour: float | None = eqx.field(static=True, default=None)
    sd: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        checks.count("MPPI", samples=self.samples, iterations=self.iterations)
        checks.positive_share("MPPI", effective=self.effective)
        checks.finite("MPPI", noise_colour=self.noise_colour)
        checks.positive("MPPI", sd=self.sd)

    def init(self, horizon: int, size: int, dtype: jnp.dtype) -> Plan:
        none = jnp.zeros((0, horizon, size), dtype)
        return Plan(jnp.zeros((horizon, size), dtype), none, jnp.asarray(self.samples))

    def improve(
        self, plan: Plan, evaluate: Evaluate, world: World, *, key: Key
    ) -> tuple[Float[Array, "H m"], Plan]:
        rounds = self.iterations or world.planning_iterations
        colour = world.noise_colour if self.noise_colour is None else self.noise_colour

        def body(plan: Plan, key: Key) -> tuple[Plan, Any]:
            mean = plan.mean
            noise = coloured_noise(key, self.samples, mean, colour)
            U = jnp.clip(mean[None] + self.sd * noise, -1.0, 1.0)
            U = U.at[0].set(mean)
            returns, valid = evaluate(U)
            count = jnp.sum(valid)
            weights = softmax_of_size(returns, valid, self.effective)
            moved = jnp.einsum("n,ntm->tm", weights, U)
            mean = jnp.where(count > 0, moved, mean)
            return Plan(mean, plan.elites, count), None

        plan, _ = jax.lax.scan(body, plan, jax.random.split(key, rounds))
        return plan.mean, plan


def softmax_of_size(
    returns: Float[Array, " N"], valid: Bool[Array, " N"], effective: float
) -> Float[Array, " N"]:
    """Softmax weights whose effective size is ``effective`` times the valid count.

    Invalid entries have weight 0 exactly; with none valid all weights are finite, and
    0.
    """
    worst = jnp.min(jnp.where(valid, returns, jnp.finfo(returns.dtype).max))
    gap = jnp.max(masked(returns, valid)) - returns  # >= 0 where valid
    spread = jnp.max(masked(returns, valid)) - worst
    scaled = jnp.where(valid & (spread > 0.0), gap / spread, 0.0)
    target = jnp.maximum(effective * jnp.sum(valid.astype(returns.dtype)), 1.0)

    def weights(log_temperature: Scalar) -> Float[Array, " N"]:
        w = jnp.where(valid, jnp.exp(-scaled * jnp.exp(-log_temperature)), 0.0)
        return w / jnp.maximum(jnp.sum(w), 1.0)  # the best one alone has 1

    def bisect(_: Array, ends: tuple[Scalar, Scalar]) -> tuple[Scalar, Scalar]:
        low, high = ends
        middle = 0.5 * (low + high)
        small = jnp.sum(weights(middle) ** 2) * target > 1.0
        return jnp.where(small, middle, low), jnp.where(small, high, middle)

    ends = jnp.asarray(-14.0, returns.dtype), jnp.asarray(14.0, returns.dtype)
    low, high = jax.lax.fori_loop(0, BISECTIONS, bisect, ends)
    return weights(0.5 * (low + high))
