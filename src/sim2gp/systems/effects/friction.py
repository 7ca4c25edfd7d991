"""Friction: dry, viscous and quadratic."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from sim2gp import checks
from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import (
    SUBSTEP,
    AbstractForce,
    AbstractJointForce,
    on_joint,
)
from sim2gp.systems.effects.friction_laws import (
    COULOMB_SUBSTEP,
    coulomb,
    quadratic_drag,
    slowed_by_coulomb,
)
from sim2gp.systems.effects.units import gravity_of, only_on
from sim2gp.systems.mechanism import AbstractMechanism, Pair
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.types import Scalar


class Coulomb(AbstractJointForce):
    """Dry friction of a joint, ``-magnitude tanh(v / width)``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    width: float = eqx.field(static=True, default=0.05)
    what: ClassVar[str] = "coulomb"
    powers: ClassVar[tuple[int, int]] = 0, 0
    meaning: ClassVar[str] = "dry friction"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("Coulomb", width=self.width)

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -coulomb(v, x, self.width)

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        return slowed_by_coulomb(v, x, self.width, t)


class RailFriction(AbstractForce):
    """Dry friction of a cart by its weight, ``-magnitude (m_c + m_p) g tanh``."""

    where: str = eqx.field(static=True, default="x")
    magnitude: float = eqx.field(static=True, default=0.02)
    width: float = eqx.field(static=True, default=0.01)  # m/s
    what: ClassVar[str] = "rail_friction"
    meaning: ClassVar[str] = "friction coefficient of the rail"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("RailFriction", width=self.width)

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {CartPole: "x"})
        return "1"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        weight = (params.cart_mass + params.pole_mass) * gravity_of(system)
        return on_joint(0, -coulomb(v[0], x * weight, self.width))


class Stribeck(AbstractJointForce):
    """Friction that is twice as large at rest as in motion.

    ``-magnitude (1 + exp(-(v / speed)^2)) / 2 tanh(v / width)``: ``magnitude`` is the
    level at breakaway, half of it the level of fast motion (Armstrong-Helouvry 1991).
    """

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    width: float = eqx.field(static=True, default=0.05)
    speed: float = eqx.field(static=True, default=1.0)
    what: ClassVar[str] = "stribeck"
    powers: ClassVar[tuple[int, int]] = 0, 0
    meaning: ClassVar[str] = "friction that falls from rest to motion"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("Stribeck", width=self.width, speed=self.speed)

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -coulomb(v, self._level(x, v), self.width)

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        # The level of the middle of the time: of second order.
        middle = slowed_by_coulomb(v, self._level(x, v), self.width, 0.5 * t)
        return slowed_by_coulomb(v, self._level(x, middle), self.width, t)

    def _level(self, x: Scalar, v: Scalar) -> Scalar:
        return 0.5 * x * (1.0 + jnp.exp(-((v / self.speed) ** 2)))


class Viscous(AbstractJointForce):
    """Damping of a joint, ``-magnitude v``, such as the back-EMF of its motor."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    #: Older project files and runs say ``back_emf``.
    what: str = eqx.field(static=True, default="viscous")
    powers: ClassVar[tuple[int, int]] = 0, 1
    meaning: ClassVar[str] = "damping, such as a motor's back-EMF"
    max_substep: ClassVar[float] = SUBSTEP

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -x * v

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        return v * jnp.exp(-x * t)


class Drag(AbstractJointForce):
    """Quadratic drag of a joint, ``-magnitude v |v|``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "drag"
    powers: ClassVar[tuple[int, int]] = 0, 2
    meaning: ClassVar[str] = "quadratic drag"
    max_substep: ClassVar[float] = SUBSTEP

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -quadratic_drag(v, x)

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        return v / (1.0 + x * jnp.abs(v) * t)
