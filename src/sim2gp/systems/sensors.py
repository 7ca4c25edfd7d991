"""Encoders whose zeros are off: any machine, seen at another place than it is.

    true position = measured position + offset

Each offset is an ordinary constant, ``<joint>.encoder``, in the joint's unit. The
machine's equations are its own at the true position, limits and gravity with them.
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.base import AbstractPlant, Channel, index_of
from sim2gp.types import Action, Scalar, State

MEANING = "offset of the encoder's zero"
SPREAD = 0.05  # rad or m, the sd of an offset that is only called free


class ZeroedParams(eqx.Module):
    """Constants of the machine, and how far each state is from what is measured."""

    system: Any
    offset: Float[Array, " n"]


class Zeroed(AbstractPlant):
    """A machine behind encoders with offsets, by joint: a prior, or a number.

    Raises `InputError` E103 for an unknown joint, E145 for one that is no position.
    """

    system: AbstractPlant
    parameters: Parameters = eqx.field(static=True)
    joints: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self, system: AbstractPlant, offsets: Mapping[str, Parameter | float]
    ) -> None:
        self.system, self.joints = system, tuple(offsets)
        table = Parameters(tuple(offset_prior(system, j) for j in offsets))
        stated = {f"{joint}.encoder": offset for joint, offset in offsets.items()}
        self.parameters = system.parameters.merge(table.replace(**stated))

    def check_functions(self) -> None:
        """The machine inside has checked its own."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.system.states

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.system.actions

    @property
    def max_substep(self) -> float:
        return self.system.max_substep

    @property
    def window_substep(self) -> float:
        return self.system.window_substep

    def record(self, values: Mapping[str, Scalar]) -> ZeroedParams:
        known = {joint: values[f"{joint}.encoder"] for joint in self.joints}
        none = jnp.zeros_like(next(iter(known.values())))
        offset = jnp.stack([known.get(c.name, none) for c in self.states])
        return ZeroedParams(self.system.record(values), offset)

    def flow(
        self, params: ZeroedParams, s: State, a: Action, h: float | Scalar
    ) -> State:
        offset = params.offset.astype(s.dtype)
        return self.system.flow(params.system, s + offset, a, h) - offset


def offset_prior(system: AbstractPlant, joint: str) -> Parameter:
    """An offset that is only called free, of a joint of the machine."""
    channel = system.states[index_of(joint, system.states)]
    if channel.unit not in ("rad", "m"):
        got, expected = channel.unit, "a joint's position, in rad or m"
        raise InputError("E145", f"encoder of {joint}", got=got, expected=expected)
    name = f"{joint}.encoder"
    return Parameter(name, channel.unit, MEANING, "identity", mean=0.0, sd=SPREAD)
