"""Planar two-link arm with rotors, gravity and friction; the paper's arm as a case.

State ``(q1, q2, q1', q2')``: ``q1`` is the angle of link 1, 0 = HANGING, ``q2`` that of
link 2 relative to link 1. Inputs are the joint torques. Inertias are about the *joints*
and first moments are parameters of their own, so that everything but the lengths enters
linearly. With ``c, s = cos(q2), sin(q2)``, ``h = m2r2 l1`` and the gear ratio ``gr``:

    M11 = I1 + I2 + m2 l1^2 + 2 h c + (gr^2 + 1) Ir
    M12 = I2 + h c - gr Ir                    M22 = I2 + gr^2 Ir
    f1 = t1 + h s (2 q1' q2' + q2'^2) - g [(m1r1 + m2 l1) sin(q1) + m2r2 sin(q1 + q2)]
         - b1 q1' - cf1 sgn(q1')
    f2 = t2 - h s q1'^2 - g m2r2 sin(q1 + q2) - b2 q2' - cf2 sgn(q2')

Rotor 1 turns with ``gr q1'`` on the base, rotor 2 with ``q1' - gr q2'`` on link 1
(hence the minus in M12). ``sgn`` is smoothed (`sim2gp.systems.effects.friction_laws`).
Published values: design C.1 of the double pendulum of DFKI's underactuated lab, model
2.0.
"""

from collections.abc import Mapping
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.parameters import Parameters, bounded, log_bounded
from sim2gp.systems.base import Channel, record_from, table_for
from sim2gp.systems.effects.friction_laws import (
    COULOMB_SUBSTEP,
    coulomb,
    coulomb_arctangent,
)
from sim2gp.systems.mechanism import AbstractMechanism, Inertia
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Action, Scalar

STATES = (
    Channel("q1", "rad", angle=True),
    Channel("q2", "rad", angle=True),
    Channel("q1.velocity", "rad/s"),
    Channel("q2.velocity", "rad/s"),
)


class TwoLinkParams(eqx.Module):
    """Parameters of an arm of desk to human size; boxes of about two to four decades.

    A fixed base leaves ``m2``, ``m1r1`` and ``I1`` collinear: only ``m1r1 + l1 m2`` and
    ``I1 + l1^2 m2`` act. Without rotors the inertia matrix is positive definite where
    ``(I1 + l1^2 m2) I2 > (l1 m2r2)^2``, which independent boxes cannot say: 9 prior
    draws in 100 break it.
    """

    m1r1: Scalar = log_bounded(
        0.01, 1.0, "kg m", "first moment of link 1 about joint 1", nominal=0.15173
    )
    I1: Scalar = log_bounded(
        5e-3, 1.0, "kg m^2", "inertia of link 1 about joint 1", nominal=0.042112
    )
    m2: Scalar = log_bounded(0.1, 5.0, "kg", "mass of link 2", nominal=0.33694)
    m2r2: Scalar = log_bounded(
        0.01, 0.5, "kg m", "first moment of link 2 about joint 2", nominal=0.15783
    )
    I2: Scalar = log_bounded(
        5e-3, 1.0, "kg m^2", "inertia of link 2 about joint 2", nominal=0.051035
    )
    b1: Scalar = log_bounded(
        1e-4, 1.0, "N m s/rad", "viscous friction of joint 1", nominal=3.6909e-3
    )
    b2: Scalar = log_bounded(
        1e-4, 1.0, "N m s/rad", "viscous friction of joint 2", nominal=6.4509e-4
    )
    # pi/2 times the published coefficients of arctan(100 v), which slip at that level
    cf1: Scalar = log_bounded(
        1e-3, 1.0, "N m", "dry friction of joint 1", nominal=0.27438
    )
    cf2: Scalar = log_bounded(
        1e-3, 1.0, "N m", "dry friction of joint 2", nominal=0.17279
    )
    Ir: Scalar = log_bounded(
        1e-6, 1e-3, "kg m^2", "inertia of each motor's rotor", nominal=6.2872e-5
    )


