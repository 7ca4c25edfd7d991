"""The shapes everything else is written in: one state, one action, one function.

A dynamics model is a function of one point, ``s' = f(s, a)``; batches and horizons
are made at the edge by ``vmap`` and ``scan``. Inference runs in float64, planning in
float32; `in_float64` is the one door between them.
"""

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from sim2gp import checks
from sim2gp.errors import of_callbacks

State = Float[Array, " n"]
Action = Float[Array, " m"]
Scalar = Float[Array, ""]
Key = PRNGKeyArray

if TYPE_CHECKING:
    #: Data that are numpy's on the host and JAX's inside compiled functions.
    AnyArray = Any
    AnyScalar = Any
else:
    AnyArray = Array | np.ndarray
    AnyScalar = Float[AnyArray, ""] | np.floating | float

#: ``s' = f(s, a)``: one step of the world, for one point; always a pytree.
Dynamics = Callable[[Array, Array], Array]
#: ``r(s, a, s')``: the reward of one step.
Reward = Callable[[Array, Array, Array], Array]

_P = ParamSpec("_P")
_R = TypeVar("_R")
_T = TypeVar("_T")


class Box(eqx.Module):
    """The set of actions ``low <= a <= high``, in the units of the channels.

    Raises `InputError` E141 for bounds that are reversed or not finite.
    """

    low: Float[Array, " m"]
    high: Float[Array, " m"]

    def __check_init__(self) -> None:
        checks.same_shape("Box", np.shape(self.low), high=self.high)
        checks.bounds("Box", self.low, self.high, empty=True)


def check_reward(reward: Reward, s: Any, a: Any) -> None:
    """That a reward of a step between such states is a number (E140, E123, E173)."""
    checks.returns("a reward", reward, (s, a, s), (), meaning="a number")


def in_float64(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Run a host-side function with float64 switched on, and only inside it.

    JAX's switch is global; scoping it keeps the user's own float32 code as it was. What
    a simulator on the host finds wrong comes out as its own `InputError`.
    """

    @wraps(function)
    def scoped(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with jax.enable_x64(True), of_callbacks():
            return function(*args, **kwargs)

    return scoped


def single(tree: _T) -> _T:
    """The same with its numbers in float32, for planning."""
    return jax.tree.map(
        lambda x: jnp.asarray(x, jnp.float32) if eqx.is_inexact_array(x) else x, tree
    )


def double(*arrays: AnyArray) -> tuple[Array, ...]:
    """Float64 versions, within `in_float64`."""
    return tuple(jnp.asarray(x, float) for x in arrays)
