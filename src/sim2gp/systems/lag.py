"""An input that arrives through a first-order low pass, ``T du_f/dt = u - u_f``.

Held inputs ``a_k`` make the filtered input a sum of responses to steps, so its integral
over any interval is in closed form: with ``G(z) = z - T (1 - exp(-z / T))`` for
positive times ``z`` and 0 before,

    U_f(t) = sum_k a_k [G(t - t_k) - G(t - t_k - dt)],

where input ``k`` is held from ``t_k`` on for one period. The state carries the past
actions that still matter; the oldest one counts as held for ever before.
"""

import math
from collections.abc import Mapping
from typing import Any, NoReturn

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.actuators import AbstractInputPath
from sim2gp.systems.base import AbstractSystem, index_of
from sim2gp.types import Action, Scalar, State

FADED = 5.0  # time constants after which a past input counts for less than 1 %


class LaggedParams(eqx.Module):
    """Constants of the machine, and the time constant of its input, s."""

    system: Any
    lag: Scalar


class Lagged(AbstractInputPath):
    """A system one of whose inputs passes a low pass, for one-step prediction.

    ``lag`` is the time constant: a number of seconds, or a `Parameter`, of the constant
    ``<where>.lag``. Past actions of ``period`` seconds are carried in the state for
    five times the longest lag. Raises `InputError` E103 for an unknown input, E141 for
    a lag that can be zero or unbounded, E145 for a machine with delays of its own, E148
    for a period that is not positive.
    """

    system: AbstractSystem
    where: str = eqx.field(static=True)
    parameters: Parameters = eqx.field(static=True)
    past: int = eqx.field(static=True)

    def __init__(
        self,
        system: AbstractSystem,
        where: str,
        lag: Parameter | float,
        *,
        period: float = 0.02,
    ) -> None:
        index_of(where, system.actions)
        checks.positive("Lagged", period=period)
        if system.history or system.longest_delay:
            raise InputError("E145", "lag of an input that is delayed", where=where)
        free = isinstance(lag, Parameter)
        low, high = (lag.low, lag.high) if isinstance(lag, Parameter) else (lag, lag)
        if not (low > 0.0 and math.isfinite(high)):
            raise InputError(
                "E141",
                f"{where}.lag",
                got=f"from {low:g} to {high:g} s",
                expected="a positive, bounded time constant",
                fix="give it a box [low, high] with low > 0",
            )
        table = system.parameters.merge(Parameters((), ((f"{where}.lag", high),)))
        self.system = system
        self.where = where
        self.parameters = table.replace(**{f"{where}.lag": lag}) if free else table
        self.past = math.ceil(FADED * high / period - 1e-9)

    @property
    def longest_delay(self) -> float:
        return 0.0

    def record(self, values: Mapping[str, Scalar]) -> LaggedParams:
        return LaggedParams(self.system.record(values), values[f"{self.where}.lag"])

    def flow(
        self, params: LaggedParams, s: State, a: Action, h: float | Scalar
    ) -> State:
        """The machine's own; ``a`` is the filtered input."""
        return self.system.flow(params.system, s, a, h)

    def delays(self, params: LaggedParams) -> NoReturn:
        """A lag is no delay: whoever shifts inputs himself must not meet one (E145)."""
        raise InputError(
            "E145",
            f"{self.where}.lag over windows of logs",
            expected="one-step data; a delay over windows",
            fix=f"use a delay of {self.where}",
        )

    def mean_inputs(
        self, params: LaggedParams, held: Float[Array, "past m"], dt: float, count: int
    ) -> Float[Array, "count m"]:
        i = index_of(self.where, self.actions)
        plain = jnp.broadcast_to(held[:1], (count, held.shape[1]))
        return plain.at[:, i].set(lagged_means(held[:, i], dt, params.lag, count))


def lagged_means(
    held: Float[Array, " past"], dt: float, lag: Scalar, count: int
) -> Float[Array, " count"]:
    """Mean of the filtered input over each of ``count`` substeps of one period.

    ``held`` are the held inputs, newest first; ``lag`` is the time constant in s.
    """
    h = dt / count
    t = jnp.arange(count + 1, dtype=held.dtype) * h
    since = t[:, None] + jnp.arange(len(held), dtype=held.dtype)[None] * dt

    def filtered(z: Array) -> Array:  # integral of the response to a unit step
        z = jnp.maximum(z, 0.0)
        return z + lag * jnp.expm1(-z / lag)

    on, off = filtered(since), filtered(since - dt)
    # The oldest input has no beginning: it is all that is left of a constant.
    ever = jnp.zeros_like(on).at[:, -1].set(t - on[:, -1])
    return jnp.diff((on - off + ever) @ held) / h
