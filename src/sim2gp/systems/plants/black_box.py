"""Your own simulator as a system: any Python function that steps it.

    s' = step(params, s, a, h)       h seconds later, the input held

It is called on the host and differentiated by central differences. So it must be the
same function every time: no noise, no memory. NaN says that it cannot follow; an
exception is reported as an error.
"""

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.base import LONGEST_MEAN, AbstractPlant, Channel, table_of
from sim2gp.systems.function_checks import named_once, names_of
from sim2gp.systems.plants.external import (
    AbstractSimulator,
    Differences,
    flow,
    untouched,
)
from sim2gp.types import Action, Scalar, State

Step = Callable[[dict[str, Any], np.ndarray, np.ndarray, Any], Any]
#: Steps of differences where numbers come back in single precision: rounding is large.
COARSE = 0.1, 3e-3  # of parameters, of states and inputs


class Called(AbstractSimulator):
    """A step function, called for one row or for all of them."""

    def __init__(self, step: Step, table: Parameters, batched: bool) -> None:
        self.step, self.batched = step, batched
        self.names = names_of(table)
        self.differences = Differences.of(table, self.names)
        self._lock = threading.Lock()  # JAX may call from several programs at once

    def flow(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        out, good = untouched(theta, s, a, h)
        rows = np.flatnonzero(good & (h > 0.0))
        with self._lock:
            if self.batched and rows.size:
                # Copies: the function may write into them.
                out[rows] = self.asked(theta[rows], s[rows], a[rows], h[rows])
            elif not self.batched:
                for i in rows:
                    x = theta[i].copy(), s[i].copy(), a[i].copy(), float(h[i])
                    out[i] = self.asked(*x)
        return out

    def asked(
        self, theta: np.ndarray, s: np.ndarray, a: np.ndarray, h: Any
    ) -> np.ndarray:
        """What the function says, as numbers of the state's shape.

        Raises `InputError` E173 with what the function raised, E140 for another shape,
        E123 for what are no real numbers.
        """
        shape = s.shape
        try:
            said = self.step(dict(zip(self.names, theta.T, strict=True)), s, a, h)
            found = np.asarray(said)
        except Exception as error:
            fix = "return NaN for states that the simulator cannot follow"
            name = checks.name_of(self.step)
            raise checks.raised("the step function", name, error, fix) from error
        name = checks.name_of(self.step)
        if found.dtype.kind not in "fiu":
            got = f"{type(said).__name__} of {found.dtype}"
            raise checks.no_real_numbers("a step", name, got)
        if found.shape != shape:
            meaning = "the state's"
            raise checks.another_shape("a step", name, found.shape, shape, meaning)
        return found


class BlackBox(AbstractPlant):
    """A simulator that is a function ``step(params, s, a, h)`` of NumPy arrays.

    ``params`` are the parameters by name, ``s`` the states, ``a`` the inputs, and ``h``
    a time in seconds; what comes back are the states after it. A ``batched`` function
    gets rows of each (of parameters and times, arrays) and returns rows: that is much
    faster. ``max_substep`` (s) divides longer steps, for a function that takes one step
    of an integrator at each call. What computes in single precision is differenced
    coarsely; its slopes are good to a thousandth.

    Raises `InputError` E145 for names that are there twice, E148 for a substep that is
    not positive, and, from two calls at rest with nominal parameters, E140, E123 and
    E173, the last one too where the two differ.
    """

    engine: Called = eqx.field(static=True)
    parameters: Parameters = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    inputs: tuple[Channel, ...] = eqx.field(static=True)
    longest: float = eqx.field(static=True)

    def __init__(
        self,
        step: Step,
        parameters: Sequence[Parameter] | Parameters,
        states: Sequence[Channel],
        actions: Sequence[Channel],
        *,
        batched: bool = False,
        max_substep: float = math.inf,
    ) -> None:
        self.parameters = table = table_of(parameters)
        self.channels, self.inputs = tuple(states), tuple(actions)
        self.longest = max_substep
        named_once(table, self.channels, self.inputs)
        checks.positive_or_infinite("BlackBox", max_substep=max_substep)
        self.engine = Called(step, table, batched)
        if self._first().dtype in (np.float16, np.float32):
            self.engine.differences = replace(
                self.engine.differences, constants=COARSE[0], states=COARSE[1]
            )

    def _first(self) -> np.ndarray:
        """The answer at rest, asked for twice."""
        values = self.parameters.nominal()
        theta = np.asarray([values[name] for name in self.engine.names], float)
        s, a = np.zeros(len(self.channels)), np.zeros(len(self.inputs))
        x = theta, s, a, np.asarray(min(self.longest, LONGEST_MEAN))
        if self.engine.batched:
            x = theta[None], s[None], a[None], x[3][None]
        one, two = (self.engine.asked(*(y.copy() for y in x)) for _ in range(2))
        if not np.array_equal(one, two, equal_nan=True):
            where = checks.name_of(self.engine.step)
            got = f"{one.tolist()}, then {two.tolist()}"
            raise error("simulator_answers_differently", where=where, got=got)
        return one

    def check_functions(self) -> None:
        """The function has been called, which says more than a trace."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.channels

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.inputs

    @property
    def max_substep(self) -> float:
        return self.longest

    @property
    def window_substep(self) -> float:
        return min(self.longest, LONGEST_MEAN)  # of delayed inputs, averaged by row

    def record(self, values: Mapping[str, Scalar]) -> Float[Array, " p"]:
        """Values in the order that the function expects."""
        return jnp.stack([jnp.asarray(values[name]) for name in self.engine.names])

    def flow(
        self, params: Float[Array, " p"], s: State, a: Action, h: float | Scalar
    ) -> State:
        theta = params.astype(s.dtype)
        span = jnp.asarray(h, s.dtype)
        return flow(self.engine, theta, s, a.astype(s.dtype), span)
