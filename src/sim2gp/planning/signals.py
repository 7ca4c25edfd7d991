"""Open-loop excitation, played from an episode's start to its end without feedback.

The usual signals of identification, to compare an explorer with: coloured noise, a
chirp, and a multisine whose amplitudes and phases are optimised for the objective. All
signals live in the unit box ``[-1, 1]^m``; frequencies are in cycles per step.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp import checks
from sim2gp.planning.coloured_noise import coloured_noise
from sim2gp.planning.icem import ICEM
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.update import AbstractUpdate
from sim2gp.planning.world import AbstractPlanner, World, masked, rollout
from sim2gp.types import Action, Key, State


class Tape(eqx.Module):
    """A signal, how far it has been played, and whether it rests on any prediction."""

    signal: Float[Array, "T m"]
    position: Int[Array, ""]
    blind: Bool[Array, ""]

    @classmethod
    def of(cls, signal: Float[Array, "T m"], blind: Any = False) -> "Tape":
        return cls(signal, jnp.zeros((), int), jnp.asarray(blind))


class AbstractSignal(AbstractPlanner):
    """A planner that decides once, in `prepare`, and then plays."""

    def init(self, world: World, *, key: Key) -> Tape:
        del key
        low = world.actions.low
        return Tape.of(jnp.zeros((world.horizon, low.size), low.dtype))

    def act(
        self, state: Tape, world: World, s: State, *, key: Key
    ) -> tuple[Action, Tape]:
        row = jax.lax.dynamic_slice_in_dim(state.signal, state.position, 1)
        played = eqx.tree_at(lambda t: t.position, state, state.position + 1)
        return from_unit(row, world.actions)[0], played

    def failed(self, state: Tape) -> Bool[Array, ""]:
        return state.blind


class RandomInput(AbstractSignal):
    """Coloured noise, clipped to the box; ``sd`` in half-widths of it (E148)."""

    colour: float = eqx.field(static=True, default=1.0)
    sd: float = eqx.field(static=True, default=0.5)

    def __check_init__(self) -> None:
        checks.finite("RandomInput", colour=self.colour)
        checks.positive("RandomInput", sd=self.sd)

    def prepare(self, state: Tape, world: World, data: Any, *, key: Key) -> Tape:
        noise = coloured_noise(key, 1, state.signal, self.colour)[0]
        return Tape.of(jnp.clip(self.sd * noise, -1.0, 1.0))


class Chirp(AbstractSignal):
    """A sine whose frequency rises by the same factor each second; its phase is drawn.

    The inputs of a machine with several start a half-turn over their number apart.
    Raises `InputError` E148 for a frequency or an amplitude that cannot be, E141 where
    the lowest frequency is not below the highest.
    """

    lowest: float = eqx.field(static=True, default=2e-3)
    highest: float = eqx.field(static=True, default=0.1)
    amplitude: float = eqx.field(static=True, default=0.9)

    def __check_init__(self) -> None:
        checks.positive("Chirp", lowest=self.lowest, highest=self.highest)
        checks.bounds("frequencies of Chirp", self.lowest, self.highest)
        checks.positive_share("Chirp", amplitude=self.amplitude)

    def prepare(self, state: Tape, world: World, data: Any, *, key: Key) -> Tape:
        T, m = state.signal.shape
        ratio = math.log(self.highest / self.lowest)
        t = jnp.arange(T, dtype=state.signal.dtype)
        cycles = self.lowest * T / ratio * jnp.expm1(ratio * t / T)
        phase = jax.random.uniform(key, (), state.signal.dtype)
        phase = phase + 0.5 * jnp.arange(m, dtype=state.signal.dtype) / m
        angle = 2.0 * jnp.pi * (cycles[:, None] + phase[None])
        return Tape.of(self.amplitude * jnp.sin(angle))


class Multisine(AbstractSignal):
    """A sum of sines, amplitudes and phases chosen by what the world says they earn.

    tones: how many, evenly spaced up to ``highest`` (E148).
    """

    tones: int = eqx.field(static=True, default=8)
    highest: float = eqx.field(static=True, default=0.06)
    update: AbstractUpdate = ICEM(samples=64, iterations=16, elites=8, noise_colour=0.0)

    def __check_init__(self) -> None:
        checks.count("Multisine", tones=self.tones)
        checks.positive("Multisine", highest=self.highest)

    def prepare(self, state: Tape, world: World, data: Any, *, key: Key) -> Tape:
        return _optimised(self, state, world, key)

    def signal(self, C: Float[Array, "_ m"], steps: int) -> Float[Array, "T m"]:
        """Of coefficients of all cosines, then all sines; never larger than the box."""
        t = jnp.arange(steps, dtype=C.dtype)
        frequency = self.highest * jnp.arange(1, self.tones + 1, dtype=C.dtype)
        angle = 2.0 * jnp.pi * t[:, None] * frequency[None] / self.tones
        raw = jnp.concatenate([jnp.cos(angle), jnp.sin(angle)], axis=1) @ C
        return raw / jnp.maximum(1.0, jnp.max(jnp.abs(raw), axis=0, keepdims=True))


@eqx.filter_jit
def _optimised(planner: Multisine, state: Tape, world: World, key: Key) -> Tape:
    T, m = state.signal.shape
    first, search = jax.random.split(key)
    s = world.reset(first)

    def evaluate(C: Float[Array, "N k m"]) -> tuple[Array, Array]:
        def one(c: Array) -> tuple[Array, Array]:
            return rollout(world, s, from_unit(planner.signal(c, T), world.actions))

        rewards, valid = jax.vmap(one)(C)
        return masked(jnp.sum(rewards, axis=1), valid), valid

    plan = planner.update.init(2 * planner.tones, m, state.signal.dtype)
    best, plan = planner.update.improve(plan, evaluate, world, key=search)
    return Tape.of(planner.signal(best, T), plan.valid == 0)
