"""Springs: what pulls a joint back."""

from typing import Any, ClassVar

import equinox as eqx

from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import SUBSTEP, AbstractForce, on_joint
from sim2gp.systems.effects.units import unit_per
from sim2gp.systems.mechanism import AbstractMechanism, Pair
from sim2gp.types import Scalar


class Spring(AbstractForce):
    """A cable that pulls a joint back to zero, ``-magnitude q``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "spring"
    meaning: ClassVar[str] = "stiffness of a cable"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: AbstractPlant) -> str:
        return unit_per(plant, self.where, "")

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return on_joint(i, -x * q[i])
