"""Functions of one variable that are linear in weights: bases of missing forces.

    f(z) = sum_k w_k phi_k(z),        w_k ~ N(0, S_k)

On an interval these are the reduced-rank features of a squared-exponential kernel
(Solin and Sarkka 2020, Statistics and Computing 30), zero at its ends and beyond:

    phi_k(z) = sin(k pi (z + L) / 2L),
    S_k      = sqrt(2 pi) l / L exp(-1/2 (l k pi / 2L)^2)

All but `Sines` are constants of a compiled program, and plain classes: an engine asks
for them at each of its steps, and a call of an Equinox module takes 50 us.
"""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import equinox as eqx
import numpy as np
from jax.tree_util import register_static
from jaxtyping import Float

from sim2gp.inference.linalg import library
from sim2gp.systems.effects.friction_laws import dead_zone
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import AnyArray

#: Of the interval and of the kernel's length, in half-widths of where a machine moves.
REACH, LENGTH = 2.5, 1.0
COUNT = 6  # of features
SOFT = 0.05  # of a dead zone's width: how soon it ends, its median
SHAPE_SD = 0.6  # of the logarithms of a dead zone's width and of this softness

#: One value, or a batch of them in NumPy.
Points = Float[AnyArray, "*b"]
Number = float | Float[AnyArray, "*g"]


