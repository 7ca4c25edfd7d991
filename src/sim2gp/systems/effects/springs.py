"""Springs: what pulls a joint back."""

from typing import ClassVar

import equinox as eqx

from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import SUBSTEP, AbstractJointForce
from sim2gp.systems.effects.units import unit_per
from sim2gp.types import Scalar


class Spring(AbstractJointForce):
    """A cable that pulls a joint back to zero, ``-magnitude q``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "spring"
    meaning: ClassVar[str] = "stiffness of a cable"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        return unit_per(plant, self.where, "")

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -x * q

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        return v - x * q * t
