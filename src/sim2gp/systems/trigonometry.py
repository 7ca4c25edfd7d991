"""Sine and cosine of many values at once.

XLA takes them one at a time on a CPU: most of the time of a rollout. In single
precision, that of planning, they are rational here (Weierstrass):

    sin x = 2 t / (1 + t^2),    cos x = (1 - t^2) / (1 + t^2),    t = tan(x / 2)

where ``x`` is taken to within a quarter turn of zero, and the tangent is a polynomial.
The division comes last: XLA keeps what ends so, and computes a sum or product again for
each use. In double precision, and of NumPy's arrays, they are the library's.
"""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.linalg import library
from sim2gp.types import AnyArray

Values = Float[Array, "*b"]

#: Parts of pi: a product of one of the first two and a count of half turns is exact.
HALF_TURN = np.asarray(
    [3.140625, 9.675025939941406e-4, 1.5099579909783765e-7], np.float32
)
#: ``(tan y - y) / y^3`` in ``y^2``, of least largest error up to pi / 4.
TANGENT = np.asarray(
    [
        0.33333156332967234,
        0.133388132964272,
        0.05341010357264797,
        0.024434425096016472,
        0.00311291025235697,
        0.009389624591458876,
    ],
    np.float32,
)
ONE, TWO, HALF = np.float32(1.0), np.float32(2.0), np.float32(0.5)


def sine(x: AnyArray) -> Any:
    """``sin(x)``, x in rad: single precision to 2e-7 within 1e4 rad."""
    return _single_sine(x) if _is_single(x) else library(x).sin(x)


def cosine(x: AnyArray) -> Any:
    """``cos(x)``, x in rad: single precision to 2e-7 within 1e4 rad."""
    return _single_cosine(x) if _is_single(x) else library(x).cos(x)


def _is_single(x: AnyArray) -> bool:
    return isinstance(x, jax.Array) and x.dtype == jnp.float32


@jax.custom_jvp
def _single_sine(x: Values) -> Values:
    t, sign = _half_tangent(x)
    return sign * (t + t) / (ONE + t * t)


@jax.custom_jvp
def _single_cosine(x: Values) -> Values:
    t, sign = _half_tangent(x)
    return sign * (ONE - t * t) / (ONE + t * t)


_single_sine.defjvps(lambda dx, _, x: dx * _single_cosine(x))
_single_cosine.defjvps(lambda dx, _, x: -dx * _single_sine(x))


def _half_tangent(x: Values) -> tuple[Values, Values]:
    """``tan(x / 2)`` of what half turns leave, and the sign of sine and cosine."""
    turns = jnp.round(x * np.float32(1.0 / math.pi))
    for part in HALF_TURN:
        x = x - turns * part
    y = HALF * x
    square, tangent = y * y, TANGENT[-1]
    for coefficient in TANGENT[-2::-1]:
        tangent = tangent * square + coefficient
    odd = jnp.abs(turns - TWO * jnp.round(HALF * turns))
    return y + y * square * tangent, ONE - TWO * odd
