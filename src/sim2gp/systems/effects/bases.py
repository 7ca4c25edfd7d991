"""Functions of one variable that are linear in weights: bases of missing forces.

    f(z) = sum_k w_k phi_k(z),        w_k ~ N(0, S_k)

On an interval these are the reduced-rank features of a squared-exponential kernel
(Solin and Sarkka 2020, Statistics and Computing 30), zero at its ends and beyond:

    phi_k(z) = sin(k pi (z + L) / 2L),
    S_k      = sqrt(2 pi) l / L exp(-1/2 (l k pi / 2L)^2)
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.linalg import library
from sim2gp.systems.effects.friction_laws import dead_zone
from sim2gp.types import AnyArray

#: Of the interval and of the kernel's length, in half-widths of where a machine moves.
REACH, LENGTH = 2.5, 1.0
COUNT = 6  # of features
SOFT = 0.05  # of a dead zone's width: how soon it ends, its median
SHAPE_SD = 0.6  # of the logarithms of a dead zone's width and of this softness

#: One value, or a batch of them in NumPy.
Points = Float[AnyArray, "*b"]


@dataclass(frozen=True)
class Sines:
    """``sin(k w (z - start))``, ``k = 1..count``, on ``span``; constant beyond it.

    With ``cosines`` those too, after the sines. ``sds`` are those of the weights of a
    function whose own sd is one. Of NumPy arrays, points may come in batches.
    """

    frequency: float
    sds: tuple[float, ...]
    start: float = 0.0
    span: float = math.inf
    cosines: bool = False

    def value(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """The function with weights ``x``."""
        xp, (angle, _) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        if not self.cosines:
            return sine * _clenshaw(x, cosine)[0]
        half = len(self.sds) // 2
        first, second = _clenshaw(x[half:], cosine)
        return sine * _clenshaw(x[:half], cosine)[0] + cosine * first - second

    def slope(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """Its derivative."""
        xp, (angle, rate) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        half = len(self.sds) // 2 if self.cosines else len(self.sds)
        k = np.arange(1, half + 1)
        first, second = _clenshaw((x[:half].T * k.astype(x.dtype)).T, cosine)
        slope = cosine * first - second
        if self.cosines:
            others = (x[half:].T * k.astype(x.dtype)).T
            slope = slope - sine * _clenshaw(others, cosine)[0]
        return rate * slope

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b k"]:
        """Its values for each weight alone."""
        xp, (angle, _) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        half = len(self.sds) // 2 if self.cosines else len(self.sds)
        found = _multiples(xp.zeros_like(sine), sine, cosine, half)
        if self.cosines:
            found += _multiples(xp.ones_like(cosine), cosine, cosine, half)
        return xp.stack(found, axis=-1)

    def _angle(self, z: Points) -> tuple[Points, AnyArray]:
        """``w (z - start)``, and its derivative."""
        xp, end = library(z), self.start + self.span
        w = xp.asarray(self.frequency, z.dtype)
        if not math.isfinite(end):
            return w * (z - self.start), w
        inside = (z > self.start) & (z < end)
        angle = w * (xp.clip(z, self.start, end) - self.start)
        return angle, xp.where(inside, w, xp.zeros_like(w))


def _clenshaw(x: Float[AnyArray, "k *b"], cosine: Points) -> tuple[Points, Points]:
    """``b_1`` and ``b_2`` of Clenshaw's recurrence.

    ``sum x_k sin(k a) = b_1 sin(a)`` and ``sum x_k cos(k a) = b_1 cos(a) - b_2``: one
    sine and one cosine, and nothing that must be kept.
    """
    first, second = x[-1] + 0.0 * cosine, 0.0 * cosine
    for k in range(len(x) - 2, -1, -1):
        first, second = x[k] + 2.0 * cosine * first - second, first
    return first, second


def _multiples(none: Points, one: Points, cosine: Points, count: int) -> list[Points]:
    """``sin(k a)`` or ``cos(k a)`` for ``k = 1..count``, by Chebyshev's recurrence.

    From those of ``k = 0`` and ``1``: XLA takes one sine at a time, eight times as long
    as a product.
    """
    found = [none, one]
    for _ in range(count - 1):
        found.append(2.0 * cosine * found[-1] - found[-2])
    return found[1:]


def smooth(
    low: float,
    high: float,
    *,
    count: int = COUNT,
    reach: float = REACH,
    length: float = LENGTH,
) -> Sines:
    """Smooth functions where a machine moves, ``low`` to ``high``, and beyond.

    There is room on both sides: functions fall to zero where the data end, not before.
    ``reach`` and ``length`` (of the kernel) are in half-widths.
    """
    half = 0.5 * (high - low)
    L, l = reach * half, length * half
    w, top = 0.5 * math.pi / L, math.sqrt(2.0 * math.pi) * l / L
    variances = [math.exp(-0.5 * (l * k * w) ** 2) for k in range(1, count + 1)]
    sds = tuple(math.sqrt(top * v) for v in variances)
    return Sines(w, sds, 0.5 * (low + high) - L, 2.0 * L)


def periodic(count: int) -> Sines:
    """Harmonics of an angle that may turn round."""
    sds = tuple(1.0 / k for k in range(1, count + 1))
    return Sines(1.0, sds + sds, cosines=True)


def ripple(count: int) -> Sines:
    """Of an angle, up to so many waves in a turn, each as large: a motor's cogging."""
    sds = (1.0,) * count
    return Sines(1.0, sds + sds, cosines=True)


@dataclass(frozen=True)
class Sign:
    """Dry friction: against a velocity, smoothed over ``width``."""

    width: float
    sds: ClassVar[tuple[float, ...]] = (1.0,)

    def value(self, x: Float[AnyArray, "1 *b"], z: Points) -> Points:
        """The force of the level ``x``."""
        return -x[0] * library(z).tanh(z / self.width)

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b 1"]:
        """The force of a level of one."""
        return -library(z).tanh(z / self.width)[..., None]

    def slope(self, x: Float[AnyArray, "1 *b"], z: Points) -> Points:
        """Its derivative."""
        return x[0] * (library(z).tanh(z / self.width) ** 2 - 1.0) / self.width


@dataclass(frozen=True)
class Gap:
    """A dead zone of an unknown width: of all bases only this has shapes to learn.

    ``width`` is the width's median, ``softness`` that of the share of the width in
    which it ends; their logarithms have the sd `SHAPE_SD`.
    """

    width: float
    softness: float = SOFT
    sds: ClassVar[tuple[float, ...]] = (1.0,)

    def value(self, x: Float[AnyArray, " 3"], z: Points) -> Points:
        """What it takes away: ``x[0]`` at the edge, where ``z`` is the width ``x[1]``.

        A true dead zone takes all of the input, ``x[0] = x[1]``. The softness is
        ``x[2]``.
        """
        w = x[1]
        return (dead_zone(z, w, x[2] * w) - z) * (x[0] / w)

    def features(self, z: Float[AnyArray, "*b"]) -> Float[Array, "*b 1"]:
        """What it takes away for ``x[0] = 1``, at the medians of its shapes."""
        x = jnp.asarray([1.0, self.width, self.softness])
        return jnp.asarray(self.value(x, jnp.asarray(z)))[..., None]


Basis = Sines | Sign | Gap
