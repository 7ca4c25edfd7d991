"""What every machine has in common: channels, parameters, an ODE, and one step.

A system is physics only: no reward, no noise, no reset, no clipping. It is written for
one point; batches are made at the edge by ``vmap``. The step over one period ``dt`` is

    s' = RK4 over ceil(dt / max_substep) equal substeps of  ds/dt = ode(s, u),

with the action held (zero-order hold). What delays and lags do to the inputs is in
`sim2gp.systems.actuators`.
"""

import abc
import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.errors import error, nearest
from sim2gp.inference.linalg import library
from sim2gp.inference.parameters import (
    Parameter,
    Parameters,
    parameters_of,
    unknown_parameter,
)
from sim2gp.systems.function_checks import check_returns, names_of
from sim2gp.systems.variants import Variant, Which, values_of
from sim2gp.types import Action, AnyArray, AnyScalar, Scalar, State

#: Of RK4 inside the windows that logs are cut into, s.
WINDOW_SUBSTEP = 2e-3
#: An input that moves within a period is averaged over no more than this, s.
LONGEST_MEAN = 0.01
#: Width over which an input that may be delayed is averaged, s.
DELAY_BLUR = 4e-3
#: The same in steps of a simulator that has its own, which 4 ms would make another.
BLURRED = 0.1
#: A step may exceed its limit by this share: clocks are not exact.
STEP_TOLERANCE = 0.05
R = TypeVar("R")


def steps_in(
    span: Float[AnyArray, "*r"] | AnyScalar, longest: float
) -> Int[AnyArray, "*r"]:
    """Equal steps in a time: the fewest that are no longer than ``longest``, in s."""
    xp = library(span)
    count = xp.maximum(1, xp.ceil(span / longest - STEP_TOLERANCE))
    return xp.asarray(count).astype(int)


@dataclass(frozen=True)
class Channel:
    """One state or input: its name, unit, whether it is an angle, and its limits.

    The limits are the machine's, in the channel's unit; a system never enforces them.
    Raises `InputError` E141 for limits that are reversed or NaN.
    """

    name: str
    unit: str
    angle: bool = False
    low: float = -math.inf
    high: float = math.inf

    def __post_init__(self) -> None:
        where = f"limits of {self.name}"
        checks.bounds(where, self.low, self.high, unbounded=True, empty=True)

    @property
    def turns(self) -> bool:
        """Whether it is an angle that may go round."""
        return self.angle and not math.isfinite(self.low + self.high)


