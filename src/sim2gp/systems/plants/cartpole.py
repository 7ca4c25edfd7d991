"""Cart-pole: a motor drives a cart on a rail, a pole hangs freely from the cart.

State ``(x, theta, x', theta')``, input a motor voltage ``u``; ``theta = 0`` is HANGING,
``theta = pi`` upright, the pole's centre is at ``x + l sin(theta)``, ``l`` is HALF the
pole's length:

    Jeq = m_c + eta_g Kg^2 Jm / r^2
    F = eta_g Kg eta_m km / (Rm r) (eta_m u - Kg km x' / r)

    (m_p + Jeq) x'' + m_p l cos(theta) theta'' = F - B_eq x'
                                                 + m_p l sin(theta) theta'^2
    m_p l cos(theta) x'' + 4/3 m_p l^2 theta'' = -B_p theta' - m_p g l sin(theta)

The centrifugal term has a plus: with a minus, which some public simulators print, the
undamped machine loses energy. Parameters: Quanser IP02 manual, short pole.
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


class CartPoleParams(eqx.Module):
    """Parameters to be learned; boxes are [0.5, 2] times the published value."""

    cart_mass: Scalar = bounded(0.19, 0.76, "kg", "cart", nominal=0.38)
    pole_mass: Scalar = bounded(0.0635, 0.254, "kg", "pole", nominal=0.127)
    pole_half_length: Scalar = bounded(
        0.084, 0.337, "m", "pivot to the centre of a uniform pole", nominal=0.16825
    )
    cart_damping: Scalar = bounded(
        2.7, 10.8, "N s/m", "viscous friction of the cart", nominal=5.4
    )
    pole_damping: Scalar = log_bounded(
        2e-4, 2e-2, "N m s/rad", "viscous friction of the pole", nominal=0.0024
    )
    motor_constant: Scalar = bounded(
        3.8e-3, 1.53e-2, "V s/rad", "back-emf = torque constant", nominal=7.67e-3
    )


class CartPole(AbstractMechanism):
    """Cart-pole of the size of an IP02 with its short pole, driven by a voltage.

    | state            | symbol   | unit  | zero                   |
    |------------------|----------|-------|------------------------|
    | x                | x        | m     | middle of the rail     |
    | theta            | theta    | rad   | hanging                |
    | x.velocity       | x'       | m/s   |                        |
    | theta.velocity   | theta'   | rad/s |                        |
    | voltage (input)  | u        | V     | limits -10 and 10      |
    """

    parameters: Parameters = eqx.field(static=True)
    motor_resistance: float = eqx.field(static=True)  # ohm
    motor_inertia: float = eqx.field(static=True)  # kg m^2
    gear_ratio: float = eqx.field(static=True)
    pinion_radius: float = eqx.field(static=True)  # m
    motor_efficiency: float = eqx.field(static=True)
    gear_efficiency: float = eqx.field(static=True)
    gravity: float = eqx.field(static=True)  # m/s^2
    locked: tuple[bool, bool] = eqx.field(static=True)

    states: ClassVar[tuple[Channel, ...]] = (
        Channel("x", "m", low=-0.407, high=0.407),
        Channel("theta", "rad", angle=True),
        Channel("x.velocity", "m/s"),
        Channel("theta.velocity", "rad/s"),
    )
    actions: ClassVar[tuple[Channel, ...]] = (
        Channel("voltage", "V", low=-10.0, high=10.0),
    )
    max_substep: ClassVar[float] = 0.01

    def __init__(
        self,
        parameters: Parameters | None = None,
        *,
        motor_resistance: float = 2.6,
        motor_inertia: float = 3.9e-7,
        gear_ratio: float = 3.71,
        pinion_radius: float = 6.35e-3,
        motor_efficiency: float = 0.9,
        gear_efficiency: float = 0.9,
        gravity: float = 9.81,
        locked: tuple[bool, bool] = (False, False),
    ) -> None:
        sizes = {"pinion_radius": pinion_radius, "gear_ratio": gear_ratio}
        checks.positive("CartPole", motor_resistance=motor_resistance, **sizes)
        checks.not_negative("CartPole", motor_inertia=motor_inertia)
        shares = {"motor_efficiency": motor_efficiency}
        checks.positive_share("CartPole", **shares, gear_efficiency=gear_efficiency)
        checks.finite("CartPole", gravity=gravity)
        self.parameters = table_for(CartPoleParams, parameters)
        self.motor_resistance = motor_resistance
        self.motor_inertia = motor_inertia
        self.gear_ratio = gear_ratio
        self.pinion_radius = pinion_radius
        self.motor_efficiency = motor_efficiency
        self.gear_efficiency = gear_efficiency
        self.gravity = gravity
        self.locked = locked

    def record(self, values: Mapping[str, Scalar]) -> CartPoleParams:
        return record_from(CartPoleParams, values)

    def inertia(self, params: CartPoleParams, q: Float[Array, " 2"]) -> Inertia:
        """Joint-space inertia, in kg, kg m and kg m^2."""
        p, l = params, params.pole_half_length
        reflected = self.motor_inertia * (self.gear_ratio / self.pinion_radius) ** 2
        return (
            p.pole_mass + p.cart_mass + self.gear_efficiency * reflected,
            p.pole_mass * l * cosine(q[1]),
            4.0 / 3.0 * p.pole_mass * l**2,
        )

    def forces(
        self,
        params: CartPoleParams,
        q: Float[Array, " 2"],
        v: Float[Array, " 2"],
        a: Action,
    ) -> Float[Array, " 2"]:
        """Right-hand side of the module's equations, in N and N m."""
        p, sin = params, sine(q[1])
        first = p.pole_mass * p.pole_half_length
        return jnp.stack(
            [
                self.motor_force(p, a[0], v[0])
                - p.cart_damping * v[0]
                + first * sin * v[1] ** 2,
                -p.pole_damping * v[1] - first * self.gravity * sin,
            ]
        )

    def motor_force(self, params: CartPoleParams, u: Scalar, speed: Scalar) -> Scalar:
        """Force of the motor on the cart in N, from volts and the cart's m/s."""
        ratio = self.gear_ratio / self.pinion_radius  # motor rad per m of the cart
        gain = self.gear_efficiency * self.motor_efficiency * ratio
        voltage = self.motor_efficiency * u - ratio * params.motor_constant * speed
        return gain * params.motor_constant / self.motor_resistance * voltage
