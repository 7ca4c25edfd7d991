"""What a machine may be asked to do: limits of inputs, their rates, and its states.

Commands keep their limits exactly, by construction; states keep them as far as the
belief can predict.
"""

import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.errors import InputError, error
from sim2gp.systems.base import AbstractSystem, index_of
from sim2gp.systems.machine import plant_of

Pairs = Mapping[str, tuple[float, float]]
MARGIN = 0.05  # of a box's half, kept free while searching
SLOW = 3.0  # s, in which the target of a servo crosses its range at the fastest


class LimitBox(eqx.Module):
    """Boxes of the inputs and the states, and the largest change of a command per s."""

    low: Float[np.ndarray, " m"]
    high: Float[np.ndarray, " m"]
    rate: Float[np.ndarray, " m"]
    state_low: Float[np.ndarray, " n"]
    state_high: Float[np.ndarray, " n"]

    @classmethod
    def of(
        cls,
        system: AbstractSystem,
        stated: Pairs,
        rates: Mapping[str, float],
        *,
        start: np.ndarray,
    ) -> "LimitBox":
        """The channels' own limits, narrowed by what is stated by name.

        Raises `InputError` E103 for an unknown name, E150 where nothing may move: an
        input that is not limited or cannot be zero, a rate that is not positive, a
        start that is outside.
        """
        states, inputs = system.physical_states, system.actions
        names = [channel.name for channel in (*states, *inputs)]
        for name in stated:
            index_of(name, (*states, *inputs), where="limits")
        for name in rates:
            index_of(name, inputs, where="rates")
        box = {c.name: (c.low, c.high) for c in (*states, *inputs)}
        for name, (low, high) in stated.items():
            box[name] = max(low, box[name][0]), min(high, box[name][1])
        for channel in inputs:
            low, high = box[channel.name]
            if not (math.isfinite(low) and math.isfinite(high)):
                raise _no_motion(channel.name, low, high, "finite limits", "state them")
            if not low < high or low > 0.0 or high < 0.0:
                raise _no_motion(
                    channel.name, low, high, "a range with 0 in it", "widen it"
                )
            if not rates.get(channel.name, math.inf) > 0.0:
                got = f"{rates[channel.name]:g} {channel.unit}/s"
                raise error("rate_admits_no_motion", got=got, name=channel.name)
        for channel, x in zip(states, start.tolist(), strict=True):
            low, high = box[channel.name]
            if not low < x < high:
                expected = f"a range with the start, {x:g} {channel.unit}, inside"
                raise _no_motion(channel.name, low, high, expected, "widen it")
        pairs = np.asarray([box[name] for name in names])
        n = len(states)
        rate = np.asarray([rates.get(c.name, math.inf) for c in inputs])
        return cls(pairs[n:, 0], pairs[n:, 1], rate, pairs[:n, 0], pairs[:n, 1])

    def stated(self) -> bool:
        """Whether any state is limited at all."""
        return bool(
            np.isfinite(self.state_low).any() | np.isfinite(self.state_high).any()
        )


def input_ranges(
    system: AbstractSystem,
) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Limits of the inputs; a servo's target stays within its joint's range, too."""
    plant = plant_of(system)
    servos, drives = (getattr(plant, name, {}) for name in ("servos", "drives"))
    joints = {c.name: c for c in system.physical_states}
    low, high = [], []
    for channel in system.actions:
        a, b = channel.low, channel.high
        if channel.name in servos:
            joint = joints.get(drives.get(channel.name, ""))
            if joint is not None and channel.unit == joint.unit:
                a, b = max(a, joint.low), min(b, joint.high)
        low.append(a)
        high.append(b)
    return np.asarray(low), np.asarray(high)


def servo_rates(system: AbstractSystem) -> dict[str, float]:
    """How fast targets of servos may change where nothing is stated, per second.

    A target that jumps drives a servo to its largest torque.
    """
    servos = getattr(plant_of(system), "servos", ())
    low, high = input_ranges(system)
    rates = zip(system.actions, ((high - low) / SLOW).tolist(), strict=True)
    return {c.name: rate for c, rate in rates if c.name in servos and rate < math.inf}


def excess(limits: LimitBox, states: Float[Array, "T n"]) -> Float[Array, ""]:
    """How far a trajectory leaves the box at worst, in halves of it; below 0 inside.

    It is -1 in the middle of the box, and where nothing limits the states.
    """
    half = 0.5 * (limits.state_high - limits.state_low)
    half = jnp.where(jnp.isfinite(half), half, 1.0)
    over = jnp.maximum(
        states - limits.state_high[None], limits.state_low[None] - states
    )
    return jnp.max(jnp.maximum(over / half[None], -1.0))


def all_excess(limits: LimitBox, states: Float[Array, "K T n"]) -> Float[Array, " K"]:
    """`excess` of each machine; infinite where its simulation is lost."""
    beyond = jax.vmap(lambda S: excess(limits, S))(states)
    return jnp.where(jnp.isfinite(beyond), beyond, jnp.inf)


def narrow_limits(limits: LimitBox) -> LimitBox:
    """With a little of the states' box kept free at each end."""
    low, high = limits.state_low, limits.state_high
    off = 0.5 * MARGIN * jnp.where(jnp.isfinite(high - low), high - low, 0.0)
    box = low + off, high - off
    return eqx.tree_at(lambda l: (l.state_low, l.state_high), limits, box)


def clip_commands(
    limits: LimitBox, U: Float[Array, "T m"], period: float
) -> Float[Array, "T m"]:
    """The nearest commands that a machine at rest may be given, one after the other."""
    step = limits.rate * period

    def follow(last: Array, u: Array) -> tuple[Array, Array]:
        u = jnp.clip(
            u,
            jnp.maximum(limits.low, last - step),
            jnp.minimum(limits.high, last + step),
        )
        return u, u

    return jax.lax.scan(follow, jnp.zeros_like(U[0]), U)[1]


def _no_motion(
    name: str, low: float, high: float, expected: str, fix: str
) -> InputError:
    got = f"[{low:g}, {high:g}]"
    return error("no_motion_in_limits", got=got, expected=expected, fix=fix, name=name)
