"""Encoders whose zeros are off: any plant, at another position than is measured.

    true position = measured position + offset

The plant's equations are its own at the true position, limits and gravity with them. On
the first joint of a vertical arm this is also a tilt of its base in the plane.
"""

from typing import ClassVar

import equinox as eqx

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant, index_of
from sim2gp.systems.parts import AbstractPart, around_nothing

SPREAD = 0.05  # rad or m, the sd of an offset that is only called free


class EncoderOffset(AbstractPart):
    """A joint whose true position is the measured one plus ``magnitude``.

    Free, its sd is the magnitude. Raises E145 for a channel that is no position.
    """

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True, default=0.0)
    what: ClassVar[str] = "encoder"
    meaning: ClassVar[str] = "offset of the encoder's zero"

    def unit(self, plant: AbstractPlant) -> str:
        unit = plant.states[index_of(self.where, plant.states)].unit
        if unit not in ("rad", "m"):
            raise error("encoder_of_no_position", got=unit, state=self.where)
        return unit

    def parameter(self, plant: AbstractPlant) -> Parameter:
        return around_nothing(self, plant, abs(self.magnitude) or SPREAD)
