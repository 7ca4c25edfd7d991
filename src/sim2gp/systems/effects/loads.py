"""The tilt of a machine, and what it carries: tilts and payloads."""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar

from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import SUBSTEP, AbstractForce, AbstractJointEffect
from sim2gp.systems.effects.units import gravity_of, only_on
from sim2gp.systems.mechanism import AbstractMechanism, Inertia, Pair
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Scalar


class RailTilt(AbstractForce):
    """A rail that rises by ``magnitude`` radians towards positive ``x``.

    The pole's angle stays relative to the rail's normal; with ``b`` the tilt, the force
    is ``-g sin(b) (m_c + m_p)`` along the rail and
    ``m_p l g [(1 - cos b) sin(theta) - sin b cos(theta)]`` on the pole.
    """

    where: str = eqx.field(static=True, default="x")
    magnitude: float = eqx.field(static=True, default=math.radians(1.0))
    what: ClassVar[str] = "tilt"
    meaning: ClassVar[str] = "tilt of the rail"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {CartPole: "x"})
        return "rad"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        p, g = params, gravity_of(system)
        up, lost = sine(x), 2.0 * sine(0.5 * x) ** 2
        lever = lost * sine(q[1]) - up * cosine(q[1])
        return g * jnp.stack(
            [
                -up * (p.cart_mass + p.pole_mass),
                p.pole_mass * p.pole_half_length * lever,
            ]
        )


class AbstractBaseTilt(AbstractForce):
    """A Furuta's base that is tilted by ``magnitude`` radians.

    The side that the arm points to at ``towards`` radians rises; with ``b`` the tilt
    and ``r`` the horizontal place of the pendulum's centre along that direction, the
    potential gains ``m g [sin(b) r - (1 - cos(b)) z]``. The arm is balanced about its
    axis, as ``Jr = Mr Lr^2 / 12`` says.
    """

    towards: AbstractClassVar[float]
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {Furuta: "theta"})
        return "rad"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        # Weight of a tilted machine's pendulum less that of an upright one's, N m.
        p, turned = params, q[0] - self.towards
        weight = p.pendulum_mass * gravity_of(system)
        l = 0.5 * p.pendulum_length
        sin, cos = sine(q[1]), cosine(q[1])
        up, lost = weight * sine(x), weight * 2.0 * sine(0.5 * x) ** 2
        arm = p.arm_length * sine(turned) + l * sin * cosine(turned)
        return jnp.stack([up * arm, l * (up * cos * sine(turned) + lost * sin)])


class BaseTilt(AbstractBaseTilt):
    """The side that the arm points to at zero rises."""

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=0.0175)
    what: ClassVar[str] = "base_tilt"
    meaning: ClassVar[str] = "tilt of the base towards the arm's zero"
    towards: ClassVar[float] = 0.0


class BaseTiltSide(AbstractBaseTilt):
    """The side that the arm points to at a quarter turn rises."""

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=0.0175)
    what: ClassVar[str] = "base_tilt_side"
    meaning: ClassVar[str] = "tilt of the base across the arm's zero"
    towards: ClassVar[float] = 0.5 * math.pi


class Payload(AbstractJointEffect):
    """A point of ``magnitude`` kilograms at the pole's free end, at ``2 l``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "payload"
    meaning: ClassVar[str] = "mass at the pole's end"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {Furuta: "alpha", CartPole: "theta"})
        return "kg"

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        cos, sin = cosine(q[1]), sine(q[1])
        if isinstance(system, Furuta):
            r, end = params.arm_length, params.pendulum_length
            return x * (r**2 + end**2 * sin**2), x * end * r * cos, x * end**2
        end = 2.0 * params.pole_half_length
        return x, x * end * cos, x * end**2

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        cos, sin = cosine(q[1]), sine(q[1])
        if isinstance(system, Furuta):
            r, end = params.arm_length, params.pendulum_length
            slope = 2.0 * x * end**2 * sin * cos
            first = -slope * v[0] * v[1] + x * end * r * sin * v[1] ** 2
            second = 0.5 * slope * v[0] ** 2
        else:
            end = 2.0 * params.pole_half_length
            first, second = x * end * sin * v[1] ** 2, jnp.zeros_like(x)
        weight = x * end * gravity_of(system) * sin
        return jnp.stack([first, second - weight])
