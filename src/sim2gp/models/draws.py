"""Functions that a simulator's belief gives: linearised draws, and physics at the MAP.

A draw of ``tt`` is a whole function; evaluating it costs one ``jvp``. Linearised draws
stay right on ridges: along a flat direction the tangent moves ``tt`` and not ``f``,
while the nonlinear function at the same ``tt`` leaves the ridge's curve. All are in
float32, for planning.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.systems.base import AbstractSystem, Bound
from sim2gp.types import Action, State, single


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


def linearized(
    system: AbstractSystem, tt: Float[Array, " p"], delta: Float[Array, " p"], dt: float
) -> LinearizedDraw:
    """The draw ``tt + delta``, linearised at ``tt``."""
    return LinearizedDraw(system, tt.astype(jnp.float32), delta.astype(jnp.float32), dt)


def physics_at(system: AbstractSystem, tt: Float[Array, " p"], dt: float) -> Bound:
    """The plain simulator at the virtual parameters ``tt``."""
    record = system.record(system.values(tt))
    return system.bind(single(record), dt)
