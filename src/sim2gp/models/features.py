"""Features for neural linear models: encoded inputs and a small network.

    phi(x) = [tanh(... tanh(enc(x) A + a) ...) ; 1] / sqrt(m)

Weights and training are in float32; `Network` computes in the precision of its input,
so that posteriors on top of it are exact in float64. Bounded smooth units: outside the
data a feature goes flat, it does not extrapolate along a line.
"""

import math
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp import checks
from sim2gp.data.transitions import Transitions
from sim2gp.systems.base import AbstractSystem, index_of
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Action, Key, State

#: Half-width of a channel without limits, by its unit: how far a small machine moves.
REACH = {"rad": math.pi, "rad/s": 20.0, "m": 1.0, "m/s": 2.0}
HELD_OUT = 5  # one chunk of rows in so many
CHUNK = 5  # rows; neighbours in time are too alike to judge each other
SPLIT = 0  # names the split; another number is another split


class Encoding(eqx.Module):
    """``(s, a)`` as network inputs of order one: angles as (sin, cos), the rest scaled.

    ``low`` and ``high`` are also the box in which a prior over functions is compared.
    """

    angle: tuple[bool, ...] = eqx.field(static=True)
    low: tuple[float, ...] = eqx.field(static=True)
    high: tuple[float, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    outputs: int = eqx.field(static=True)  # physical states
    history: int = eqx.field(static=True)  # past actions among the inputs

    @classmethod
    def of(cls, system: AbstractSystem, reach: Mapping[str, float]) -> "Encoding":
        """From the channels' limits; ``reach`` gives half-widths for some by name.

        A channel with neither takes `REACH` of its unit, or 1. Raises `InputError`
        E103 for an unknown name, E148 for a half-width that is not positive.
        """
        checks.positive("reach", **reach)
        channels = (*system.states, *system.actions)
        for name in reach:
            index_of(name, channels, where="reach")
        low, high = [], []
        for channel in channels:
            half = reach.get(channel.name, REACH.get(channel.unit, 1.0))
            limited = math.isfinite(channel.low) and math.isfinite(channel.high)
            given = channel.name in reach or not limited
            low.append(-half if given else channel.low)
            high.append(half if given else channel.high)
        angles, names = ([getattr(c, x) for c in channels] for x in ("angle", "name"))
        outputs = len(system.physical_states)
        box = tuple(low), tuple(high), tuple(names)
        return cls(tuple(angles), *box, outputs, system.history)

    @property
    def size(self) -> int:
        """Number of encoded inputs."""
        return len(self.angle) + sum(self.angle)

    def __call__(self, s: State, a: Action) -> Float[Array, " e"]:
        parts = []
        for i, x in enumerate([*s, *a]):
            if self.angle[i]:
                parts += [sine(x), cosine(x)]
            else:
                middle = 0.5 * (self.low[i] + self.high[i])
                parts.append((x - middle) / (0.5 * (self.high[i] - self.low[i])))
        return jnp.stack(parts)

    def box(self) -> dict[str, tuple[float, float]]:
        """Each channel's range, by name."""
        pairs = zip(self.low, self.high, strict=True)
        return dict(zip(self.names, pairs, strict=True))

    def half_widths(self) -> Float[Array, " d"]:
        """Half the box of each physical state."""
        pairs = zip(self.low, self.high, strict=True)
        return jnp.asarray([0.5 * (high - low) for low, high in pairs])[: self.outputs]


def check_training(
    where: str, hidden: tuple[int, ...], *, steps: int, refit_steps: int
) -> None:
    """That a network has layers, and a number of steps of training (E148)."""
    checks.count(where, hidden=hidden or math.nan)
    checks.whole(where, steps=steps, refit_steps=refit_steps)


class Network(eqx.Module):
    """The feature map: tanh layers, then a constant, so that ``|phi| <= 1``."""

    weights: tuple[Float[Array, "_ _"], ...]
    biases: tuple[Float[Array, " _"], ...]

    @classmethod
    def random(cls, key: Key, inputs: int, hidden: tuple[int, ...]) -> "Network":
        """Float32 weights of variance 2 / inputs, biases of sd 1/2: varied features."""
        weights, biases = [], []
        for width in hidden:
            key, a, b = jax.random.split(key, 3)
            W = jax.random.normal(a, (inputs, width), jnp.float32)
            weights.append(W * math.sqrt(2.0 / inputs))
            biases.append(0.5 * jax.random.normal(b, (width,), jnp.float32))
            inputs = width
        return cls(tuple(weights), tuple(biases))

    @property
    def features(self) -> int:
        """Number of features, the constant included."""
        return self.biases[-1].size + 1

    def __call__(self, x: Float[Array, " e"]) -> Float[Array, " m"]:
        for W, b in zip(self.weights, self.biases, strict=True):
            x = jnp.tanh(x @ W.astype(x.dtype) + b.astype(x.dtype))
        return jnp.concatenate([x, jnp.ones(1, x.dtype)]) / math.sqrt(self.features)


def stepped(s: State, a: Action, delta: Float[Array, " d"]) -> State:
    """``s + delta`` on the physical states; carried past actions move one place on."""
    d = delta.size
    past = jnp.concatenate([a, s[d:]])[: s.size - d]
    return jnp.concatenate([s[:d] + delta, past])


def held_out_rows(mask: Bool[Array, " N"]) -> Bool[Array, " N"]:
    """One chunk of `CHUNK` successive rows in every `HELD_OUT`, at random places.

    A row stays in its set when data grow, for any capacity: a warm start has
    seen the training rows, so a new split would leak them. Of fewer rows than a chunk
    one is held out, of one none.
    """
    row = jnp.arange(len(mask))
    chunk = row // CHUNK
    groups = len(mask) // (CHUNK * HELD_OUT) + 1
    with jax.ensure_compile_time_eval():  # no data in it: every program gets numbers
        places = jax.vmap(
            lambda group: jax.random.randint(
                jax.random.fold_in(jax.random.key(SPLIT), group), (), 0, HELD_OUT
            )
        )(jnp.arange(groups))
    out = mask & (chunk % HELD_OUT == places[chunk // HELD_OUT])
    enough = jnp.any(out) & jnp.any(mask & ~out)
    return jnp.where(enough, out, mask & (row == 0) & (jnp.sum(mask) > 1))


def encoded(
    encoding: Encoding, data: Transitions
) -> tuple[Float[Array, "N e"], Float[Array, "N d"]]:
    """Encoded inputs and increments of the physical states, masked rows zero."""
    mask = data.mask[:, None]
    X = jax.vmap(encoding)(data.state, data.action)
    y = data.delta()[:, : encoding.outputs]
    return jnp.where(mask, X, 0.0), jnp.where(mask, y, 0.0)


class Minibatches(eqx.Module):
    """Rows in a random order; a batch is a window of it, and all of few data."""

    order: Int[Array, " N"]
    count: Int[Array, ""]

    @classmethod
    def shuffled(cls, key: Key, rows: Bool[Array, " N"]) -> "Minibatches":
        """A new order of the chosen rows."""
        keys = jnp.where(rows, jax.random.uniform(key, rows.shape), 2.0)
        return cls(jnp.argsort(keys), jnp.sum(rows))

    def batch(self, t: Int[Array, ""], size: int) -> tuple[Array, Array]:
        """Indices and validity of batch ``t``; no row appears twice in it."""
        size = min(size, self.order.size)
        places = jnp.arange(size)
        start = jnp.where(self.count > size, t * size, 0)
        wrapped = (start + places) % jnp.maximum(self.count, 1)
        return self.order[wrapped], places < self.count
