"""Every bundled system, 1,000 states: forward = reverse mode = central differences.

Errors are relative to the largest entry of each output's row, in the natural scales of
the columns (state ranges, input limits, virtual parameters). A delay on the edge of a
substep is a kink, across which differences are no reference: such states are left out.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import machines

STATES = 1000
DT = 0.02


pytestmark = pytest.mark.usefixtures("float64")


@functools.cache
def jacobians(name):
    """(forward, reverse, 5-point differences), each (STATES, outputs, columns)."""
    system = machines.every()[name]
    tt, s, a = machines.batch(system, STATES, 11)
    p, n = tt.shape[1], s.shape[1]
    x = jnp.concatenate([tt, s, a], 1)
    scale = jnp.concatenate(
        [jnp.ones(p), jnp.max(jnp.abs(s), 0), jnp.max(jnp.abs(a), 0)]
    )

    def step(z):
        t = z * scale
        return system.transition(t[:p], t[p : p + n], t[p + n :], DT)

    def differences(z):
        h = 5e-5  # of a range; friction is smoothed over 6e-3 of one

        def along(e):
            f = lambda k: step(z + k * h * e)  # noqa: E731
            return (f(-2) - 8 * f(-1) + 8 * f(1) - f(2)) / (12 * h)

        return jax.lax.map(along, jnp.eye(len(z))).T

    z = x / scale[None]
    smooth = jax.jit(jax.vmap(lambda t: _smooth(system, t)))(tt)
    assert jnp.sum(~smooth) <= 5
    z = z[smooth]
    modes = (jax.jacfwd(step), jax.jacrev(step), differences)
    return tuple(np.asarray(jax.jit(jax.vmap(mode))(z)) for mode in modes)


def _smooth(system, tt):
    delays = system.delays(machines.params_at(system, tt))
    if not any(name.endswith(".delay") for name in system.parameters.names):
        return jnp.array(True)  # no delay, or a fixed one
    h = system.max_substep
    return jnp.all(jnp.abs(delays - h * jnp.round(delays / h)) > 2e-6)


def error(got, expected):
    row = np.max(np.abs(expected), axis=2, keepdims=True)
    return np.max(np.abs(got - expected) / np.where(row > 0.0, row, 1.0))


def cases() -> list[Any]:
    """One machine by day; by night the others, and those with effects or actuators."""
    night, day = pytest.mark.nightly, "cartpole"
    return [n if n == day else pytest.param(n, marks=night) for n in machines.every()]


@pytest.mark.parametrize("name", cases())
def test_jacobians(name):
    forward, reverse, differences = jacobians(name)
    assert np.all(np.isfinite(forward))
    print(f"{name}: {error(reverse, forward):.1e} {error(differences, forward):.1e}")
    assert error(reverse, forward) <= 1e-12
    assert error(differences, forward) <= 1e-6
