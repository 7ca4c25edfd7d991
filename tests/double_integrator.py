"""A double integrator at 10 Hz with a quadratic cost: the planners' closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from sim2gp.planning import MarkovObjective, World
from sim2gp.types import Box

A = np.array([[1.0, 0.1], [0.0, 1.0]])
B = np.array([[0.005], [0.1]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.1]])


class Linear(eqx.Module):
    """``s' = A s + B a``, a double integrator at 10 Hz."""

    A: Array
    B: Array

    def __call__(self, s: Array, a: Array) -> Array:
        return self.A @ s + self.B @ a


class Quadratic(eqx.Module):
    def __call__(self, s: Array, a: Array, s2: Array) -> Array:
        del s
        q, r = jnp.asarray(np.diag(Q), s2.dtype), jnp.asarray(np.diag(R), s2.dtype)
        return -(q @ s2**2) - r @ a**2


def box(low: float = -3.0, high: float = 3.0) -> Box:
    return Box(jnp.asarray([low], jnp.float32), jnp.asarray([high], jnp.float32))


def at_rest(key: Array) -> Array:  # one function, or every world would retrace
    return jnp.zeros(2)


def world(dynamics: object = None, **changes: object) -> World:
    if dynamics is None:
        dynamics = Linear(jnp.asarray(A, jnp.float32), jnp.asarray(B, jnp.float32))
    fields = {
        "objective": MarkovObjective(Quadratic()),
        "reset": at_rest,
        "actions": box(),
        "horizon": 60,
        "planning_horizon": 25,
        "planning_iterations": 4,
    }
    return World(dynamics, **{**fields, **changes})


S0 = jnp.asarray([1.0, 0.0])
KEY = jax.random.key(0)
act = eqx.filter_jit(lambda planner, *args, key: planner.act(*args, key=key))
