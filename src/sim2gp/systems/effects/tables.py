"""Forces as tables: what was found of a shape that has no name.

A force along a joint, by its position or by its velocity, or what is added to an input,
is linear between the points of a table and constant beyond them, times a magnitude that
is one for the table as it is.
"""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import (
    SUBSTEP,
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointForce,
)
from sim2gp.systems.effects.friction_laws import COULOMB_SUBSTEP
from sim2gp.systems.effects.springs import AbstractSpring
from sim2gp.types import Scalar

#: Pairs of the variable and the force there, by the variable.
Points = tuple[tuple[float, float], ...]
MOST = 1000  # points of a table
LINE: Points = ((0.0, 0.0), (1.0, 1.0))


class AbstractTable(AbstractEffect):
    """What all tables have: their points (E148 for ones that are no table)."""

    points: eqx.AbstractVar[Points]

    def __check_init__(self) -> None:
        found = np.asarray(self.points, float).reshape(-1, 2)
        good = 2 <= len(found) <= MOST and bool(np.all(np.isfinite(found)))
        if not (good and np.all(np.diff(found[:, 0]) > 0.0)):
            got = f"{len(found)} points"
            raise error("points_of_table", name=self.name, got=got, most=str(MOST))

    def parameter(self, plant: AbstractPlant) -> Parameter:
        """About the table as it is."""
        about = self.name, "1", self.meaning, "identity"
        self.unit(plant)
        return Parameter(*about, mean=1.0, sd=abs(self.magnitude))

    def looked_up(self, z: Scalar) -> Scalar:
        """The table at ``z``."""
        x, y = np.asarray(self.points).T
        return jnp.interp(z, x.astype(z.dtype), y.astype(z.dtype))

    def slope(self, z: Scalar) -> Scalar:
        """Its derivative; 0 beyond its ends."""
        x, y = np.asarray(self.points).T
        slopes = np.concatenate([[0.0], np.diff(y) / np.diff(x), [0.0]])
        place = jnp.searchsorted(x.astype(z.dtype), z, side="right")
        return jnp.asarray(slopes, z.dtype)[place]


class PositionTable(AbstractTable, AbstractSpring):
    """A force by a joint's position, ``magnitude`` times a table."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    points: Points = eqx.field(static=True, default=LINE)
    what: ClassVar[str] = "position_table"
    powers: ClassVar[tuple[int, int]] = 0, 0
    meaning: ClassVar[str] = "force by position, as a table"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        super().unit(plant)  # the joint must be there
        return "1"

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return x * self.looked_up(q)


class VelocityTable(AbstractTable, AbstractJointForce):
    """A force by a joint's velocity, ``magnitude`` times a table."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    points: Points = eqx.field(static=True, default=LINE)
    what: ClassVar[str] = "velocity_table"
    powers: ClassVar[tuple[int, int]] = 0, 0
    meaning: ClassVar[str] = "force by velocity, as a table"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        super().unit(plant)
        return "1"

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return x * self.looked_up(v)

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        # Exact on the line that the velocity is on: friction may be steep.
        rate = x * self.slope(v) * t
        flat = jnp.abs(rate) < 1e-6
        safe = jnp.where(flat, 1.0, rate)
        share = jnp.where(flat, 1.0 + 0.5 * rate, jnp.expm1(safe) / safe)
        return v + t * share * self.along(x, q, v)


class InputTable(AbstractTable, AbstractInputEffect):
    """What is added to an input by its value, ``magnitude`` times a table."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    points: Points = eqx.field(static=True, default=LINE)
    what: ClassVar[str] = "input_table"
    meaning: ClassVar[str] = "change of the input, as a table"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        super().unit(plant)
        return "1"

    def through(self, x: Scalar, u: Scalar) -> Scalar:
        return u + x * self.looked_up(u)


TABLES: tuple[type[AbstractTable], ...] = PositionTable, VelocityTable, InputTable
