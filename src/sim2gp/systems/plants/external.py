"""Simulators that are not JAX: called back on the host, differentiated by differences.

    s' = f(theta, s, a, h)        f: NumPy, float64, batches of rows
    df = J (dtheta, ds, da),      J by central differences around one point

The derivative is a matrix times its tangent, so it is forward and reverse mode alike.
What crosses between JAX and the host are pairs of 32-bit words: JAX puts a callback's
arguments on a device first, in whatever thread it runs in, and a thread that does not
know of `in_float64` would round them.

An `InputError` that a simulator raises ends the program that asked; the host raises it
again (`sim2gp.types.in_float64`).
"""

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.inference.parameters import Parameters
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.machine import plant_of
from sim2gp.types import Action, Scalar, State

#: What a constant changes by less, of the largest number, it does not change.
ROUNDING = 16.0 * float(np.finfo(float).eps)


@dataclass(frozen=True)
class Differences:
    """How far apart the points are that a simulator is differenced at.

    scale: of each constant, what a difference is small against; ``low`` and ``high``
        are never crossed.
    constants, states: steps in scales: of constants, which act weakly within one period
        (rounding rules) and smoothly, and of states and inputs.
    """

    scale: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    constants: float = 1e-4
    states: float = 1e-6

    @classmethod
    def of(cls, table: Parameters, names: Sequence[str]) -> "Differences":
        """Of constants in this order; one that a table does not free is never moved."""
        free = {p.name: p for p in table.free}
        given = [free.get(name) for name in names]
        spread = dict(zip(table.names, _spreads(table), strict=True))
        return cls(
            np.asarray([spread.get(name, 1.0) for name in names]),
            np.asarray([p.low if p else -np.inf for p in given]),
            np.asarray([p.high if p else np.inf for p in given]),
        )


def _spreads(table: Parameters) -> list[float]:
    """Half the distance between the prior's quantiles of an sd, in physical units."""
    mean, sd = (np.asarray([getattr(p, x) for p in table.free]) for x in ("mean", "sd"))
    # One program: operation by operation takes half a second.
    with jax.enable_x64(True):
        ends = jax.jit(jax.vmap(table.constrain))(np.stack([mean - sd, mean + sd]))
    spread: list[float] = (0.5 * np.abs(ends[1] - ends[0])).tolist()
    return spread


class AbstractSimulator(abc.ABC):
    """A simulator on the host; two are equal only if they are the same object."""

    differences: Differences

    @abc.abstractmethod
    def flow(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        """States ``h`` seconds later; NaN where the simulator cannot follow."""

    def slopes(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n pnm"]]:
        """`flow` and its Jacobian in constants, state and input, in one call."""
        x = np.concatenate([theta, s, a], axis=1)
        p, n, m = theta.shape[1], s.shape[1], a.shape[1]
        by = self.differences
        of_theta = by.constants * np.broadcast_to(by.scale, theta.shape)
        of_rest = by.states * np.maximum(1.0, np.abs(x[:, p:]))
        step = np.concatenate([of_theta, of_rest], axis=1)
        K = p + n + m
        sides = np.eye(K)[:, None, :] * step[None]  # (K, B, K)
        points = np.concatenate([x[None], x + sides, x - sides])  # (1 + 2 K, B, K)
        # A value that is known may lie beyond the bounds of others: it stays.
        low, high = np.minimum(by.low, theta), np.maximum(by.high, theta)
        points[..., :p] = np.clip(points[..., :p], low, high)
        rows = points.reshape(-1, K)
        times = np.tile(h, len(points))
        out = self.flow(rows[:, :p], rows[:, p : p + n], rows[:, p + n :], times)
        out = out.reshape(len(points), len(x), n)
        up, down = out[1 : K + 1], out[K + 1 :]
        apart = np.einsum("kbk->kb", points[1 : K + 1] - points[K + 1 :])
        moved = up - down
        # What a constant changes within rounding it does not change at all.
        nothing = ROUNDING * np.maximum(1.0, np.abs(out[0]).max(axis=1, initial=0.0))
        moved[:p][np.abs(moved[:p]) <= nothing[:, None]] = 0.0
        J = moved / apart[..., None]
        return out[0], np.moveaxis(J, 0, -1)


def on_host(system: AbstractSystem) -> bool:
    """Whether a simulator here moves it, which tells all slopes or none."""
    found = plant_of(system)
    engine = isinstance(getattr(found, "engine", None), AbstractSimulator)
    return engine and getattr(found, "mjx", None) is None


def untouched(
    theta: Float[np.ndarray, "B p"],
    s: Float[np.ndarray, "B n"],
    a: Float[np.ndarray, "B m"],
    h: Float[np.ndarray, " B"],
) -> tuple[Float[np.ndarray, "B n"], Bool[np.ndarray, " B"]]:
    """States as they are, NaN where anything is not finite; and where all is."""
    good = np.isfinite(np.concatenate([theta, s, a, h[:, None]], axis=1)).all(1)
    return np.where(good[:, None], s, np.nan), good


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def flow(
    simulator: AbstractSimulator,
    theta: Float[Array, " p"],
    s: State,
    a: Action,
    h: Scalar,
) -> State:
    """``f(theta, s, a, h)``; no derivative is taken in ``h``."""
    return _asked(lambda *x: (simulator.flow(*x),), [s.shape], theta, s, a, h)[0]


@flow.defjvp
def _(simulator: AbstractSimulator, primals: Any, tangents: Any) -> Any:
    theta, s, a, _ = primals
    shapes = [s.shape, (s.size, theta.size + s.size + a.size)]
    value, J = _asked(simulator.slopes, shapes, *primals)
    return value, J @ jnp.concatenate(tangents[:3])


def _asked(
    f: Callable[..., tuple[np.ndarray, ...]],
    shapes: Sequence[tuple[int, ...]],
    *args: Array,
) -> list[Array]:
    """What the host finds of one point; a batch of points is one call."""
    dtype = args[0].dtype
    ranks = [x.ndim for x in args]

    def host(*words: Array) -> list[np.ndarray]:
        found = [_numbers_of(np.asarray(w), dtype) for w in words]
        lead = found[0].shape[: found[0].ndim - ranks[0]]
        count = math.prod(lead)  # a system without inputs has rows of no numbers
        rows = [
            x.astype(np.float64).reshape(count, *x.shape[len(lead) :]) for x in found
        ]
        out = f(*rows)
        return [_words_of(x.astype(dtype).reshape(*lead, *x.shape[1:])) for x in out]

    wide = (2,) if dtype == jnp.float64 else ()
    kinds = [jax.ShapeDtypeStruct((*shape, *wide), jnp.uint32) for shape in shapes]
    words = [jax.lax.bitcast_convert_type(x, jnp.uint32) for x in args]
    found = jax.pure_callback(host, kinds, *words, vmap_method="broadcast_all")
    return [jax.lax.bitcast_convert_type(x, dtype) for x in found]


def _numbers_of(words: np.ndarray, dtype: Any) -> np.ndarray:
    """The inverse of `_words_of`: 32-bit words, of float64 two in a last axis."""
    words = np.asarray(words, order="C")  # of a scalar, `ascontiguousarray` makes a row
    return words.view(dtype)[..., 0] if dtype == jnp.float64 else words.view(dtype)


def _words_of(x: np.ndarray) -> np.ndarray:
    x = np.asarray(x, order="C")
    wide = (2,) if x.dtype == np.float64 else ()
    return x.view(np.uint32).reshape(*x.shape, *wide)
