"""Smooth friction laws, with gradients that stay finite at any slope and speed.

The sign of a velocity is smoothed over a width ``eps``:

    tanh        F = level tanh(v / eps)
    arctangent  F = level 2/pi arctan(v / eps)      (the form of several published arms)

Both slip at ``level``. Near rest they act as a viscous damping of ``level / eps``,
which makes the equations stiff: 4e-3 N m over 0.05 rad/s on the Furuta's arm is a rate
of 800/s, where RK4 needs substeps of 2.5 ms.
"""

import math

import jax.numpy as jnp
from jaxtyping import Float

from sim2gp.inference.linalg import library
from sim2gp.types import AnyArray, AnyScalar, Scalar

#: Longest RK4 substep that is stable and accurate with smoothed Coulomb friction, s.
COULOMB_SUBSTEP = 0.0025
_SATURATED = 20.0  # tanh(20) is 1 in float64


def coulomb(v: Scalar, level: Scalar, width: float | Scalar) -> Scalar:
    """Smoothed dry friction ``level tanh(v / width)``, to be subtracted from a force.

    The velocity is clipped before the division, so that neither an overflow nor
    ``0 inf`` can enter a gradient, for any width.
    """
    edge = _SATURATED * width
    return level * jnp.tanh(jnp.clip(v, -edge, edge) / width)


def coulomb_arctangent(v: Scalar, level: Scalar, width: float) -> Scalar:
    """Smoothed dry friction ``level 2/pi arctan(v / width)``, to be subtracted."""
    return level * (2.0 / jnp.pi) * jnp.arctan(v / width)


def dead_zone(
    u: Float[AnyArray, "*b"], width: AnyScalar, smoothing: AnyScalar
) -> Float[AnyArray, "*b"]:
    """An input without effect below ``width``: ``u sigmoid((|u| - width) / eps)``."""
    xp = library(u, width, smoothing)
    z = xp.clip((xp.abs(u) - width) / smoothing, -40.0, 40.0)
    return u / (1.0 + xp.exp(-z))


def quadratic_drag(v: Scalar, coefficient: Scalar) -> Scalar:
    """Drag ``coefficient v |v|``, to be subtracted from a force."""
    return coefficient * v * jnp.abs(v)


def slowed_by_coulomb(v: Scalar, level: Scalar, width: float, t: Scalar) -> Scalar:
    """Velocity after ``t`` seconds of ``dv/dt = -level tanh(v / width)``.

    ``sinh(v / width)`` decays exponentially; of a fast joint its logarithm is taken.
    """
    u, k = v / width, level * t / width
    fast = jnp.abs(u) > 1.0
    slow = jnp.where(fast, 0.0, u)
    near = jnp.arcsinh(jnp.sinh(slow) * jnp.exp(-k))
    a = jnp.where(fast, jnp.abs(u), 1.0)
    z = a + jnp.log1p(-jnp.exp(-2.0 * a)) - math.log(2.0) - k  # log sinh of the result
    up = jnp.maximum(z, 0.0)
    far = jnp.where(
        z > 0.0,
        up + jnp.log1p(jnp.sqrt(1.0 + jnp.exp(-2.0 * up))),
        jnp.arcsinh(jnp.exp(jnp.minimum(z, 0.0))),
    )
    return width * jnp.where(fast, jnp.sign(u) * far, near)
