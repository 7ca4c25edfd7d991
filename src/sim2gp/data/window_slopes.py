"""Windows that a simulator on the host moves, and their derivatives.

What is asked of each window is affine in a vector ``x`` about zero: its parameters, its
start, and what is added to its inputs. All is NumPy: to trace and compile these few
derivatives would take longer than a fit asks for them.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.compilation import compile_async
from sim2gp.data.windows import Pieces, Windows
from sim2gp.inference.linearized import value_and_jacobian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import OnHost, names_on_host, numbers_on_host
from sim2gp.systems.machine import Machine
from sim2gp.systems.plants.external import AbstractSimulator, Arguments
from sim2gp.systems.simulate import blur_of, inputs_by_delay, inputs_of
from sim2gp.types import AnyArray


class SlopeInputs(NamedTuple):
    """Windows at ``x = 0``, and how they move with it.

    Virtual parameters ``tt`` (of all windows, or of each) and start states, with their
    slopes, and the slopes of what every input has added.
    """

    tt: Float[np.ndarray, "*W p"]
    start: Float[np.ndarray, "W n"]
    tt_by: Float[np.ndarray, "p k"]
    start_by: Float[np.ndarray, "*W n k"]
    added_by: Float[np.ndarray, "m k"] | None = None

    @classmethod
    def at(
        cls, tt: Float[np.ndarray, "*W p"], start: Float[np.ndarray, "W n"]
    ) -> "SlopeInputs":
        """Windows that do not move."""
        none = np.zeros((tt.shape[-1], 0)), np.zeros((start.shape[1], 0))
        return cls(tt, start, *none)


def about(
    tt: Float[AnyArray, " p"],
    start: Float[AnyArray, "W n"],
    scale: Float[AnyArray, "p p"],
    start_sd: Float[AnyArray, "*W n"],
) -> SlopeInputs:
    """Windows at ``start + start_sd x[:n]`` and ``tt + scale x[n:]``."""
    tt, start, scale, sd = map(np.asarray, (tt, start, scale, start_sd))
    n, p = start.shape[1], tt.size
    tt_by = np.concatenate([np.zeros((p, n)), scale], axis=1)
    return SlopeInputs(tt, start, tt_by, sd[..., None] * np.eye(n, n + p))


class HostRun:
    """All windows simulated on the host, and their derivatives when they are asked for.

    ``states`` are those of the system, ``inputs`` what reaches it. Make it in float64.
    """

    states: Float[np.ndarray, "W L n"]
    inputs: Float[np.ndarray, "W L m"]

    def __init__(
        self,
        simulator: AbstractSimulator,
        system: AbstractSystem,
        windows: Pieces,
        asked: SlopeInputs,
    ) -> None:
        names = names_on_host(simulator, system)
        given, by = _given_by(names, system, windows, asked)
        self.inputs, by_delay = _delayed_inputs(system, windows, given.delays)
        inputs, of_inputs = self.inputs, by_delay[..., None] * by.delays[:, None]
        if asked.added_by is not None:
            of_inputs += asked.added_by
        if isinstance(system, Machine) and names.altering:
            found = map(np.asarray, _altered(system, given.altering, inputs))
            inputs, by_input, by_altering = found
            of_inputs = by_input[..., None] * of_inputs
            of_inputs += by_altering @ by.altering[:, None]
        span = np.asarray(windows.span)
        at = Arguments(given.theta, asked.start + given.offset, inputs, span)
        start_by = asked.start_by + by.offset
        self._along = Arguments(by.theta, start_by, of_inputs, span)
        self._offset_by = by.offset[:, None]
        self._simulator, self._run = simulator, simulator.rolled(at)
        self.states = self._run.at_rows - given.offset[:, None]

    def slopes(self) -> Float[np.ndarray, "W L n k"]:
        """Derivatives of the states in ``x``."""
        found = self._simulator.linearised(self._run, self._along)
        found -= self._offset_by
        return found


def _given_by(
    names: OnHost, system: AbstractSystem, windows: Pieces, asked: SlopeInputs
) -> tuple[OnHost, OnHost]:
    """The parameters of each window that have these names, and their slopes."""
    which = np.zeros(len(asked.start), int)
    if isinstance(windows, Windows):
        which = np.asarray(windows.configuration)
    tt, of_each = asked.tt, np.arange(len(which))
    if tt.ndim == 1:
        which, of_each = np.unique(which, return_inverse=True)
        tt = np.tile(tt, (which.size, 1))
    machines = zip(tt, which.tolist(), strict=True)
    numbers = [numbers_on_host(names, system, *machine) for machine in machines]
    given, by_tt = (
        OnHost(*(np.stack(kind)[of_each] for kind in zip(*rows, strict=True)))
        for rows in zip(*numbers, strict=True)
    )
    return given, OnHost(*(J @ asked.tt_by for J in by_tt))


def _delayed_inputs(
    system: AbstractSystem, windows: Pieces, late: Float[np.ndarray, "W m"]
) -> tuple[Float[np.ndarray, "W L m"], Float[np.ndarray, "W L m"]]:
    """The inputs that arrive, and their derivatives in their delays."""
    if not late.size:  # a machine without inputs
        none = np.zeros((*windows.span.shape, 0))
        return none, none
    blur = blur_of(system)
    pairs = list(zip(windows.held(), late, strict=True))
    u = np.stack([inputs_of(*pair, blur) for pair in pairs])
    if not blur:
        return u, np.zeros_like(u)
    return u, np.stack([inputs_by_delay(*pair, blur) for pair in pairs])


@compile_async
def _altered(
    machine: Machine,
    constants: Float[AnyArray, "W r"],
    inputs: Float[AnyArray, "W L m"],
) -> tuple[Array, Array, Array]:
    """The inputs that arrive, and their slopes in each input and in the parameters."""

    def one(c: Array, a: Array) -> tuple[Array, Array, Array]:
        # An input alters no other: all may be moved at once, by x[-1].
        here = jnp.append(c, 0.0)
        value, J = value_and_jacobian(
            lambda x: machine.altered(x[:-1], a + x[-1]), here
        )
        return value, J[:, -1], J[:, :-1]

    return jax.vmap(jax.vmap(one, (None, 0)))(constants, inputs)
