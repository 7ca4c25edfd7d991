"""Simulators that are not JAX: called back on the host, differentiated by differences.

    s' = f(theta, s, a, h)        f: NumPy, float64, batches of rows
    df = J (dtheta, ds, da),      J by central differences around one point

The derivative is a matrix times its tangent, so it is forward and reverse mode alike.
What crosses between JAX and the host are pairs of 32-bit words: JAX puts a callback's
arguments on a device first, in the thread that it happens to run in, and a thread that
does not know of `in_float64` would round them.

An `InputError` that a simulator raises ends the program that asked; the host raises it
again (`sim2gp.types.in_float64`).
"""

import abc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.inference.parameters import Parameters
from sim2gp.types import Action, AnyArray, Scalar, State

#: What a parameter changes by less, of the largest number, it does not change.
ROUNDING = 16.0 * float(np.finfo(float).eps)
#: Rows whose slopes are found at once: more do not fit the processor's cache.
BLOCK = 1024


@dataclass(frozen=True)
class Differences:
    """How far apart the points are that a simulator is differenced at.

    scale: of each parameter, what a difference is small against; ``low`` and ``high``
        are never crossed.
    constants, states: steps in scales: of parameters, which act weakly within one
        period (rounding rules) and smoothly, and of states and inputs.
    """

    scale: Float[np.ndarray, " p"]
    low: Float[np.ndarray, " p"]
    high: Float[np.ndarray, " p"]
    constants: float = 1e-4
    states: float = 1e-6

    @classmethod
    def of(cls, table: Parameters, names: Sequence[str]) -> "Differences":
        """Of parameters in this order; one that a table does not free never moves."""
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
    low, high = (np.asarray(table.constrain(tt)) for tt in (mean - sd, mean + sd))
    spread: list[float] = (0.5 * np.abs(high - low)).tolist()
    return spread


class Arguments(NamedTuple):
    """What a rollout of ``W`` windows depends on: parameters, starts, inputs, spans."""

    theta: Float[AnyArray, "W p"]
    x0: Float[AnyArray, "W n"]
    u: Float[AnyArray, "W L m"]
    span: Float[AnyArray, "W L"]


class Rolled(NamedTuple):
    """A rollout in ``most`` steps for each row, some of no length."""

    at: Arguments
    inputs: Float[np.ndarray, "W F m"]
    span: Float[np.ndarray, "W F"]
    states: Float[np.ndarray, "W F n"]
    most: int

    @property
    def at_rows(self) -> Float[np.ndarray, "W L n"]:
        """The states at the rows of the windows."""
        return self.states[:, self.most - 1 :: self.most]