class TwoLink(AbstractMechanism):
    """Two-link arm driven at both joints, vertical or (``gravity=0``) horizontal.

    | state              | symbol   | unit  | zero                       |
    |--------------------|----------|-------|----------------------------|
    | q1                 | q1       | rad   | link 1 hanging             |
    | q2                 | q2       | rad   | link 2 in line with link 1 |
    | q1.velocity        | q1'      | rad/s |                            |
    | q2.velocity        | q2'      | rad/s |                            |
    | torque1 (input)    | t1       | N m   | limits -6 and 6            |
    | torque2 (input)    | t2       | N m   | limits -6 and 6            |
    """

    parameters: Parameters = eqx.field(static=True)
    gravity: float = eqx.field(static=True)  # m/s^2
    length1: float = eqx.field(static=True)  # m, joint 1 to joint 2
    gear_ratio: float = eqx.field(static=True)
    coulomb_width: float = eqx.field(static=True)  # rad/s
    coulomb_shape: Literal["tanh", "arctangent"] = eqx.field(static=True)
    locked: tuple[bool, bool] = eqx.field(static=True)

    states: ClassVar[tuple[Channel, ...]] = STATES
    actions: ClassVar[tuple[Channel, ...]] = (
        Channel("torque1", "N m", low=-6.0, high=6.0),
        Channel("torque2", "N m", low=-6.0, high=6.0),
    )
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __init__(
        self,
        parameters: Parameters | None = None,
        *,
        gravity: float = 0.0,
        length1: float = 0.2,
        gear_ratio: float = 6.0,
        coulomb_width: float = 0.05,
        coulomb_shape: Literal["tanh", "arctangent"] = "tanh",
        locked: tuple[bool, bool] = (False, False),
    ) -> None:
        checks.finite("TwoLink", gravity=gravity)
        sizes = {"length1": length1, "coulomb_width": coulomb_width}
        checks.positive("TwoLink", **sizes)
        checks.not_negative("TwoLink", gear_ratio=gear_ratio)  # 0: rotors do not count
        shapes = "tanh", "arctangent"
        checks.one_of("TwoLink", shapes, coulomb_shape=coulomb_shape)
        self.parameters = table_for(TwoLinkParams, parameters)
        self.gravity = gravity
        self.length1 = length1
        self.gear_ratio = gear_ratio
        self.coulomb_width = coulomb_width
        self.coulomb_shape = coulomb_shape
        self.locked = locked

    def record(self, values: Mapping[str, Scalar]) -> TwoLinkParams:
        return record_from(TwoLinkParams, values)

    def inertia(self, params: TwoLinkParams, q: Float[Array, " 2"]) -> Inertia:
        """``M11, M12, M22`` of the module's equations, in kg m^2."""
        p, l1, gr = params, self.length1, self.gear_ratio
        link1 = p.I1 + p.m2 * l1**2 + (gr**2 + 1.0) * p.Ir
        a, b, c = links_inertia(link1, p.I2, p.m2r2 * l1, q[1])
        return a, b - gr * p.Ir, c + gr**2 * p.Ir

    def forces(
        self,
        params: TwoLinkParams,
        q: Float[Array, " 2"],
        v: Float[Array, " 2"],
        a: Action,
    ) -> Float[Array, " 2"]:
        """Right-hand side of the module's equations, in N m."""
        p, dry, width = params, _SHAPES[self.coulomb_shape], self.coulomb_width
        first = (p.m1r1 + p.m2 * self.length1) * sine(q[0])
        second = p.m2r2 * sine(q[0] + q[1])
        friction = jnp.stack(
            [
                p.b1 * v[0] + dry(v[0], p.cf1, width),
                p.b2 * v[1] + dry(v[1], p.cf2, width),
            ]
        )
        weight = self.gravity * jnp.stack([first + second, second])
        return a + gyroscopic(p.m2r2 * self.length1, q[1], v) - weight - friction


_SHAPES = {"tanh": coulomb, "arctangent": coulomb_arctangent}


class UniformRodParams(eqx.Module):
    """Parameters of the paper's horizontal arm (no values are published; SI)."""

    m1: Scalar = bounded(0.4, 2.0, "kg", "mass of rod 1", nominal=1.0)
    b1: Scalar = bounded(
        0.02, 0.3, "N m s/rad", "viscous friction of joint 1", nominal=0.1
    )
    m2: Scalar = bounded(0.32, 1.6, "kg", "mass of rod 2", nominal=0.8)
    b2: Scalar = bounded(
        0.02, 0.3, "N m s/rad", "viscous friction of joint 2", nominal=0.1
    )
    l1: Scalar = bounded(0.25, 1.0, "m", "length of rod 1", nominal=0.5)
    l2: Scalar = bounded(0.2, 0.8, "m", "length of rod 2", nominal=0.4)


