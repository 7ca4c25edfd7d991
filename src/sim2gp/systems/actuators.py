"""What is between a command and the input that acts: gain, offset, delay and lag.

    u_effective(t) = gain u(t - delay) + offset

Each is one part of a machine, with one parameter, ``<input>.gain``, ``<input>.offset``
(in the input's unit), ``<input>.delay`` and ``<input>.lag`` (in seconds): free with a
prior, or fixed. Inputs that are driven alike may share one parameter. Gain and offset
act inside `flow`. A delay acts on the held input: a substep of length ``h`` sees its
mean, ``(U(t + h - tau) - U(t - tau)) / h`` with ``U`` the integral of the held input;
so the delay ``tau`` has a gradient, which a shift by whole samples has not.

A lag ``T`` is a first-order low pass, ``T du_f/dt = u - u_f``. Held inputs ``a_k`` make
the filtered input a sum of responses to steps, so its integral over any interval is in
closed form: with ``G(z) = z - T (1 - exp(-z / T))`` for positive times ``z`` and 0
before,

    U_f(t) = sum_k a_k [G(t - t_k) - G(t - t_k - dt)],

where input ``k`` is held from ``t_k`` on for one period.
"""

import math
from collections.abc import Mapping, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant, Channel, index_of
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import Scalar

LONGEST_DELAY = 0.02  # s, of a delay that is only called free
SHORTEST_LAG = 2e-3  # s
FADED = 5.0  # time constants after which a past input counts for less than 1 %


class AbstractActuator(AbstractPart):
    """A part on one input; ``tie`` names the input whose parameter it shares."""

    tie: AbstractVar[str]

    @property
    def name(self) -> str:
        return f"{self.tie or self.where}.{self.what}"


class Gain(AbstractActuator):
    """A factor of an input; free, within a factor of two."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True, default=1.0)
    tie: str = eqx.field(static=True, default="")
    what: ClassVar[str] = "gain"
    neutral: ClassVar[float] = 1.0
    meaning: ClassVar[str] = "gain of the input"

    def unit(self, plant: AbstractPlant) -> str:
        index_of(self.where, plant.actions)
        return "1"

    def parameter(self, plant: AbstractPlant) -> Parameter:
        meaning = f"gain of {self.where}"
        return Parameter(self.name, "1", meaning, "log_bounded", 0.5, 2.0)


class Offset(AbstractActuator):
    """What is added to an input; free, within a tenth of the input's range."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True, default=0.0)
    tie: str = eqx.field(static=True, default="")
    what: ClassVar[str] = "offset"
    neutral: ClassVar[float] = 0.0
    meaning: ClassVar[str] = "offset of the input"

    def unit(self, plant: AbstractPlant) -> str:
        return plant.actions[index_of(self.where, plant.actions)].unit

    def parameter(self, plant: AbstractPlant) -> Parameter:
        channel = plant.actions[index_of(self.where, plant.actions)]
        span = channel.high - channel.low
        edge = 0.1 * span if math.isfinite(span) else 1.0
        meaning = f"offset of {self.where}"
        return Parameter(self.name, channel.unit, meaning, "bounded", -edge, edge)


class Delay(AbstractActuator):
    """A delay of ``magnitude`` seconds; free, up to the magnitude.

    Raises `InputError` E148 for a negative one.
    """

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True, default=0.0)
    tie: str = eqx.field(static=True, default="")
    what: ClassVar[str] = "delay"
    neutral: ClassVar[float] = 0.0
    meaning: ClassVar[str] = "delay of the input"

    def __check_init__(self) -> None:
        checks.not_negative("Delay", magnitude=self.magnitude)

    def unit(self, plant: AbstractPlant) -> str:
        index_of(self.where, plant.actions)
        return "s"

    def parameter(self, plant: AbstractPlant) -> Parameter:
        longest = self.magnitude or LONGEST_DELAY
        return Parameter(
            self.name, "s", f"delay of {self.where}", "bounded", 0.0, longest
        )


class Lag(AbstractActuator):
    """A first-order low pass of ``magnitude`` seconds; free, up to the magnitude."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    tie: str = eqx.field(static=True, default="")
    what: ClassVar[str] = "lag"
    meaning: ClassVar[str] = "first-order lag of the input"

    def unit(self, plant: AbstractPlant) -> str:
        index_of(self.where, plant.actions)
        return "s"

    def parameter(self, plant: AbstractPlant) -> Parameter:
        box = SHORTEST_LAG, self.magnitude
        return Parameter(self.name, "s", self.meaning, "log_bounded", *box)

    def memory(self, longest: float) -> float:
        """For how long past inputs count, s, of a lag of at most ``longest``."""
        return FADED * longest

    def means(
        self, held: Float[Array, " past"], dt: float, lag: Scalar, count: int
    ) -> Float[Array, " count"]:
        """`lagged_means`."""
        return lagged_means(held, dt, lag, count)


def neutral_actuators(
    channels: Sequence[Channel], ties: Mapping[str, str] | None = None
) -> tuple[AbstractActuator, ...]:
    """Gain, offset and delay of each input, as if there were none.

    ``ties`` are inputs that share the parameters of another one, by name.
    """
    tie = dict(ties or {})
    return tuple(
        kind(c.name, tie=tie.get(c.name, ""))
        for c in channels
        for kind in (Gain, Offset, Delay)
    )


def delayed_means(
    held: Float[Array, "past m"], dt: float, delay: Float[Array, " m"], count: int
) -> Float[Array, "count m"]:
    """Mean delayed input over each of ``count`` substeps of one period ``dt``.

    ``held`` are the held inputs, newest first: row ``k`` acts on
    ``[-k dt, (1 - k) dt)``. On a knot the derivative with respect to the delay is the
    one from the right (a longer delay), so that it never vanishes by accident.
    """
    h = dt / count
    t = jnp.arange(count + 1, dtype=held.dtype)[:, None] * h - delay[None]

    def area(k: int) -> Float[Array, "times m"]:
        z = t + k * dt
        return jnp.where(z <= 0.0, 0.0, jnp.where(z > dt, dt, z)) * held[k][None]

    integral = sum(area(k) for k in range(len(held)))
    return jnp.diff(jnp.asarray(integral), axis=0) / h


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
    # The oldest input has no beginning: before it the input was constant.
    ever = jnp.zeros_like(on).at[:, -1].set(t - on[:, -1])
    return jnp.diff((on - off + ever) @ held) / h
