"""Furuta pendulum: a driven arm in the horizontal plane carries a free pendulum.

State ``(theta, alpha, theta', alpha')``, input a motor voltage ``u``; ``alpha = 0`` is
HANGING, ``alpha = pi`` upright. With ``l = Lp / 2``, ``Jp = Mp Lp^2 / 12`` and
``Jr = Mr Lr^2 / 12`` (the manufacturer's value):

    A = Jr + Mp Lr^2 + Mp l^2 sin^2(alpha)      B = Mp l Lr cos(alpha)
    C = Jp + Mp l^2                             tau = km (u - km theta') / Rm

    A theta'' + B alpha'' = tau - Dr theta' - Mp l^2 sin(2 alpha) theta' alpha'
                            + Mp l Lr sin(alpha) alpha'^2
    B theta'' + C alpha'' = -Dp alpha' + 1/2 Mp l^2 sin(2 alpha) theta'^2
                            - Mp g l sin(alpha)

The published model leaves ``Jp`` out of ``A`` and of the ``sin(2 alpha)`` terms;
`sim2gp.systems.effects.geometry.RodInertia` puts it back. Parameters: Quanser
Qube-Servo 2 manual; dampings as in public drivers and simulators of that rig, which
disagree by decades and therefore get logarithmic boxes.
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.parameters import Parameters, bounded, log_bounded
from sim2gp.systems.base import Channel, record_from, table_for
from sim2gp.systems.mechanism import AbstractMechanism, Inertia
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Action, Scalar


class FurutaParams(eqx.Module):
    """Parameters of the rig; boxes are [0.5, 2] times the published value."""

    motor_resistance: Scalar = bounded(
        4.2, 16.8, "ohm", "terminal resistance of the motor", nominal=8.4
    )
    motor_constant: Scalar = bounded(
        0.021, 0.084, "V s/rad", "back-emf = torque constant", nominal=0.042
    )
    arm_mass: Scalar = bounded(0.0475, 0.19, "kg", "arm", nominal=0.095)
    arm_length: Scalar = bounded(
        0.0425, 0.17, "m", "motor axis to pendulum joint", nominal=0.085
    )
    arm_damping: Scalar = log_bounded(
        1e-6, 3e-3, "N m s/rad", "viscous friction of the arm", nominal=2.7e-4
    )
    pendulum_mass: Scalar = bounded(0.012, 0.048, "kg", "pendulum", nominal=0.024)
    pendulum_length: Scalar = bounded(
        0.0645, 0.258, "m", "whole pendulum, a uniform rod", nominal=0.129
    )
    pendulum_damping: Scalar = log_bounded(
        1e-7, 1e-3, "N m s/rad", "viscous friction of the pendulum", nominal=5e-5
    )


class Furuta(AbstractMechanism):
    """Furuta pendulum of the size of a Qube-Servo 2, driven by a voltage.

    | state            | symbol   | unit  | zero                       |
    |------------------|----------|-------|----------------------------|
    | theta            | theta    | rad   | where the arm was switched on |
    | alpha            | alpha    | rad   | hanging                    |
    | theta.velocity   | theta'   | rad/s |                            |
    | alpha.velocity   | alpha'   | rad/s |                            |
    | voltage (input)  | u        | V     | limits -5 and 5            |
    """

    parameters: Parameters = eqx.field(static=True)
    gravity: float = eqx.field(static=True)  # m/s^2
    locked: tuple[bool, bool] = eqx.field(static=True)

    states: ClassVar[tuple[Channel, ...]] = (
        Channel("theta", "rad", angle=True, low=-2.0, high=2.0),
        Channel("alpha", "rad", angle=True),
        Channel("theta.velocity", "rad/s"),
        Channel("alpha.velocity", "rad/s"),
    )
    actions: ClassVar[tuple[Channel, ...]] = (
        Channel("voltage", "V", low=-5.0, high=5.0),
    )
    max_substep: ClassVar[float] = 0.01

    def __init__(
        self,
        parameters: Parameters | None = None,
        *,
        gravity: float = 9.81,
        locked: tuple[bool, bool] = (False, False),
    ) -> None:
        self.parameters = table_for(FurutaParams, parameters)
        checks.finite("Furuta", gravity=gravity)
        self.gravity = gravity
        self.locked = locked

    def record(self, values: Mapping[str, Scalar]) -> FurutaParams:
        return record_from(FurutaParams, values)

    def inertia(self, params: FurutaParams, q: Float[Array, " 2"]) -> Inertia:
        """``[[A, B], [B, C]]`` of the module's equations, in kg m^2."""
        p, alpha = params, q[1]
        l = 0.5 * p.pendulum_length
        Jr = p.arm_mass * p.arm_length**2 / 12.0
        Jp = p.pendulum_mass * p.pendulum_length**2 / 12.0
        first, second = p.pendulum_mass * l, p.pendulum_mass * l**2
        return (
            Jr + p.pendulum_mass * p.arm_length**2 + second * sine(alpha) ** 2,
            first * p.arm_length * cosine(alpha),
            Jp + second,
        )

    def forces(
        self,
        params: FurutaParams,
        q: Float[Array, " 2"],
        v: Float[Array, " 2"],
        a: Action,
    ) -> Float[Array, " 2"]:
        """Right-hand side of the module's equations, in N m."""
        p = params
        sin, cos = sine(q[1]), cosine(q[1])
        l = 0.5 * p.pendulum_length
        first, second = p.pendulum_mass * l, p.pendulum_mass * l**2
        torque = p.motor_constant * (a[0] - p.motor_constant * v[0])
        slope = 2.0 * second * sin * cos  # dA / d alpha
        return jnp.stack(
            [
                torque / p.motor_resistance
                - p.arm_damping * v[0]
                - slope * v[0] * v[1]
                + first * p.arm_length * sin * v[1] ** 2,
                -p.pendulum_damping * v[1]
                + 0.5 * slope * v[0] ** 2
                - first * self.gravity * sin,
            ]
        )
