"""A stretch of recorded input, and the machine simulated under it.

A machine's inputs are held between samples and reach it late: what an integration step
sees is the mean of the delayed input over it, exactly.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.linalg import each_window, library
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import AnyArray, AnyScalar


class HeldInputs(eqx.Module):
    """The steps of a simulation, and the inputs that reach it.

    ``span`` is the time since the previous row, s. ``knots`` and ``area`` are the times
    and values at which the integral of the held input bends; between them it is
    straight, so its mean over any delayed interval is exact.
    """

    span: Float[AnyArray, " L"]
    knots: Float[AnyArray, " H"]
    area: Float[AnyArray, "H m"]


def inputs_of(
    window: HeldInputs, delays: Float[AnyArray, " m"], blur: float = 0.0
) -> Float[AnyArray, "L m"]:
    """Mean delayed input over the step that ends at each row of one window.

    Where every step is as long as the input is held, all of these means bend at the
    same delays, and a fit is caught in the kink. ``blur`` (s) averages the held input
    over that width around each time first, which makes them smooth in the delay.
    """
    xp, (ends, h) = library(window.area, delays), _ends(window)

    def channel(area: AnyArray, delay: AnyScalar) -> AnyArray:
        t = ends - delay
        if blur:
            sides = 0.5 * blur * np.asarray([[-1.0], [1.0]], t.dtype)
            early, late = _second_integral(window.knots, area)(t[None] + sides)
            integral = (late - early) / blur
        else:
            integral = xp.interp(t, window.knots, area)
        return xp.diff(integral) / h

    return _of_each_input(channel, window, delays)


def inputs_by_delay(
    window: HeldInputs, delays: Float[np.ndarray, " m"], blur: float
) -> Float[np.ndarray, "L m"]:
    """Derivative of `inputs_of` in each channel's delay, for a ``blur`` above zero."""
    ends, h = _ends(window)

    def channel(area: np.ndarray, delay: AnyScalar) -> np.ndarray:
        sides = ends - delay + 0.5 * blur * np.asarray([[-1.0], [1.0]])
        early, late = np.interp(sides, window.knots, area)
        return -np.diff((late - early) / blur) / h

    return _of_each_input(channel, window, delays)


def _of_each_input(
    channel: Callable[[AnyArray, AnyScalar], AnyArray],
    window: HeldInputs,
    delays: Float[AnyArray, " m"],
) -> Float[AnyArray, "L m"]:
    """A column for each input; a machine may have none."""
    if not delays.size:
        return library(window.area).zeros((window.span.size, 0))
    return each_window(channel, window.area.T, delays).T


def arriving(
    system: AbstractSystem, params: Any, window: HeldInputs
) -> Float[Array, "L m"]:
    """The inputs of each step, delayed as the machine delays them."""
    return inputs_of(window, system.delays(params), blur_of(system))


def blur_of(system: AbstractSystem) -> float:
    """Over how long inputs are averaged, s; zero where none may be delayed."""
    return system.delay_blur if system.longest_delay else 0.0


def _ends(window: HeldInputs) -> tuple[Float[AnyArray, " L1"], Float[AnyArray, " L"]]:
    """Times at which the steps end, after the first begins at zero; their lengths.

    A row without length has no mean; its input does not matter but must be finite.
    """
    xp = library(window.span)
    end = xp.cumsum(window.span)
    h = xp.where(window.span > 0.0, window.span, 1.0)
    return xp.concatenate([xp.zeros(1, end.dtype), end]), h


def _second_integral(
    knots: Float[AnyArray, " H"], area: Float[AnyArray, " H"]
) -> Callable[[AnyArray], AnyArray]:
    """The integral of a piecewise straight function, as a function of its end."""
    xp = library(knots, area)
    length = xp.diff(knots)
    slope = xp.diff(area) / length
    whole = xp.cumsum(length * 0.5 * (area[1:] + area[:-1]))
    whole = xp.concatenate([xp.zeros_like(whole[:1]), whole])

    def at(t: AnyArray) -> AnyArray:
        k = xp.clip(xp.searchsorted(knots, t, side="right") - 1, 0, slope.size - 1)
        x = t - knots[k]
        return whole[k] + x * (area[k] + 0.5 * x * slope[k])

    return at


def simulate(
    system: AbstractSystem,
    params: Any,
    window: HeldInputs,
    x0: Float[Array, " n"],
    added: Float[Array, " m"] | None = None,
) -> Float[Array, "L n"]:
    """States at the rows of one window, from ``x0`` at its first.

    ``added`` is a constant that is added to every input.
    """

    def step(x: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        h, u = row
        x = system.flow(params, x, u, h)
        return x, x

    inputs = arriving(system, params, window)
    if added is not None:
        inputs = inputs + added[None]
    # A gradient's way back takes each step again: a third of the time that it takes to
    # keep and fetch what every step has seen. What runs forward alone is not touched.
    again = jax.checkpoint(step, prevent_cse=False)
    return jax.lax.scan(again, x0, (window.span, inputs))[1]
