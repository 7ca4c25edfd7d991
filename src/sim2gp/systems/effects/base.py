"""Physics that a real machine has and a simulator may lack: the mismatch catalogue.

An effect adds to the equations of a two-joint machine,

    (M + dM(q)) dv/dt = forces(q, v, input(a)) + force(q, v),

and has one scalar magnitude, zero for no effect. `sim2gp.systems.effects.perturbed`
makes a system of a machine and its effects and holds their registered strengths.
"""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractClassVar, AbstractVar
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import (
    AbstractMechanism,
    Inertia,
    index_of,
)
from sim2gp.systems.effects.friction_laws import (
    COULOMB_SUBSTEP,
    coulomb,
    dead_zone,
    quadratic_drag,
)
from sim2gp.systems.effects.units import force_unit, gravity_of, only_on, unit_per
from sim2gp.systems.plants.cartpole import CartPole
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.types import Action, Scalar

_SUBSTEP = 0.005  # s; a true, perturbed machine is integrated twice as finely

Pair = Float[Array, " 2"]


class AbstractEffect(eqx.Module):
    """One missing piece of physics, on the channel ``where``, of one ``magnitude``.

    ``what`` names the effect, ``unit`` its magnitude's unit (``{}`` stands for the
    channel's own), ``max_substep`` the RK4 substep it needs in seconds. Raises E148 for
    a magnitude that is not finite, a width or so that is not positive.
    """

    where: AbstractVar[str]
    magnitude: AbstractVar[float]
    what: AbstractClassVar[str]
    meaning: AbstractClassVar[str]
    max_substep: AbstractClassVar[float]

    def __check_init__(self) -> None:
        checks.finite(type(self).__name__, magnitude=self.magnitude)

    @abc.abstractmethod
    def unit(self, system: AbstractMechanism) -> str:
        """Unit of the magnitude; E103 or E145 where the machine cannot have it."""

    @abc.abstractmethod
    def input(self, system: AbstractMechanism, x: Scalar, a: Action) -> Action:
        """What the machine's equations see in place of the input ``a``."""

    @abc.abstractmethod
    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        """Additional ``M11, M12, M22``, for the magnitude ``x``."""

    @abc.abstractmethod
    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        """Additional generalised forces, for the magnitude ``x``."""

    @property
    def name(self) -> str:
        """Name of the magnitude among the constants: ``<where>.<what>``."""
        return f"{self.where}.{self.what}"

    def parameter(self, system: AbstractMechanism) -> Parameter:
        """The magnitude as a free constant: no effect in the mean, sd its magnitude."""
        unit = self.unit(system)
        sd = abs(self.magnitude)
        return Parameter(self.name, unit, self.meaning, "identity", mean=0.0, sd=sd)


class AbstractForce(AbstractEffect):
    """An effect that only adds forces."""

    def input(self, system: AbstractMechanism, x: Scalar, a: Action) -> Action:
        return a

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        none = jnp.zeros_like(x)
        return none, none, none


class AbstractGeometry(AbstractEffect):
    """An effect on the mass distribution: inertia, and the forces that go with it."""

    def input(self, system: AbstractMechanism, x: Scalar, a: Action) -> Action:
        return a


class AbstractInputEffect(AbstractEffect):
    """An effect on the input ``where`` alone; its magnitude has the input's unit."""

    @abc.abstractmethod
    def through(self, x: Scalar, u: Scalar) -> Scalar:
        """What arrives of the input ``u``, for the magnitude ``x``."""

    def unit(self, system: AbstractMechanism) -> str:
        return system.actions[index_of(self.where, system.actions)].unit

    def input(self, system: AbstractMechanism, x: Scalar, a: Action) -> Action:
        i = index_of(self.where, system.actions)
        return a.at[i].set(self.through(x, a[i]))

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        none = jnp.zeros_like(x)
        return none, none, none

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        return jnp.zeros_like(v)


class Coulomb(AbstractForce):
    """Dry friction of a joint, ``-magnitude tanh(v / width)``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    width: float = eqx.field(static=True, default=0.05)
    what: ClassVar[str] = "coulomb"
    meaning: ClassVar[str] = "dry friction"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("Coulomb", width=self.width)

    def unit(self, system: AbstractMechanism) -> str:
        return force_unit(system, self.where)

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return _on_joint(i, -coulomb(v[i], x, self.width))


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

    def unit(self, system: AbstractMechanism) -> str:
        only_on(self.name, system, {CartPole: "x"})
        return "1"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        weight = (params.cart_mass + params.pole_mass) * gravity_of(system)
        return _on_joint(0, -coulomb(v[0], x * weight, self.width))


class Stribeck(AbstractForce):
    """Friction that is twice as large at rest as in motion.

    ``-magnitude (1 + exp(-(v / speed)^2)) / 2 tanh(v / width)``: ``magnitude`` is the
    level at breakaway, half of it the level of fast motion (Armstrong-Helouvry 1991).
    """

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    width: float = eqx.field(static=True, default=0.05)
    speed: float = eqx.field(static=True, default=1.0)
    what: ClassVar[str] = "stribeck"
    meaning: ClassVar[str] = "friction that falls from rest to motion"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("Stribeck", width=self.width, speed=self.speed)

    def unit(self, system: AbstractMechanism) -> str:
        return force_unit(system, self.where)

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        level = 0.5 * x * (1.0 + jnp.exp(-((v[i] / self.speed) ** 2)))
        return _on_joint(i, -coulomb(v[i], level, self.width))


class BackEmf(AbstractForce):
    """A motor that brakes with its speed, ``-magnitude v``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "back_emf"
    meaning: ClassVar[str] = "braking by the motor's back-EMF"
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        return unit_per(system, self.where, " s")

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return _on_joint(i, -x * v[i])


