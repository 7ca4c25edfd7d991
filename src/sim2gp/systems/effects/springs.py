"""Springs: what pulls a joint back."""

from typing import ClassVar

import equinox as eqx

from sim2gp.systems.effects.base import SUBSTEP, AbstractJointForce
from sim2gp.types import Scalar


class AbstractSpring(AbstractJointForce):
    """A force by a joint's position alone."""

    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        return v + self.along(x, q, v) * t


class Spring(AbstractSpring):
    """A cable that pulls a joint back to zero, ``-magnitude q``."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    what: ClassVar[str] = "spring"
    powers: ClassVar[tuple[int, int]] = 1, 0
    meaning: ClassVar[str] = "stiffness of a cable"
    max_substep: ClassVar[float] = SUBSTEP

    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        return -x * q
