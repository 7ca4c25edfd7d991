"""A part of a machine: parameters that its plant does not have, with their priors.

Effects, sensors and actuators are parts. A machine holds them in tuples
(`sim2gp.systems.machine`). Nearly all have one parameter, named ``<where>.<what>``,
except for actuators that share that of another input.
"""

import abc
from collections.abc import Mapping

import equinox as eqx
from equinox import AbstractClassVar, AbstractVar

from sim2gp import checks
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant
from sim2gp.types import AnyArray, Scalar


class AbstractPart(eqx.Module):
    """A part on the channel ``where``, of one ``magnitude``.

    ``meaning`` describes it. Raises `InputError` E148 for a magnitude that is not
    finite.
    """

    where: AbstractVar[str]
    magnitude: AbstractVar[float]
    meaning: AbstractClassVar[str]

    def __check_init__(self) -> None:
        checks.finite(type(self).__name__, magnitude=self.magnitude)

    @property
    @abc.abstractmethod
    def what(self) -> str:
        """What kind of part this is, in one word."""

    @property
    def place(self) -> str:
        """Where the part is: ``<where>.<what>``; a machine has one part there."""
        return f"{self.where}.{self.what}"

    @property
    def name(self) -> str:
        """Name of the parameter, which is that of the place unless it is shared."""
        return self.place

    @property
    def values(self) -> dict[str, float]:
        """Its parameters by name, at the values that they have unless freed."""
        return {self.name: self.magnitude}

    def own(self, values: Mapping[str, Scalar]) -> AnyArray:
        """What its functions take, out of all values: the magnitude."""
        return values[self.name]

    @abc.abstractmethod
    def unit(self, plant: AbstractPlant) -> str:
        """Unit of the parameter; E103 or E145 where the plant cannot have the part."""

    @abc.abstractmethod
    def parameter(self, plant: AbstractPlant) -> Parameter:
        """The parameter with its prior, to free it."""

    def priors(self, plant: AbstractPlant) -> tuple[Parameter, ...]:
        """All of its parameters with their priors."""
        return (self.parameter(plant),)


def around_nothing(part: AbstractPart, plant: AbstractPlant, sd: float) -> Parameter:
    """A parameter that is zero in the mean."""
    unit = part.unit(plant)
    return Parameter(part.name, unit, part.meaning, "identity", mean=0.0, sd=sd)