class UniformRodArm(AbstractMechanism):
    """The paper's arm: two uniform rods in the horizontal plane, as a `TwoLink`.

    ``I1 = m1 l1^2 / 3``, ``m2r2 = m2 l2 / 2``, ``I2 = m2 l2^2 / 3``; no rotors, gravity
    or dry friction. The lengths are known unless the table frees them; with all six
    parameters free the map ``l -> c l, m -> m / c^2`` leaves the motion as it is.

    | state              | symbol   | unit  | zero                       |
    |--------------------|----------|-------|----------------------------|
    | q1                 | q1       | rad   | anywhere                   |
    | q2                 | q2       | rad   | rod 2 in line with rod 1   |
    | q1.velocity        | q1'      | rad/s |                            |
    | q2.velocity        | q2'      | rad/s |                            |
    | torque1 (input)    | t1       | N m   | limits -1 and 1            |
    | torque2 (input)    | t2       | N m   | limits -1 and 1            |
    """

    parameters: Parameters = eqx.field(static=True)
    locked: tuple[bool, bool] = eqx.field(static=True)

    states: ClassVar[tuple[Channel, ...]] = STATES
    actions: ClassVar[tuple[Channel, ...]] = (
        Channel("torque1", "N m", low=-1.0, high=1.0),
        Channel("torque2", "N m", low=-1.0, high=1.0),
    )
    max_substep: ClassVar[float] = 0.01

    def __init__(
        self,
        parameters: Parameters | None = None,
        *,
        locked: tuple[bool, bool] = (False, False),
    ) -> None:
        table = table_for(UniformRodParams, parameters)
        if parameters is None:
            table = table.replace(l1=0.5, l2=0.4)
        self.parameters = table
        self.locked = locked

    def record(self, values: Mapping[str, Scalar]) -> UniformRodParams:
        return record_from(UniformRodParams, values)

    def inertia(self, params: UniformRodParams, q: Float[Array, " 2"]) -> Inertia:
        """``M11, M12, M22`` in kg m^2."""
        p = params
        link1 = p.m1 * p.l1**2 / 3.0 + p.m2 * p.l1**2
        return links_inertia(
            link1, p.m2 * p.l2**2 / 3.0, 0.5 * p.m2 * p.l2 * p.l1, q[1]
        )

    def forces(
        self,
        params: UniformRodParams,
        q: Float[Array, " 2"],
        v: Float[Array, " 2"],
        a: Action,
    ) -> Float[Array, " 2"]:
        """Torques, gyroscopic terms and viscous friction, in N m."""
        p = params
        return (
            a
            + gyroscopic(0.5 * p.m2 * p.l2 * p.l1, q[1], v)
            - jnp.stack([p.b1, p.b2]) * v
        )

    def as_two_link(self, params: UniformRodParams) -> TwoLinkParams:
        """The same arm in the general parameters, with the length ``l1``."""
        p, none = params, jnp.zeros_like(params.m1)
        return TwoLinkParams(
            m1r1=0.5 * p.m1 * p.l1,
            I1=p.m1 * p.l1**2 / 3.0,
            m2=p.m2,
            m2r2=0.5 * p.m2 * p.l2,
            I2=p.m2 * p.l2**2 / 3.0,
            b1=p.b1,
            b2=p.b2,
            cf1=none,
            cf2=none,
            Ir=none,
        )


def links_inertia(link1: Scalar, I2: Scalar, h: Scalar, q2: Scalar) -> Inertia:
    """Inertia of two links: ``link1 = I1 + m2 l1^2``, ``I2`` about joint 2, ``h``."""
    coupling = h * cosine(q2)
    b = I2 + coupling
    return link1 + b + coupling, b, I2


def gyroscopic(h: Scalar, q2: Scalar, v: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """Centrifugal and Coriolis torques of two links, in N m."""
    hs = h * sine(q2)
    return jnp.stack([hs * (2.0 * v[0] * v[1] + v[1] ** 2), -hs * v[0] ** 2])
