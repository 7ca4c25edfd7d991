"""Sine and cosine of many values at once.

XLA takes them one at a time on a CPU: most of the time of a rollout, and a third of a
fit's. Here they are rational: with ``x`` taken to within a quarter turn of zero, and a
convergent ``N / D`` of Lambert's continued fraction for the tangent of its half,

    tan y = y / (1 - y^2 / (3 - y^2 / (5 - ...))) ~ N / D,              y = x / 2
    sin x = 2 N D / (D^2 + N^2),    cos x = (D^2 - N^2) / (D^2 + N^2)

The division comes last: XLA keeps what ends so, and computes a sum or product again for
each use. Of NumPy's arrays they are the library's.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.linalg import library
from sim2gp.types import AnyArray

Values = Float[Array, "*b"]


class _Precision(NamedTuple):
    """Parts of pi, and coefficients of ``N / y`` and ``D`` in ``y^2``.

    A product of a part of pi but the last and a count of half turns is exact.
    """

    pi: tuple[Any, ...]
    numerator: tuple[Any, ...]
    denominator: tuple[Any, ...]


def _lambert(levels: int) -> tuple[list[float], list[float]]:
    """Coefficients of a convergent's ``N / y`` and ``D``, scaled to begin with one."""
    y2 = np.polynomial.Polynomial([0.0, 1.0])
    before = [0.0 * y2, 0.0 * y2 + 1.0]
    now = [0.0 * y2 + 1.0] * 2
    for k in range(2, levels + 1):
        after = [(2 * k - 1) * x - y2 * z for x, z in zip(now, before, strict=True)]
        before, now = now, after
    numerator, denominator = (x.coef / now[1].coef[0] for x in now)
    return numerator.tolist(), denominator.tolist()


#: Pi to 12 bits, to 12 more, and the rest; to 28, to 28 more, and the rest.
_SINGLE_PI = 3.140625, 9.675025939941406e-4, 1.5099579909783765e-7
_DOUBLE_PI = 3.141592651605606, 1.9841871617964912e-09, -2.435410355594793e-18
_PRECISIONS = {
    np.dtype(kind): _Precision(*(tuple(map(kind, x)) for x in (pi, *_lambert(levels))))
    for kind, pi, levels in ((np.float32, _SINGLE_PI, 5), (np.float64, _DOUBLE_PI, 9))
}


def sine(x: AnyArray) -> Any:
    """``sin(x)``, x in rad: to 3 units in the last place of one, within 1e4 rad."""
    return _sine(x) if _is_ours(x) else library(x).sin(x)


def cosine(x: AnyArray) -> Any:
    """``cos(x)``, x in rad: to 3 units in the last place of one, within 1e4 rad."""
    return _cosine(x) if _is_ours(x) else library(x).cos(x)


def _is_ours(x: AnyArray) -> bool:
    return isinstance(x, jax.Array) and x.dtype in _PRECISIONS


@jax.custom_jvp
def _sine(x: Values) -> Values:
    N, D, sign = _half_tangent(x)
    return sign * (N * D + N * D) / (D * D + N * N)


@jax.custom_jvp
def _cosine(x: Values) -> Values:
    N, D, sign = _half_tangent(x)
    return sign * (D * D - N * N) / (D * D + N * N)


_sine.defjvps(lambda dx, _, x: dx * _cosine(x))
_cosine.defjvps(lambda dx, _, x: -dx * _sine(x))


def _half_tangent(x: Values) -> tuple[Values, Values, Values]:
    """``N`` and ``D`` of what half turns leave, and the sign of sine and cosine."""
    kind = x.dtype.type
    one, two, half = kind(1.0), kind(2.0), kind(0.5)
    of = _PRECISIONS[x.dtype]
    turns = jnp.round(x * kind(1.0 / math.pi))
    for part in of.pi:
        x = x - turns * part
    y = half * x
    odd = jnp.abs(turns - two * jnp.round(half * turns))
    numerator, denominator = (
        _polynomial(c, y * y) for c in (of.numerator, of.denominator)
    )
    return y * numerator, denominator, one - two * odd


def _polynomial(coefficients: tuple[Any, ...], x: Values) -> Values:
    found = coefficients[-1] * x + coefficients[-2]
    for coefficient in coefficients[-3::-1]:
        found = found * x + coefficient
    return found
