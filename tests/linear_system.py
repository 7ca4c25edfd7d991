"""A machine whose step is linear in its constants, with any Jacobian one likes.

    s' = s + A tt,    A (d, p) being the action, flattened

so that the Laplace posterior of its constants is exact Bayesian linear regression.
"""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array

from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems import AbstractODE, Channel


class Linear(AbstractODE):
    """``d`` outputs; as many constants as the table has, of whatever map.

    States grow on their own at a ``rate``, 1/s.
    """

    parameters: Parameters = eqx.field(static=True)
    d: int = eqx.field(static=True)
    rate: float = eqx.field(static=True, default=0.0)

    max_substep: ClassVar[float] = 1.0

    @property
    def states(self) -> tuple[Channel, ...]:
        return tuple(Channel(f"x{i}", "m") for i in range(self.d))

    @property
    def actions(self) -> tuple[Channel, ...]:
        count = self.d * len(self.parameters)
        return tuple(Channel(f"a{i}", "m") for i in range(count))

    def record(self, values: Mapping[str, Array]) -> Array:
        return jnp.stack([values[name] for name in self.parameters.names])

    def ode(self, params: Array, s: Array, a: Array) -> Array:
        return a.reshape(self.d, -1) @ params + self.rate * s


def linear(p: int, d: int, kind: str = "identity", **spec: float) -> Linear:
    free = tuple(
        Parameter(f"k{i}", "1", "slope", kind, mean=0.0, sd=1.0, **spec)
        for i in range(p)
    )
    return Linear(Parameters(free), d)


def transitions(J: np.ndarray, y: np.ndarray) -> Transitions:
    """From rest at zero: the increments are ``y`` to the last bit."""
    return Transitions.of(np.zeros_like(y), J.reshape(len(J), -1), y)


def windows_of(J: np.ndarray, y: np.ndarray, group: np.ndarray) -> Windows:
    """The same as windows of one step of a second, of machines in configurations."""
    N, d = y.shape
    ends = np.broadcast_to(np.asarray([0.0, 1.0])[None], (N, 2))
    return Windows(
        ends,
        ends,
        np.stack([np.zeros((N, J[0].size)), J.reshape(N, -1)], axis=1),
        np.stack([np.zeros_like(y), y], axis=1),
        np.broadcast_to((ends > 0.0)[..., None], (N, 2, d)),
        np.zeros((N, d)),
        np.zeros((N, d)),
        np.full(d, 1e-2),
        group.astype(np.int32),
        tuple(range(d)),
    )
