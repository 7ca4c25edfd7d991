"""Accelerations of the machines from their Lagrangians: an independent oracle.

Each machine is written as points of mass and spinning bodies, in Cartesian coordinates;
JAX differentiates. From ``L(q, v) = T - V`` and the generalised forces ``Q``,

    M = d2L/dv2,     dv/dt = M^-1 (Q + dL/dq - d2L/dvdq v).

Nothing here is shared with ``sim2gp.systems``.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

Lagrangian = Callable[[Array, Array], Array]
GAUSS = (1.0 - 3.0**-0.5, 1.0 + 3.0**-0.5)  # two-point Gauss nodes on [0, 2]


def acceleration(L: Lagrangian, Q: Array, q: Array, v: Array) -> Array:
    """Accelerations under the generalised forces ``Q``."""
    momentum = jax.grad(L, 1)
    M = jax.jacfwd(momentum, 1)(q, v)
    drift = jax.jacfwd(momentum, 0)(q, v) @ v
    return jnp.linalg.solve(M, Q + jax.grad(L, 0)(q, v) - drift)


def energy(L: Lagrangian, q: Array, v: Array) -> Array:
    """``v . dL/dv - L``."""
    return v @ jax.grad(L, 1)(q, v) - L(q, v)


def point(position: Callable[[Array], Array], mass: Any, g: Any) -> Lagrangian:
    """A point of mass at ``position(q)``, whose last coordinate is up."""

    def L(q: Array, v: Array) -> Array:
        speed = jax.jvp(position, (q,), (v,))[1]
        return 0.5 * mass * speed @ speed - mass * g * position(q)[-1]

    return L


def spin(angle: Callable[[Array], Array], inertia: Any) -> Lagrangian:
    """A body of one rotational inertia."""
    return lambda q, v: 0.5 * inertia * jax.jvp(angle, (q,), (v,))[1] ** 2


def together(*parts: Lagrangian) -> Lagrangian:
    """Lagrangians add."""
    return lambda q, v: sum(part(q, v) for part in parts)  # type: ignore[return-value]


def furuta(p: Any, g: float = 9.81, full_rod: bool = False) -> Lagrangian:
    """Arm, and a pendulum as a point with a spin, or as a true thin rod."""

    def on_pendulum(r: Any) -> Callable[[Array], Array]:
        def position(q: Array) -> Array:
            theta, alpha = q
            radial = jnp.stack([jnp.cos(theta), jnp.sin(theta)])
            tangent = jnp.stack([-jnp.sin(theta), jnp.cos(theta)])
            plane = p.arm_length * radial + r * jnp.sin(alpha) * tangent
            return jnp.append(plane, -r * jnp.cos(alpha))

        return position

    l, m = p.pendulum_length / 2, p.pendulum_mass
    arm = spin(lambda q: q[0], p.arm_mass * p.arm_length**2 / 12)
    if full_rod:
        return together(arm, *(point(on_pendulum(l * k), m / 2, g) for k in GAUSS))
    own = spin(lambda q: q[1], m * p.pendulum_length**2 / 12)
    return together(arm, own, point(on_pendulum(l), m, g))


def cartpole(
    p: Any,
    *,
    reflected: float = 0.9 * 3.71**2 * 3.9e-7 / 6.35e-3**2,
    tilt: float = 0.0,
    centre: Any = None,
    g: float = 9.81,
) -> Lagrangian:
    """Cart with the gear's inertia, and a rod hanging from it, on a tilted rail."""
    along = jnp.array([jnp.cos(tilt), jnp.sin(tilt)])
    normal = jnp.array([-jnp.sin(tilt), jnp.cos(tilt)])
    l, m = p.pole_half_length, p.pole_mass

    def on_pole(r: Any) -> Callable[[Array], Array]:
        return lambda q: (q[0] + r * jnp.sin(q[1])) * along - r * jnp.cos(q[1]) * normal

    def cart(q: Array) -> Array:
        return q[0] * along

    parts = [point(cart, p.cart_mass, g), spin(lambda q: q[0], reflected)]
    if centre is None:
        parts += [point(on_pole(l * k), m / 2, g) for k in GAUSS]
    else:
        parts += [point(on_pole(centre), m, g), spin(lambda q: q[1], m * l**2 / 3)]
    return together(*parts)


def two_link(p: Any, length1: float, gear: float, g: float) -> Lagrangian:
    """Two links as points with spins, and two rotors, the second on link 1."""
    r2 = p.m2r2 / p.m2

    def link1(q: Array) -> Array:  # one kilogram at the first moment's distance
        return -p.m1r1 * jnp.stack([-jnp.sin(q[0]), jnp.cos(q[0])])

    def link2(q: Array) -> Array:
        total = q[0] + q[1]
        joint = length1 * jnp.stack([jnp.sin(q[0]), -jnp.cos(q[0])])
        return joint + r2 * jnp.stack([jnp.sin(total), -jnp.cos(total)])

    return together(
        lambda q, v: -g * link1(q)[-1],
        spin(lambda q: q[0], p.I1),
        point(link2, p.m2, g),
        spin(lambda q: q[0] + q[1], p.I2 - p.m2 * r2**2),
        spin(lambda q: gear * q[0], p.Ir),
        spin(lambda q: q[0] - gear * q[1], p.Ir),
    )