class AbstractSystem(eqx.Module):
    """A machine: how it flows under a constant input, and its one-step map ``step``.

    ``states`` name what `step` carries: the physical states that `flow` takes on, then,
    newest first, ``history`` past actions (none but for delayed inputs).
    All fields are static: a system is not data, its ``params`` are.

    Constructing one traces what its author wrote, once: E140, E123 or E173 for a
    function of another shape, of no real numbers, or that raises.
    """

    parameters: AbstractVar[Parameters]

    def __check_init__(self) -> None:
        self.check_functions()

    @property
    @abc.abstractmethod
    def variants(self) -> tuple[Variant, ...]:
        """What differs between several machines of one fit; empty for one machine."""

    @property
    @abc.abstractmethod
    def states(self) -> tuple[Channel, ...]:
        """Channels of the state that `step` carries."""

    @property
    @abc.abstractmethod
    def actions(self) -> tuple[Channel, ...]:
        """Channels of the input."""

    @property
    @abc.abstractmethod
    def max_substep(self) -> float:
        """Longest time that one `flow` inside `step` may last, in seconds."""

    @property
    @abc.abstractmethod
    def window_substep(self) -> float:
        """Longest time that one `flow` may last between two rows of a log, in s."""

    @property
    @abc.abstractmethod
    def own_step(self) -> float | None:
        """The step in s that a simulator has of its own; None for an equation."""

    @property
    def delay_blur(self) -> float:
        """The width in s over which an input that may be delayed is averaged."""
        step = self.own_step
        return DELAY_BLUR if step is None else min(DELAY_BLUR, BLURRED * step)

    @property
    @abc.abstractmethod
    def history(self) -> int:
        """Number of past actions carried in the state."""

    @property
    @abc.abstractmethod
    def longest_delay(self) -> float:
        """Largest delay that any input can have, in seconds."""

    @abc.abstractmethod
    def record(self, values: Mapping[str, Scalar]) -> Any:
        """This system's parameters, picked by name out of ``values``."""

    @abc.abstractmethod
    def flow(self, params: Any, s: State, a: Action, h: float | Scalar) -> State:
        """Physical state ``h`` seconds later under a constant input, in one substep."""

    @abc.abstractmethod
    def delays(self, params: Any) -> Float[Array, " m"]:
        """Delay of each input in seconds."""

    @abc.abstractmethod
    def mean_inputs(
        self, params: Any, held: Float[Array, "past m"], dt: float, count: int
    ) -> Float[Array, "count m"]:
        """Mean of what arrives over each of ``count`` substeps of one period ``dt``.

        ``held`` are the held inputs, newest first; the last was held for ever before.
        """

    @property
    def physical_states(self) -> tuple[Channel, ...]:
        """The states that `flow` takes on, without the carried past actions."""
        return self.states[: len(self.states) - self.history * len(self.actions)]

    def check_functions(self) -> None:
        """That `flow` moves a state (E140, E123, E173).

        A system whose author wrote something else than `flow` checks that instead.
        """
        name = f"{type(self).__name__}.flow"
        check_returns(self, "a next state", self.flow, 0.01, name=name)

    def nominal(self) -> Any:
        """The record of published values; a prior median where there is none."""
        values = self.parameters.nominal()
        return self.record({name: jnp.asarray(v, float) for name, v in values.items()})

    def step(self, params: Any, s: State, a: Action, dt: float) -> State:
        """State ``dt`` seconds later, with the input held.

        Raises `InputError` E113 where the carried history is shorter than the delay.
        """
        count = max(1, math.ceil(dt / self.max_substep - 1e-9))
        h = dt / count

        def substep(x: State, u: Action) -> State:
            return self.flow(params, x, u, h)

        if not self.history and not self.longest_delay:
            return _integrate(substep, s, a, count)
        m = len(self.actions)
        if self.history * dt < self.longest_delay - 1e-9:
            got = f"{self.history} past actions of {dt:g} s"
            longest = f"{self.longest_delay:g}"
            raise error("delay_longer_than_history", got=got, longest=longest)
        n = s.size - self.history * m
        held = jnp.concatenate([a[None], s[n:].reshape(self.history, m)])
        inputs = self.mean_inputs(params, held, dt, count)
        x = _integrate(substep, s[:n], inputs, count)
        return jnp.concatenate([x, held[:-1].reshape(-1)])

    def bind(self, params: Any, dt: float) -> "Bound":
        """The step as a `Dynamics`, a pytree: ``(s, a) -> s'``."""
        return Bound(self, params, dt)

    def transition(
        self,
        tt: Float[Array, " p"],
        s: State,
        a: Action,
        dt: float,
        variant: Which = None,
    ) -> State:
        """The step as a function of the virtual parameters, for inference."""
        return self.step(self.record(self.values(tt, variant)), s, a, dt)

    def values(
        self, tt: Float[AnyArray, " p"], variant: Which = None
    ) -> dict[str, AnyScalar]:
        """Every parameter by name, in physical units, of one variant.

        ``variant`` is an index; only a machine that has several needs it (E152).
        """
        return values_of(self.parameters.values(tt), self.variants, variant)


class Bound(eqx.Module):
    """A system with its parameters: ``s' = f(s, a)``, ready for `jit` and `vmap`."""

    system: AbstractSystem
    params: Any
    dt: float = eqx.field(static=True)

    def __check_init__(self) -> None:
        checks.positive("a step of a system", dt=self.dt)

    def __call__(self, s: State, a: Action) -> State:
        return self.system.step(self.params, s, a, self.dt)


