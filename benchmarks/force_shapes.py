"""Forces that no registry has, for `planted_forces.py`: each a curve of one variable.

A law takes -1 to 1 for the range of its variable and gives values of about 1.
"""

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp.systems import AbstractPlant
from sim2gp.systems.effects.base import AbstractForce, AbstractInputEffect, on_joint
from sim2gp.systems.effects.units import force_unit
from sim2gp.systems.mechanism import AbstractMechanism, Pair
from sim2gp.types import Scalar

#: A curve of a variable in units of its range, in units of its size.
Law = Callable[[Any], Any]


def dead_spring(z: Any) -> Any:
    """A spring with play: nothing until a third of the range, then stiff."""
    return (
        jax.nn.softplus(-(z + 0.35) / 0.04) - jax.nn.softplus((z - 0.35) / 0.04)
    ) / 16.0


def notch(z: Any) -> Any:
    """A detent: what holds the joint near one place."""
    at = (z - 0.2) / 0.2
    return -at * jnp.exp(0.5 * (1.0 - at**2))


def cogging(z: Any) -> Any:
    """Twelve poles in a turn of ``z`` rad."""
    return -jnp.sin(12.0 * z)


def stribeck(z: Any) -> Any:
    """Friction that falls from breakaway at a speed of its own, not to a half."""
    return -(0.35 + 0.65 * jnp.exp(-jnp.abs(z / 0.15))) * jnp.tanh(z / 0.01)


def saturation(z: Any) -> Any:
    """What a saturating motor takes away of its input."""
    return 0.6 * jnp.tanh(z / 0.6) - z


def cable(z: Any) -> Any:
    """A hanging cable that comes taut on one side."""
    return -jnp.exp(2.5 * (z - 1.0))


class Shape(NamedTuple):
    law: Law
    of: str  # "position", "velocity" or "input"


SHAPES = {
    "dead_spring": Shape(dead_spring, "position"),
    "notch": Shape(notch, "position"),
    "cogging": Shape(cogging, "position"),
    "stribeck": Shape(stribeck, "velocity"),
    "saturation": Shape(saturation, "input"),
    "cable": Shape(cable, "position"),
}


class ShapedForce(AbstractForce):
    """``magnitude law((z - centre) / reach)`` on a joint, by position or velocity."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    centre: float = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    shape: str = eqx.field(static=True)
    what: ClassVar[str] = "shaped_force"
    meaning: ClassVar[str] = "force of a shape that no registry has"
    max_substep: ClassVar[float] = 0.001

    def unit(self, plant: AbstractPlant) -> str:
        return force_unit(plant, self.where)

    @property
    def of(self) -> str:
        """The channel that it is a function of."""
        by_speed = SHAPES[self.shape].of == "velocity"
        return f"{self.where}.velocity" if by_speed else self.where

    def law(self, z: Any) -> Any:
        """The curve for a magnitude of one."""
        return SHAPES[self.shape].law((z - self.centre) / self.reach)

    def value(self, z: Any) -> Any:
        """The curve at the magnitude."""
        return self.magnitude * self.law(z)

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        z = v[i] if SHAPES[self.shape].of == "velocity" else q[i]
        return on_joint(i, x * self.law(z))


class ShapedInput(AbstractInputEffect):
    """``u + magnitude law(u / reach)`` arrives of an input ``u``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    reach: float = eqx.field(static=True)
    shape: str = eqx.field(static=True)
    what: ClassVar[str] = "shaped_input"
    meaning: ClassVar[str] = "input of a shape that no registry has"
    max_substep: ClassVar[float] = 0.001

    @property
    def of(self) -> str:
        """The channel that it is a function of."""
        return self.where

    def law(self, z: Any) -> Any:
        """What is added, for a magnitude of one."""
        return SHAPES[self.shape].law(z / self.reach)

    def value(self, z: Any) -> Any:
        """What is added, at the magnitude."""
        return self.magnitude * self.law(z)

    def through(self, x: Scalar, u: Scalar) -> Scalar:
        return u + x * self.law(u)


Planted = ShapedForce | ShapedInput
