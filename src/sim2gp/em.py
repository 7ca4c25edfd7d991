"""The noise of a fit by expectation-maximisation, and Student-t weights of windows."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.arrowhead import Noise
from sim2gp.laplace import Fit
from sim2gp.types import Scalar


def expectation(
    count: Float[Array, "W c"],
    floor: Float[Array, " c"],
    freedom: float | Scalar = jnp.inf,
) -> Callable[[Fit, Noise], Noise]:
    """EM's update of noise and weights, from squares expected under the posterior.

        sig_c^2 = (2 floor_c^2 + sum_w w_w E||r_wc||^2) / (2 + count_c)
        w_w     = (1 + count_w / freedom) / (1 + ||r_w||^2 / freedom)

    The prior on the noise counts as two samples at the floor. Weights are Student-t's;
    an infinite number of degrees of ``freedom`` makes them 1.
    """

    def update(fit: Fit, noise: Noise) -> Noise:
        squares, spread = fit.squares()
        expected = noise.weights @ (squares + spread)
        sd = jnp.sqrt((2.0 * floor**2 + expected) / (2.0 + jnp.sum(count, axis=0)))
        misfit = jnp.sum(squares / sd[None] ** 2, axis=1)
        weights = (1.0 + jnp.sum(count, axis=1) / freedom) / (1.0 + misfit / freedom)
        return Noise(sd, weights)

    return update
