"""Windows of a machine and their derivatives, also where the simulator is not JAX.

What a caller asks of each window is an `AbstractAsked`: constants, inputs and start, as
functions of a vector ``x``. JAX simulates and differentiates that in one program. A
simulator on the host is asked between two programs, once for all windows: the first
finds its arguments and their derivatives, the second what the machine says of its
states. Neither holds a callback, so that JAX keeps both in its cache.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.data.windows import Windows
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.plants.external import AbstractSimulator, Arguments
from sim2gp.systems.simulate import HeldInputs, arriving, simulate


class AbstractAsked(eqx.Module):
    """The simulation of one window, as a function of a vector ``x`` about zero."""

    system: AbstractVar[AbstractSystem]

    @abstractmethod
    def __call__(
        self, window: Windows, e: Float[Array, " n"], x: Float[Array, " k"]
    ) -> tuple[Any, HeldInputs, Float[Array, " n"]]:
        """Constants of the machine, held inputs, and the start."""


def states_and_slopes(
    asked: AbstractAsked, window: Windows, e: Float[Array, " n"], k: int
) -> tuple[Float[Array, "L n"], Float[Array, "L n k"]]:
    """States of one window, and their derivatives in ``x``, by JAX."""

    def states(x: Array) -> Array:
        return simulate(asked.system, *asked(window, e, x))

    return value_and_jacobian(states, jnp.zeros(k))


def slopes_on_host(
    simulator: AbstractSimulator,
    asked: AbstractAsked,
    windows: Windows,
    e: Float[Array, "W n"],
    k: int,
) -> tuple[Float[Array, "W L n"], Float[Array, "W L n k"]]:
    """The same of all windows, by a simulator on the host. Call it in float64."""
    at, along = _arguments(asked, windows, e, k)
    # Of the host's own kind, in its order: it works along the rows.
    at, along = (Arguments(*map(np.asarray, x)) for x in (at, along))
    states, slopes = simulator.linearised_rollout(at, along)
    return _seen(asked, windows, e, jnp.asarray(states), jnp.asarray(slopes))


@eqx.filter_jit
def _arguments(
    asked: AbstractAsked, windows: Windows, e: Array, k: int
) -> tuple[Arguments, Arguments]:
    def one(window: Windows, e: Array) -> tuple[Arguments, Arguments]:
        def arguments(x: Array) -> Arguments:
            params, held, x0 = asked(window, e, x)
            inputs = arriving(asked.system, params, held)
            theta, x0, u = asked.system.enter(params, x0, inputs)
            return Arguments(theta, x0, u, held.span)

        zero = jnp.zeros(k)
        return arguments(zero), jax.jacfwd(arguments)(zero)

    found: tuple[Arguments, Arguments] = windows.each(one, e)
    return found


@eqx.filter_jit
def _seen(
    asked: AbstractAsked,
    windows: Windows,
    e: Array,
    states: Float[Array, "W L n"],
    slopes: Float[Array, "W L n k"],
) -> tuple[Float[Array, "W L n"], Float[Array, "W L n k"]]:
    """What the machine says of the simulator's states."""
    k = slopes.shape[-1]

    def one(window: Windows, e: Array, at: Array, by: Array) -> tuple[Array, Array]:
        def states(x: Array) -> Array:
            params, _, _ = asked(window, e, x)
            return asked.system.leave(params, at + by @ x)

        return value_and_jacobian(states, jnp.zeros(k))

    found: tuple[Array, Array] = windows.each(one, e, states, slopes)
    return found
