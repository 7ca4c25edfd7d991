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
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import Gaussian

TOGETHER = 16  # columns


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


def jacobian_by_columns(
    f: Callable[[Array], tuple[Array, ...]], x: Float[Array, " p"]
) -> tuple[Float[Array, "*d p"], tuple[Array, ...]]:
    """Jacobian of the first output of ``f`` at ``x``, and all of its values there.

    One column after the other: the code of a single one takes a third of the time to
    compile. For what runs at few points. Of many columns `TOGETHER` at once.
    """

    def column(v: Array) -> tuple[Array, tuple[Array, ...]]:
        values, slopes = jax.jvp(f, (x,), (v,))
        return slopes[0], values

    together = TOGETHER if x.size > TOGETHER else 1
    count = -(-x.size // together) * together  # a rest would be another program
    columns = jnp.eye(count, x.size, dtype=x.dtype)
    J, values = jax.lax.map(column, columns, batch_size=together)
    J = J[: x.size]
    return jnp.moveaxis(J, 0, -1), jax.tree.map(lambda a: a[0], values)


def latent(f: Callable[[Array], Array], posterior: Gaussian) -> Gaussian:
    """Push a parameter posterior through the linearised function (eq. 2, no noise)."""
    value, J = value_and_jacobian(f, posterior.mean)
    return Gaussian(value, J @ posterior.scale)
