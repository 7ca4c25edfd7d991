"""Effects on an input: what arrives of it."""

from typing import ClassVar

import equinox as eqx

from sim2gp import checks
from sim2gp.systems.effects.base import SUBSTEP, AbstractInputEffect
from sim2gp.systems.effects.friction_laws import dead_zone
from sim2gp.types import Scalar


class DeadZone(AbstractInputEffect):
    """An input without effect below ``magnitude``, in the input's unit."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    smoothing: float = eqx.field(static=True, default=0.05)
    what: ClassVar[str] = "dead_zone"
    meaning: ClassVar[str] = "dead zone of the input"
    max_substep: ClassVar[float] = SUBSTEP

    def __check_init__(self) -> None:
        checks.positive("DeadZone", smoothing=self.smoothing)

    def through(self, x: Scalar, u: Scalar) -> Scalar:
        return dead_zone(u, x, self.smoothing)
