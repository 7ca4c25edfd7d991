"""A parametric function, linearised at its MAP, is a Gaussian process (paper, eq. 1-2).

    f(x, tt) ~ f(x, tt*) + J(x) (tt - tt*),        tt ~ N(tt*, S S^T)

Here ``J`` is ``(d, p)`` with the bijections inside (the paper's eq. 1 prints ``J^T``).
A draw of ``tt`` is a whole function; evaluating it costs one ``jvp``. Linearised draws
stay right on ridges: along a flat direction the tangent moves ``tt`` and not ``f``,
while the nonlinear function at the same ``tt`` leaves the ridge's curve.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim2gp.inference.gaussian import Gaussian

BLOCK = 250  # rows: an episode


def value_and_jacobian(
    f: Callable[[Array], Any], tt: Float[Array, " p"]
) -> tuple[Any, Any]:
    """``f(tt)`` and its Jacobian, by forward mode (p is small, rollouts are long).

    Where ``f`` returns several arrays (*d), the Jacobian has as many, (*d, p).
    """

    def twice(tt: Array) -> tuple[Any, Any]:
        value = f(tt)
        return value, value

    J, value = jax.jacfwd(twice, has_aux=True)(tt)
    return value, J


def latent(f: Callable[[Array], Array], posterior: Gaussian) -> Gaussian:
    """Push a parameter posterior through the linearised function (eq. 2, no noise)."""
    value, J = value_and_jacobian(f, posterior.mean)
    return Gaussian(value, J @ posterior.scale)


def in_blocks(
    f: Callable[..., Any],
    rows: tuple[Any, ...],
    mask: Bool[Array, " N"],
    size: int = BLOCK,
) -> Any:
    """``f(*rows)``, of so many rows at a time; zeros for blocks that are all masked.

    What ``f`` has in between need not be in memory for all, and data that have room for
    all episodes of a run are empty in the beginning.
    """
    N = len(mask)
    if size >= N:
        return f(*rows)
    count = -(-N // size)

    def cut(x: Array) -> Array:
        rest = jnp.zeros((count * size - N, *x.shape[1:]), x.dtype)
        return jnp.concatenate([x, rest]).reshape(count, size, *x.shape[1:])

    def nothing(some: tuple[Any, ...]) -> Any:
        shapes = jax.eval_shape(f, *some)
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

    def turn(given: tuple[Any, Array]) -> Any:
        some, valid = given
        return jax.lax.cond(jnp.any(valid), lambda x: f(*x), nothing, some)

    found = jax.lax.map(turn, (jax.tree.map(cut, rows), cut(mask)))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:N], found)