class AbstractHarmonics(abc.ABC):
    """``sin(k angle(z))``, then ``cos(k angle(z))``, ``k = 1, 2, ...``

    ``sines`` and ``cosines`` are the weights' sds for a function whose own sd is one:
    as many of each, or no cosines. Of NumPy arrays, points may come in batches.
    """

    sines: tuple[float, ...]

    @property
    def cosines(self) -> tuple[float, ...]:
        """None, but of an angle."""
        return ()

    @abc.abstractmethod
    def angle(self, z: Points) -> tuple[Points, AnyArray]:
        """Of a value, and its derivative."""

    @property
    def sds(self) -> tuple[float, ...]:
        """Those of all weights."""
        return self.sines + self.cosines

    def value(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """The function with weights ``x``."""
        (angle, _), half = self.angle(z), len(self.sines)
        sin, cos = sine(angle), cosine(angle)
        found: Points = sin * _clenshaw(x[:half], cos)[0]
        if self.cosines:
            first, second = _clenshaw(x[half:], cos)
            found = found + cos * first - second
        return found

    def slope(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """Its derivative."""
        (angle, rate), half = self.angle(z), len(self.sines)
        sin, cos = sine(angle), cosine(angle)
        first, second = _clenshaw(_times_order(x[:half]), cos)
        slope = cos * first - second
        if self.cosines:
            slope = slope - sin * _clenshaw(_times_order(x[half:]), cos)[0]
        return rate * slope

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b k"]:
        """Its values for each weight alone."""
        xp, (angle, _) = library(z), self.angle(z)
        sin, cos = sine(angle), cosine(angle)
        found = _multiples(xp.zeros_like(sin), sin, cos, len(self.sines))
        if self.cosines:
            found += _multiples(xp.ones_like(sin), cos, cos, len(self.cosines))
        return xp.stack(found, axis=-1)


@register_static
@dataclass(frozen=True)
class Harmonics(AbstractHarmonics):
    """Of an angle that turns round; ``frequency`` in a turn."""

    sines: tuple[float, ...]
    cosines: tuple[float, ...] = ()
    frequency: float = 1.0

    def angle(self, z: Points) -> tuple[Points, AnyArray]:
        return self.frequency * z, library(z).asarray(self.frequency, z.dtype)


class AbstractSines(AbstractHarmonics):
    """``sin(k pi (z - start) / span)``; zero beyond both ends."""

    start: Number
    span: Number

    def angle(self, z: Points) -> tuple[Points, AnyArray]:
        xp = library(z)
        start, span = (xp.asarray(x, z.dtype) for x in (self.start, self.span))
        along, w = z - start, math.pi / span
        inside = (along > 0.0) & (along < span)
        return w * xp.clip(along, 0.0, span), xp.where(inside, w, xp.zeros_like(w))


class Sines(AbstractSines, eqx.Module):
    """Their ends are inputs of a compiled program, which serves other ends as well."""

    start: Float[AnyArray, ""]
    span: Float[AnyArray, ""]
    sines: tuple[float, ...] = eqx.field(static=True)


@register_static
@dataclass(frozen=True)
class FixedSines(AbstractSines):
    """Their ends are part of a compiled program: an engine on the host needs numbers
    while JAX traces."""

    start: Number
    span: Number
    sines: tuple[float, ...]


def _times_order(x: Float[AnyArray, "k *b"]) -> Float[AnyArray, "k *b"]:
    """Weight ``k`` times ``k``, counted from one."""
    k = np.arange(1, len(x) + 1).astype(x.dtype)
    return (x.T * k).T


def _clenshaw(x: Float[AnyArray, "k *b"], cos: Points) -> tuple[Points, Points]:
    """``b_1`` and ``b_2`` of Clenshaw's recurrence.

    ``sum x_k sin(k a) = b_1 sin(a)`` and ``sum x_k cos(k a) = b_1 cos(a) - b_2``: one
    sine and one cosine, and nothing that must be kept.
    """
    first, second = x[-1] + 0.0 * cos, 0.0 * cos
    for k in range(len(x) - 2, -1, -1):
        first, second = x[k] + 2.0 * cos * first - second, first
    return first, second


def _multiples(none: Points, one: Points, cos: Points, count: int) -> list[Points]:
    """``sin(k a)`` or ``cos(k a)`` for ``k = 1..count``, by Chebyshev's recurrence.

    From those of ``k = 0`` and ``1``: two products each, and no sine.
    """
    found = [none, one]
    for _ in range(count - 1):
        found.append(2.0 * cos * found[-1] - found[-2])
    return found[1:]


def smooth(
    low: float,
    high: float,
    *,
    count: int = COUNT,
    reach: float = REACH,
    length: float = LENGTH,
    fixed: bool = False,
) -> AbstractSines:
    """Smooth functions where a machine moves, ``low`` to ``high``, and beyond.

    There is room on both sides: functions fall to zero where the data end, not before.
    ``reach`` and ``length`` (of the kernel) are in half-widths. ``fixed`` are
    `FixedSines`.
    """
    half = 0.5 * (high - low)
    L = reach * half
    w, top = 0.5 * math.pi * length / reach, math.sqrt(2.0 * math.pi) * length / reach
    variances = [math.exp(-0.5 * (k * w) ** 2) for k in range(1, count + 1)]
    sds = tuple(math.sqrt(top * v) for v in variances)
    start, span = 0.5 * (low + high) - L, 2.0 * L
    if fixed:
        return FixedSines(start=start, span=span, sines=sds)
    return Sines(start=np.asarray(start), span=np.asarray(span), sines=sds)


def periodic(count: int) -> Harmonics:
    """Harmonics of an angle that may turn round."""
    sds = tuple(1.0 / k for k in range(1, count + 1))
    return Harmonics(sds, sds)


def ripple(count: int) -> Harmonics:
    """Of an angle, up to so many waves in a turn, each as large: a motor's cogging."""
    sds = (1.0,) * count
    return Harmonics(sds, sds)


@register_static
@dataclass(frozen=True)
class Sign:
    """Dry friction: against a velocity, smoothed over each of the ``widths``."""

    widths: tuple[Number, ...]

    @property
    def sds(self) -> tuple[float, ...]:
        """A width's level is as large as another's."""
        return (1.0,) * len(self.widths)

    def value(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """The force of the levels ``x``."""
        found = [-x[k] * self._along(z, k) for k in range(len(self.widths))]
        return sum(found[1:], found[0])

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b k"]:
        """The forces of levels of one."""
        each = [-self._along(z, k) for k in range(len(self.widths))]
        return library(z).stack(each, axis=-1)

    def slope(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """Its derivative."""
        found = [
            x[k] * (self._along(z, k) ** 2 - 1.0) / width
            for k, width in enumerate(self.widths)
        ]
        return sum(found[1:], found[0])

    def _along(self, z: Points, k: int) -> Points:
        return library(z).tanh(z / self.widths[k])


@register_static
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

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b 1"]:
        """What it takes away for ``x[0] = 1``, at the medians of its shapes."""
        x = np.asarray([1.0, self.width, self.softness])
        return self.value(library(z).asarray(x, z.dtype), z)[..., None]


StateBasis = AbstractHarmonics | Sign
Basis = StateBasis | Gap


def alike(bases: Sequence[StateBasis]) -> list[tuple[StateBasis, list[int]]]:
    """Each kind as one basis, whose points have a row for each of these; and which.

    In NumPy a call costs more than a few numbers: an arm of six joints has 18 bases or
    more, of few kinds.
    """
    kinds: dict[tuple, list[int]] = {}
    for i, basis in enumerate(bases):
        kinds.setdefault(_kind(basis), []).append(i)
    return [(_joined([bases[i] for i in each]), each) for each in kinds.values()]


def _kind(basis: StateBasis) -> tuple:
    if isinstance(basis, Sign):
        return Sign, len(basis.widths)
    if isinstance(basis, AbstractSines):
        return AbstractSines, basis.sines
    return type(basis), basis


def _joined(bases: Sequence[StateBasis]) -> StateBasis:
    """Bases of one kind as one."""
    first = bases[0]
    if isinstance(first, Sign):
        widths = [basis.widths for basis in bases if isinstance(basis, Sign)]
        return Sign(tuple(np.asarray(widths).T[..., None]))
    if isinstance(first, AbstractSines):
        ends = [(b.start, b.span) for b in bases if isinstance(b, AbstractSines)]
        start, span = np.asarray(ends).T[..., None]
        return FixedSines(start, span, first.sines)
    return first
