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
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import Gaussian


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
