"""What lies between a command and the force: gain, offset and delay of each input.

    u_effective(t) = gain u(t - delay) + offset

Each is an ordinary constant, ``<input>.gain``, ``<input>.offset`` (in the input's
unit) and ``<input>.delay`` (in seconds): free with a prior, or fixed. Gain and offset
act inside `flow`; the delay acts on the held input (`sim2gp.systems.base`), by `step`
on the past actions that the state carries, or by whoever calls `flow` with the delayed
mean input.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.base import AbstractSystem, Channel, delayed_means
from sim2gp.systems.sensors import Zeroed
from sim2gp.systems.variants import Configured
from sim2gp.types import Action, Scalar, State

#: An input that moves within a period is averaged over no more than this, s.
LONGEST_MEAN = 0.01
_NEUTRAL = {"gain": 1.0, "offset": 0.0, "delay": 0.0}


class ActuatedParams(eqx.Module):
    """Constants of the machine, and of each of its inputs."""

    system: Any
    gain: Float[Array, " m"]
    offset: Float[Array, " m"]
    delay: Float[Array, " m"]


class AbstractInputPath(AbstractSystem):
    """A system behind something that remembers its inputs.

    The state carries ``past`` actions, newest first, as channels ``voltage[-1]``,
    ``voltage[-2]``, ...
    """

    system: AbstractVar[AbstractSystem]
    past: AbstractVar[int]

    def check_functions(self) -> None:
        """The machine inside has checked its own."""

    @property
    def states(self) -> tuple[Channel, ...]:
        past = tuple(
            dataclasses.replace(channel, name=f"{channel.name}[-{k}]")
            for k in range(1, self.past + 1)
            for channel in self.actions
        )
        return self.system.states + past

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.system.actions

    @property
    def max_substep(self) -> float:
        return min(self.system.max_substep, LONGEST_MEAN)

    @property
    def window_substep(self) -> float:
        return self.system.window_substep

    @property
    def history(self) -> int:
        return self.past


def bare(system: AbstractSystem) -> AbstractSystem:
    """A system without what lies before its inputs and behind its states."""
    while isinstance(system, AbstractInputPath | Zeroed | Configured):
        system = system.system
    return system


class Actuated(AbstractInputPath):
    """A system behind its actuators.

    ``actuators`` maps names such as ``voltage.delay`` to a `Parameter` (free) or a
    number (fixed); what is not named is neutral. For use as a one-step `Dynamics`,
    ``delay_max`` seconds of past actions of ``period`` seconds are carried in the
    state, as channels ``voltage[-1]``, ``voltage[-2]``, ...; without it the delay is
    left to the caller of `flow` (the likelihood over windows). Raises `InputError` E145
    for an unknown name, E141 for a delay that can be negative or has no end, E148 for a
    period that is not positive or a negative ``delay_max``.
    """

    system: AbstractSystem
    parameters: Parameters = eqx.field(static=True)
    past: int = eqx.field(static=True)

    def __init__(
        self,
        system: AbstractSystem,
        actuators: Mapping[str, Parameter | float] | None = None,
        *,
        parameters: Parameters | None = None,
        delay_max: float = 0.0,
        period: float = 0.02,
    ) -> None:
        if isinstance(system, Actuated):
            raise InputError("E145", "system is actuated already")
        checks.not_negative("Actuated", delay_max=delay_max)
        checks.positive("Actuated", period=period)
        table = system.parameters.merge(_neutral(system.actions))
        if parameters is not None:
            table = _same_names(table, parameters)
        self.system = system
        self.parameters = table.replace(**dict(actuators or {}))
        self.past = math.ceil(delay_max / period - 1e-9)
        for channel in system.actions:
            low, high = self._delay_range(channel)
            if low < 0.0 or high == math.inf:
                raise InputError(
                    "E141",
                    f"{channel.name}.delay",
                    got=f"from {low:g} to {high:g} s",
                    expected="a delay of zero or more, with an end",
                    fix="give it a box [0, high]",
                )

    @property
    def longest_delay(self) -> float:
        return max(self._delay_range(channel)[1] for channel in self.actions)

    def record(self, values: Mapping[str, Scalar]) -> ActuatedParams:
        def each(quantity: str) -> Float[Array, " m"]:
            return jnp.stack([values[f"{c.name}.{quantity}"] for c in self.actions])

        return ActuatedParams(
            self.system.record(values), each("gain"), each("offset"), each("delay")
        )

    def flow(
        self, params: ActuatedParams, s: State, a: Action, h: float | Scalar
    ) -> State:
        """The machine's own, under ``gain a + offset``; ``s`` is its physical state."""
        return self.system.flow(params.system, s, params.gain * a + params.offset, h)

    def delays(self, params: ActuatedParams) -> Float[Array, " m"]:
        return params.delay

    def mean_inputs(
        self,
        params: ActuatedParams,
        held: Float[Array, "past m"],
        dt: float,
        count: int,
    ) -> Float[Array, "count m"]:
        return delayed_means(held, dt, params.delay, count)

    def neutral(self, params: Any) -> ActuatedParams:
        """A record of the bare machine, with unit gains and no offset or delay."""
        one = jnp.ones_like(self.system.delays(params))
        return ActuatedParams(params, one, 0.0 * one, 0.0 * one)

    def _delay_range(self, channel: Channel) -> tuple[float, float]:
        """Least and largest delay that the table allows, in seconds."""
        name = f"{channel.name}.delay"
        fixed = dict(self.parameters.fixed)
        if name in fixed:
            return fixed[name], fixed[name]
        return self.parameters[name].low, self.parameters[name].high


def actuator_prior(
    channel: Channel, quantity: str, delay_max: float = 0.02
) -> Parameter:
    """A broad prior for the gain, offset or delay of an input, to free it with.

    A gain within a factor of two, an offset within a tenth of the input's range, a
    delay up to ``delay_max`` seconds.
    """
    name = f"{channel.name}.{quantity}"
    if quantity == "gain":
        return Parameter(name, "1", f"gain of {channel.name}", "log_box", 0.5, 2.0)
    if quantity == "delay":
        return Parameter(name, "s", f"delay of {channel.name}", "box", 0.0, delay_max)
    span = channel.high - channel.low
    edge = 0.1 * span if math.isfinite(span) else 1.0
    return Parameter(
        name, channel.unit, f"offset of {channel.name}", "box", -edge, edge
    )


def _neutral(channels: tuple[Channel, ...]) -> Parameters:
    fixed = [(f"{c.name}.{q}", v) for c in channels for q, v in _NEUTRAL.items()]
    return Parameters((), tuple(fixed))


def _same_names(table: Parameters, given: Parameters) -> Parameters:
    """The given table, completed by the neutral constants it does not mention."""
    changes: dict[str, Parameter | float] = {p.name: p for p in given.free}
    return table.replace(**changes, **dict(given.fixed))