class AbstractPlant(AbstractSystem):
    """Physics that remembers nothing: its inputs act at once."""

    @property
    def variants(self) -> tuple[Variant, ...]:
        return ()

    @property
    def own_step(self) -> float | None:
        return None

    @property
    def history(self) -> int:
        return 0

    @property
    def longest_delay(self) -> float:
        return 0.0

    def delays(self, params: Any) -> Float[Array, " m"]:
        """No input is delayed."""
        return jnp.zeros(len(self.actions), jax.tree.leaves(params)[0].dtype)

    def mean_inputs(
        self, params: Any, held: Float[Array, "past m"], dt: float, count: int
    ) -> Float[Array, "count m"]:
        """The newest input."""
        return jnp.broadcast_to(held[:1], (count, held.shape[1]))


class AbstractODE(AbstractPlant):
    """A plant as a differential equation, integrated by RK4."""

    @property
    def window_substep(self) -> float:
        return WINDOW_SUBSTEP

    @abc.abstractmethod
    def ode(self, params: Any, s: State, a: Action) -> State:
        """Time derivative of the physical state under a constant input, per second."""

    def check_functions(self) -> None:
        """That `ode` has a derivative of each state: RK4 would broadcast a number."""
        name = f"{type(self).__name__}.ode"
        check_returns(self, "a derivative", self.ode, name=name)

    def flow(self, params: Any, s: State, a: Action, h: float | Scalar) -> State:
        return rk4(lambda x, u: self.ode(params, x, u), s, a, h)


def rk4(
    f: Callable[[State, Action], State], s: State, u: Action, h: float | Scalar
) -> State:
    """One classical Runge-Kutta step of length ``h`` seconds under a constant input.

    The barriers end XLA's fusion at each stage. Without them the compiler evaluates a
    stage again for each of its uses, and the derivative of a step costs a hundred times
    the step (measured on 2 cores: a Jacobian in 8 parameters at 2,000 states takes
    430 ms without and 7 to 14 ms with them).
    """
    # Traced once for all stages. Programs of planning are compiled as without it: there
    # a call costs a tenth of the time that they run.
    f = jax.jit(f, inline=s.dtype == jnp.float32)
    k1 = jax.lax.optimization_barrier(f(s, u))
    k2 = jax.lax.optimization_barrier(f(s + 0.5 * h * k1, u))
    k3 = jax.lax.optimization_barrier(f(s + 0.5 * h * k2, u))
    k4 = jax.lax.optimization_barrier(f(s + h * k3, u))
    return s + (h / 6.0) * (k1 + 2.0 * (k2 + k3) + k4)


def record_from(record: type[R], values: Mapping[str, Scalar]) -> R:
    """A record filled by name out of ``values``."""
    names = [field.name for field in dataclasses.fields(record)]  # type: ignore[arg-type]
    return record(**{name: values[name] for name in names})


def table_for(record: type, parameters: Parameters | None) -> Parameters:
    """The record's own table, or the one given, whose names must be the same (E145)."""
    own = parameters_of(record)
    if parameters is None:
        return own
    given = set(names_of(parameters))
    for name in sorted(given - set(own.names)):
        raise unknown_parameter(name, own.names)
    for name in own.names:
        if name not in given:
            raise error("missing_parameter", where=record.__name__, expected=name)
    return parameters


def table_of(parameters: Parameters | Sequence[Parameter]) -> Parameters:
    """Parameters as a table, all of them free."""
    if isinstance(parameters, Parameters):
        return parameters
    return Parameters(tuple(parameters))


def index_of(name: str, channels: Sequence[Channel], *, where: str = "") -> int:
    """Position of a channel by name; `InputError` E103 names the nearest one."""
    names = [channel.name for channel in channels]
    if name not in names:
        close = nearest(name, names)
        fix = f"did you mean {close}?" if close else ""
        known = ", ".join(names)
        raise error("no_such_channel", where=where, got=name, fix=fix, known=known)
    return names.index(name)


def _integrate(
    substep: Callable[[State, Action], State],
    x: State,
    inputs: Float[Array, "*count m"],
    count: int,
) -> State:
    """All substeps of one period; ``inputs`` is one input, or one for each substep."""
    each = inputs.ndim == 2

    def body(x: State, u: Action | None) -> tuple[State, None]:
        return substep(x, inputs if u is None else u), None

    return jax.lax.scan(body, x, inputs if each else None, length=count)[0]