class AbstractSimulator(abc.ABC):
    """A simulator on the host; two are equal only if they are the same object.

    ``names`` are those of its parameters ``theta``, in their order.
    """

    names: tuple[str, ...]
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
        """`flow` and its Jacobian in parameters, state and input, in one call."""
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
        # What a parameter changes within rounding it does not change at all.
        nothing = ROUNDING * np.maximum(1.0, np.abs(out[0]).max(axis=1, initial=0.0))
        moved[:p][np.abs(moved[:p]) <= nothing[:, None]] = 0.0
        J = moved / apart[..., None]
        return out[0], np.moveaxis(J, 0, -1)

    def slopes_of_steps(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n pnm"]]:
        """`slopes` of a simulator that divides a time into steps."""
        at = Arguments(theta, s, a[:, None], h[:, None])
        sizes = np.cumsum([theta.shape[1], s.shape[1]])
        of_theta, of_s, of_a = (
            np.broadcast_to(part, (len(s), *part.shape))
            for part in np.split(np.eye(sizes[-1] + a.shape[1]), sizes)
        )
        along = Arguments(of_theta, of_s, of_a[:, None], h)
        states, J = self.linearised_rollout(at, along)
        return states[:, 0], J[:, 0]

    def substeps(self, span: Float[np.ndarray, "*r"]) -> Int[np.ndarray, "*r"]:
        """How many equal steps `slopes` divides each of these times into."""
        return np.ones(span.shape, int)

    def rollout(
        self,
        theta: Float[np.ndarray, "W p"],
        x0: Float[np.ndarray, "W n"],
        u: Float[np.ndarray, "W L m"],
        span: Float[np.ndarray, "W L"],
    ) -> Float[np.ndarray, "W L n"]:
        """States after each row of inputs, which are held for its ``span`` (s)."""
        out = np.empty((*span.shape, x0.shape[1]))
        x = x0
        for k in range(span.shape[1]):
            out[:, k] = x = self.flow(theta, x, u[:, k], span[:, k])
        return out

    def rolled(self, at: Arguments) -> Rolled:
        """`rollout` in steps that can be linearised."""
        counts = self.substeps(at.span)
        most = int(counts.max(initial=1))
        fine = np.arange(most) < counts[..., None]
        fine = np.where(fine, (at.span / counts)[..., None], 0.0)
        fine = fine.reshape(len(fine), -1)
        inputs = np.repeat(at.u, most, axis=1)
        return Rolled(
            at, inputs, fine, self.rollout(at.theta, at.x0, inputs, fine), most
        )

    def linearised(self, run: Rolled, along: Arguments) -> Float[np.ndarray, "W L n k"]:
        """Derivatives of a run's states along ``k`` directions of its arguments.

        ``along`` has their directions in a last axis (its spans are not read). Each row
        is one of the linear recursion ``S' = A S + B`` of its own slopes.
        """
        moves = run.span.any(axis=1)
        if moves.all():
            return self._recursion(run, along)
        out = np.repeat(along.x0[:, None], run.at_rows.shape[1], axis=1)
        if moves.any():
            some_at, u, span, states = jax.tree.map(lambda x: x[moves], run[:-1])
            some = jax.tree.map(lambda x: x[moves], along)
            out[moves] = self._recursion(
                Rolled(some_at, u, span, states, run.most), some
            )
        return out

    def _recursion(self, run: Rolled, along: Arguments) -> Float[np.ndarray, "W L n k"]:
        (theta, x0, *_), inputs, fine, states, most = run
        of_theta, S, of_u, _ = along
        before = np.concatenate([x0[:, None], states[:, :-1]], axis=1)
        W, L, n = states.shape
        p, out = theta.shape[1], np.empty((W, L // most, n, S.shape[-1]))
        block = max(1, BLOCK // W)
        for first in range(0, L, block):
            rows = slice(first, min(first + block, L))
            J = self._slopes_of(theta, before, inputs, fine, states, rows)
            C = J[..., :p] @ of_theta[:, None]
            which = np.arange(rows.start, rows.stop) // most
            C += J[..., p + n :] @ of_u[:, which]
            for k in range(rows.start, rows.stop):
                S = J[:, k - first, :, p : p + n] @ S + C[:, k - first]
                out[:, k // most] = S
        return out

    def linearised_rollout(
        self, at: Arguments, along: Arguments
    ) -> tuple[Float[np.ndarray, "W L n"], Float[np.ndarray, "W L n k"]]:
        """`rollout`, and its derivatives along ``k`` directions of its arguments."""
        run = self.rolled(at)
        return run.at_rows, self.linearised(run, along)

    def _slopes_of(
        self,
        theta: Float[np.ndarray, "W p"],
        before: Float[np.ndarray, "W L n"],
        u: Float[np.ndarray, "W L m"],
        span: Float[np.ndarray, "W L"],
        after: Float[np.ndarray, "W L n"],
        rows: slice,
    ) -> Float[np.ndarray, "W l n pnm"]:
        """The Jacobian of each of some rows."""
        s, a, h, end = (x[:, rows] for x in (before, u, span, after))
        each = np.repeat(theta[:, None], s.shape[1], axis=1)
        B = s.shape[0] * s.shape[1]
        flat = [x.reshape(B, x.shape[-1]) for x in (each, s, a, end)]
        J = self.jacobian(flat[0], flat[1], flat[2], h.reshape(-1), flat[3])
        return J.reshape(*s.shape, -1)

    def jacobian(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
        after: Float[np.ndarray, "B n"],
    ) -> Float[np.ndarray, "B n pnm"]:
        """That of `slopes`, where the states ``after`` are known already."""
        return self.slopes(theta, s, a, h)[1]


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
