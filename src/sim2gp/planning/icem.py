"""iCEM: the cross-entropy method with coloured noise and memory.

Pinneri et al. 2020, arXiv 2008.06389. Per control step, ``I`` times: draw ``n``
sequences ``clip(mean + share_j sd * coloured noise)``, replace a few by the best ones
known (and one by the mean, last time round), roll out, keep the ``K`` best; mean and sd
move to theirs. The best sequence seen is executed, not the mean. The shares are ours.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.planning.coloured_noise import coloured_noise
from sim2gp.planning.update import AbstractUpdate, Evaluate, Plan
from sim2gp.planning.world import World, masked
from sim2gp.types import Key


class ICEM(AbstractUpdate):
    """Budget ``samples x horizon x iterations``; None takes the world's default.

    samples: sequences per iteration, the reused ones counted in.
    elites: how many of the best shape the next mean and sd.
    sd: of the noise at the start of every step, in half-widths of the action box.
    finest: the last sequence's noise, as a share of the first one's; between them it
        falls geometrically. Coarse ones find the swing, fine ones keep the balance.
    reuse: share of the elites that compete again, also in the next step.
    smoothing: weight of the old mean and sd in the new.
    decay: above 1, iteration ``i`` draws ``samples / decay^i`` (never under 2 elites).

    Raises `InputError` E148 for a setting that cannot be, more elites than samples too.
    """

    samples: int = eqx.field(static=True, default=160)
    iterations: int | None = eqx.field(static=True, default=None)
    elites: int = eqx.field(static=True, default=16)
    noise_colour: float | None = eqx.field(static=True, default=None)
    sd: float = eqx.field(static=True, default=0.8)
    finest: float = eqx.field(static=True, default=0.2)
    reuse: float = eqx.field(static=True, default=0.3)
    smoothing: float = eqx.field(static=True, default=0.1)
    decay: float = eqx.field(static=True, default=1.0)

    def __check_init__(self) -> None:
        sizes = {"samples": self.samples, "iterations": self.iterations}
        checks.count("ICEM", **sizes, elites=self.elites)
        checks.at_most("ICEM", "samples", elites=self.elites, samples=self.samples)
        checks.finite("ICEM", noise_colour=self.noise_colour)
        checks.positive("ICEM", sd=self.sd, decay=self.decay)
        checks.positive_share("ICEM", finest=self.finest)
        checks.share("ICEM", reuse=self.reuse, smoothing=self.smoothing)

    def init(self, horizon: int, size: int, dtype: jnp.dtype) -> Plan:
        mean = jnp.zeros((horizon, size), dtype)
        elites = jnp.zeros((self.elites, horizon, size), dtype)
        return Plan(mean, elites, jnp.asarray(self.samples))

    def improve(
        self, plan: Plan, evaluate: Evaluate, world: World, *, key: Key
    ) -> tuple[Float[Array, "H m"], Plan]:
        rounds = self.iterations or world.planning_iterations
        colour = world.noise_colour if self.noise_colour is None else self.noise_colour
        plan = self.search(plan, evaluate, rounds=rounds, colour=colour, key=key)
        return plan.elites[0], plan

    def search(
        self, plan: Plan, evaluate: Evaluate, *, rounds: int, colour: float, key: Key
    ) -> Plan:
        """So many rounds on anything that has returns; the best one known leads."""
        keys = jax.random.split(key, rounds)
        last = jnp.arange(rounds) == rounds - 1
        sd = jnp.full_like(plan.mean, self.sd)

        def body(carry: Any, inputs: Any, samples: int = self.samples) -> Any:
            (plan, sd), (key, last) = carry, inputs
            return self._iterate(plan, sd, key, last, samples, evaluate, colour), None

        carry = (plan, sd)
        if self.decay == 1.0:
            carry, _ = jax.lax.scan(body, carry, (keys, last))
        else:  # shapes differ between the iterations: they cannot share one body
            for i in range(rounds):
                samples = max(2 * self.elites, int(self.samples / self.decay**i))
                carry, _ = body(carry, (keys[i], last[i]), samples)
        found: Plan = carry[0]
        return found

    def _iterate(
        self,
        plan: Plan,
        sd: Float[Array, "H m"],
        key: Key,
        last: Array,
        samples: int,
        evaluate: Evaluate,
        colour: float,
    ) -> tuple[Plan, Float[Array, "H m"]]:
        """One round: sample, evaluate, move mean and sd to the elites."""
        mean = plan.mean
        noise = coloured_noise(key, samples, mean, colour)
        share = jnp.geomspace(1.0, self.finest, samples).astype(mean.dtype)
        U = jnp.clip(mean[None] + share[:, None, None] * sd[None] * noise, -1.0, 1.0)
        reused = int(self.reuse * self.elites)
        U = U.at[samples - reused :].set(plan.elites[:reused])
        U = U.at[0].set(jnp.where(last, mean, U[0]))

        returns, valid = evaluate(U)
        _, best = jax.lax.top_k(masked(returns, valid), self.elites)
        good = valid[best]
        count = jnp.sum(good)
        # An invalid sequence may rank among the elites, but it neither moves the
        # distribution nor is ever reused: the mean replaces it.
        weight = good.astype(mean.dtype)
        weight = weight / jnp.maximum(jnp.sum(weight), 1.0)
        centre = jnp.einsum("k,ktm->tm", weight, U[best])
        variance = jnp.einsum("k,ktm->tm", weight, (U[best] - centre[None]) ** 2)
        old = self.smoothing
        blended = old * mean + (1.0 - old) * centre
        new_mean = jnp.where(count > 0, blended, mean)
        new_sd = jnp.where(count > 1, old * sd + (1.0 - old) * jnp.sqrt(variance), sd)
        elites = jnp.where(good[:, None, None], U[best], new_mean[None])
        return Plan(new_mean, elites, jnp.sum(valid)), new_sd