class Spring(AbstractForce):
    """A cable that pulls a joint back to zero, ``-magnitude q``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "spring"
    meaning: ClassVar[str] = "stiffness of a cable"
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        return unit_per(system, self.where, "")

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return _on_joint(i, -x * q[i])


class Drag(AbstractForce):
    """Quadratic drag of a joint, ``-magnitude v |v|``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "drag"
    meaning: ClassVar[str] = "quadratic drag"
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        return unit_per(system, self.where, " s^2", square=True)

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return _on_joint(i, -quadratic_drag(v[i], x))


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
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        only_on(self.name, system, {CartPole: "x"})
        return "rad"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        p, g = params, gravity_of(system)
        up, lost = jnp.sin(x), 2.0 * jnp.sin(0.5 * x) ** 2
        lever = lost * jnp.sin(q[1]) - up * jnp.cos(q[1])
        return g * jnp.stack(
            [
                -up * (p.cart_mass + p.pole_mass),
                p.pole_mass * p.pole_half_length * lever,
            ]
        )


class RodInertia(AbstractGeometry):
    """The rod inertia that the published Furuta model omits: ``magnitude Jp``.

    ``A`` gains ``Jp sin^2(alpha)``, both ``sin(2 alpha)`` terms gain ``Jp``;
    a magnitude of 1 is the true uniform rod.
    """

    where: str = eqx.field(static=True, default="alpha")
    magnitude: float = eqx.field(static=True, default=1.0)
    what: ClassVar[str] = "rod_inertia"
    meaning: ClassVar[str] = "share of the rod's own inertia in the arm's equation"
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        only_on(self.name, system, {Furuta: "alpha"})
        return "1"

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        none = jnp.zeros_like(x)
        return self._inertia(params, x) * jnp.sin(q[1]) ** 2, none, none

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        slope = self._inertia(params, x) * jnp.sin(2.0 * q[1])
        return slope * jnp.stack([-v[0] * v[1], 0.5 * v[0] ** 2])

    @staticmethod
    def _inertia(params: Any, x: Scalar) -> Scalar:
        return x * params.pendulum_mass * params.pendulum_length**2 / 12.0


class PoleGeometry(AbstractGeometry):
    """A pole whose centre is ``magnitude`` farther from the pivot than its middle.

    With ``d = l + magnitude`` the first moment is ``m_p d`` and the inertia about the
    pivot ``m_p l^2 / 3 + m_p d^2``. The maker's pole has ``d = 0.1778 m``, 9.5 mm off,
    and an inertia about its centre within 0.2 % of the uniform rod's.
    """

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=0.0095)
    what: ClassVar[str] = "geometry"
    meaning: ClassVar[str] = "distance of the pole's centre from its middle"
    max_substep: ClassVar[float] = _SUBSTEP

    def unit(self, system: AbstractMechanism) -> str:
        only_on(self.name, system, {CartPole: "theta"})
        return "m"

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        m, l = params.pole_mass, params.pole_half_length
        moved = m * x * (2.0 * l + x)  # m (l + x)^2 - m l^2
        return jnp.zeros_like(x), m * x * jnp.cos(q[1]), moved

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        first = params.pole_mass * x * jnp.sin(q[1])
        return jnp.stack([first * v[1] ** 2, -first * gravity_of(system)])


class DeadZone(AbstractInputEffect):
    """An input without effect below ``magnitude``, in the input's unit."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    smoothing: float = eqx.field(static=True, default=0.05)
    what: ClassVar[str] = "dead_zone"
    meaning: ClassVar[str] = "dead zone of the input"
    max_substep: ClassVar[float] = _SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("DeadZone", smoothing=self.smoothing)

    def through(self, x: Scalar, u: Scalar) -> Scalar:
        return dead_zone(u, x, self.smoothing)


def _on_joint(i: int, f: Scalar) -> Pair:
    none = jnp.zeros_like(f)
    return jnp.stack([f, none] if i == 0 else [none, f])
