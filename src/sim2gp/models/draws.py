"""Draws of a linearised simulator, as simulators (paper, eq. 2).

A draw of ``tt`` is a whole function; evaluating it costs one ``jvp``. Linearised draws
stay right on ridges: along a flat direction the tangent moves ``tt`` and not ``f``,
while the nonlinear function at the same ``tt`` leaves the ridge's curve.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import Action, Key, State


class LinearizedDraw(eqx.Module):
    """``f(x, tt*) + J(x) delta``: one draw of the Gaussian process, as a simulator."""

    system: AbstractSystem
    tt: Float[Array, " p"]
    delta: Float[Array, " p"]
    dt: float = eqx.field(static=True)

    def __call__(self, s: State, a: Action) -> State:
        def f(tt: Array) -> Array:
            return self.system.transition(tt, s, a, self.dt)

        mean, slope = jax.jvp(f, (self.tt,), (self.delta,))
        return mean + slope


class NonlinearDraw(eqx.Module):
    """``f(x, tt)`` at a drawn ``tt``: for identifiable models, where physics must hold.

    On ridges it under-fits (the Gaussian is tangent to a curved ridge).
    """

    system: AbstractSystem
    tt: Float[Array, " p"]
    dt: float = eqx.field(static=True)

    def __call__(self, s: State, a: Action) -> State:
        return self.system.transition(self.tt, s, a, self.dt)


def draw(
    system: AbstractSystem, posterior: Gaussian, dt: float, key: Key, *, linear: bool
) -> LinearizedDraw | NonlinearDraw:
    """One float32 function from the parameter posterior."""
    tt = posterior.sample(key)
    if not linear:
        return NonlinearDraw(system, tt.astype(jnp.float32), dt)
    delta = (tt - posterior.mean).astype(jnp.float32)
    return LinearizedDraw(system, posterior.mean.astype(jnp.float32), delta, dt)
