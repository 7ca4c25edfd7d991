"""Masses that are distributed otherwise than the simulator says."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp

from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import SUBSTEP, AbstractJointEffect
from sim2gp.systems.effects.units import gravity_of, only_on
from sim2gp.systems.mechanism import AbstractMechanism, Inertia, Pair
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Scalar


class RodInertia(AbstractJointEffect):
    """The rod inertia that the published Furuta model omits: ``magnitude Jp``.

    ``A`` gains ``Jp sin^2(alpha)``, both ``sin(2 alpha)`` terms gain ``Jp``;
    a magnitude of 1 is the true uniform rod.
    """

    where: str = eqx.field(static=True, default="alpha")
    magnitude: float = eqx.field(static=True, default=1.0)
    what: ClassVar[str] = "rod_inertia"
    meaning: ClassVar[str] = "share of the rod's own inertia in the arm's equation"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {Furuta: "alpha"})
        return "1"

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        none = jnp.zeros_like(x)
        return self._inertia(params, x) * sine(q[1]) ** 2, none, none

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        slope = self._inertia(params, x) * sine(2.0 * q[1])
        return slope * jnp.stack([-v[0] * v[1], 0.5 * v[0] ** 2])

    @staticmethod
    def _inertia(params: Any, x: Scalar) -> Scalar:
        return x * params.pendulum_mass * params.pendulum_length**2 / 12.0


class PoleGeometry(AbstractJointEffect):
    """A pole whose centre is ``magnitude`` farther from the pivot than its middle.

    With ``d = l + magnitude`` the first moment is ``m_p d`` and the inertia about the
    pivot ``m_p l^2 / 3 + m_p d^2``. The maker's pole has ``d = 0.1778 m``, 9.5 mm off,
    and an inertia about its centre within 0.2 % of the uniform rod's.
    """

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=0.0095)
    what: ClassVar[str] = "geometry"
    meaning: ClassVar[str] = "distance of the pole's centre from its middle"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        only_on(self.name, plant, {CartPole: "theta"})
        return "m"

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        m, l = params.pole_mass, params.pole_half_length
        moved = m * x * (2.0 * l + x)  # m (l + x)^2 - m l^2
        return jnp.zeros_like(x), m * x * cosine(q[1]), moved

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        first = params.pole_mass * x * sine(q[1])
        return jnp.stack([first * v[1] ** 2, -first * gravity_of(system)])
