"""Windows of a machine and their derivatives, also where the simulator is not JAX.

What a caller asks of each window is an `AbstractAsked`: constants, inputs and start, as
functions of a vector ``x``. JAX simulates and differentiates that in one program. A
simulator on the host is asked once for all windows, after a program that finds its
arguments and their derivatives and holds no callback, so that JAX keeps it in its
cache.
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.data.windows import Pieces, Windows
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.plants.external import AbstractSimulator, Arguments
from sim2gp.systems.simulate import (
    HeldInputs,
    blur_of,
    inputs_by_delay,
    inputs_of,
    simulate,
)
from sim2gp.types import AnyArray


class AbstractAsked(eqx.Module):
    """The simulation of one window, as a function of a vector ``x`` about zero."""

    system: AbstractVar[AbstractSystem]

    @abstractmethod
    def __call__(
        self, window: Windows, e: Float[Array, " n"], x: Float[Array, " k"]
    ) -> tuple[Any, HeldInputs, Float[Array, " n"], Float[Array, " m"]]:
        """Constants of the machine, held inputs, start, and what is added to inputs."""


def states_and_slopes(
    asked: AbstractAsked, window: Windows, e: Float[Array, " n"], k: int
) -> tuple[Float[Array, "L n"], Float[Array, "L n k"]]:
    """States of one window, and their derivatives in ``x``, by JAX."""

    def states(x: Array) -> Array:
        return simulate(asked.system, *asked(window, e, x))

    return value_and_jacobian(states, jnp.zeros(k))


class HostRun:
    """All windows simulated on the host, and their derivatives when they are asked for.

    ``states`` are those of the system, ``inputs`` what reaches it. Make it in float64.
    """

    states: Float[np.ndarray, "W L n"]
    inputs: Float[np.ndarray, "W L m"]

    def __init__(
        self,
        simulator: AbstractSimulator,
        asked: AbstractAsked,
        windows: Pieces,
        e: Float[Array, "W n"],
        k: int,
    ) -> None:
        late = _delays(asked, windows, e, k)
        arriving = _inputs(asked.system, windows, np.asarray(late))
        found = _arguments(asked, windows, e, arriving, k)
        # Of the host's own kind, in its order: it works along the rows.
        found = jax.tree.map(np.asarray, found)
        (at, origin), (self._along, self._origin_by) = found
        self._simulator, self._run = simulator, simulator.rolled(at)
        self.states = self._run.at_rows + origin
        self.inputs = arriving[0]

    def slopes(self) -> Float[np.ndarray, "W L n k"]:
        """Derivatives of the states in ``x``."""
        found = self._simulator.linearised(self._run, self._along)
        found += self._origin_by
        return found


@eqx.filter_jit
def _delays(
    asked: AbstractAsked, windows: Pieces, e: Array, k: int
) -> Float[Array, "W m"]:
    """By how much the inputs of each window are late, s."""

    def one(window: Any, e: Array) -> Array:
        return asked.system.delays(asked(window, e, jnp.zeros(k))[0])

    found: Array = windows.each(one, e)
    return found


def _inputs(
    system: AbstractSystem, windows: Pieces, late: Float[np.ndarray, "W m"]
) -> tuple[Float[np.ndarray, "W L m"], Float[np.ndarray, "W L m"]]:
    """The inputs that arrive, and their derivatives in their delays.

    They are found here because JAX would take longer to trace the derivative, along
    each of ``x``, than all of a fit takes to ask for it.
    """
    if not late.size:  # a machine without inputs
        none = np.zeros((*windows.span.shape, 0))
        return none, none
    blur = blur_of(system)
    pairs = list(zip(windows.held(), late, strict=True))
    u = np.stack([inputs_of(*pair, blur) for pair in pairs])
    if not blur:
        return u, np.zeros_like(u)
    return u, np.stack([inputs_by_delay(*pair, blur) for pair in pairs])


@eqx.filter_jit
def _arguments(
    asked: AbstractAsked,
    windows: Pieces,
    e: Array,
    arriving: tuple[AnyArray, AnyArray],
    k: int,
) -> Any:
    """What the plant is given and what its states are offset by; both by ``x``."""

    def one(window: Any, e: Array, u: Array, by_delay: Array) -> Any:
        def arguments(x: Array) -> Any:
            params, held, x0, added = asked(window, e, x)
            # `leave` adds to a state what does not depend on it.
            origin = asked.system.leave(params, jnp.zeros((1, x0.size)))
            late = asked.system.delays(params)
            later = late - jax.lax.stop_gradient(late)  # zero, with a derivative
            inputs = u + by_delay * later[None] + added[None]
            theta, x0, inputs = asked.system.enter(params, x0, inputs)
            return Arguments(theta, x0, inputs, held.span), origin

        return value_and_jacobian(arguments, jnp.zeros(k))

    return windows.each(one, e, *arriving)
