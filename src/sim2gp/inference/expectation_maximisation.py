"""The noise of a fit by expectation-maximisation, and Student-t weights of windows."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.levenberg_marquardt import Fit
from sim2gp.types import Scalar


def expectation(
    count: Float[Array, "W c"],
    floor: Float[Array, " c"],
    freedom: float | Scalar = jnp.inf,
) -> Callable[[Fit, Noise], Noise]:
    """EM's update of noise and weights, from squares expected under the posterior.

        sig_c^2 = (2 floor_c^2 + sum_w w_w E||r_wc||^2 / mean(w)) / (2 + count_c)
        w_w     = (1 + count_w / freedom) / (1 + ||r_w||^2 / freedom)

    The prior on the noise counts as two samples at the floor. Weights are Student-t's;
    an infinite number of degrees of ``freedom`` makes them 1. Their mean, over windows
    with data, is 1 where the update rests. Without it (EM proper) weights take back
    what the noise gains, and hundreds of rounds are needed where a window has many
    samples: parameter expansion, Liu, Rubin and Wu 1998, Biometrika 85.
    """
    seen = jnp.sum(count, axis=1) > 0

    def update(fit: Fit, noise: Noise) -> Noise:
        squares, spread = fit.squares()
        mean = jnp.mean(noise.weights, where=seen)
        expected = noise.weights @ (squares + spread) / jnp.where(mean > 0, mean, 1.0)
        sd = jnp.sqrt((2.0 * floor**2 + expected) / (2.0 + jnp.sum(count, axis=0)))
        misfit = jnp.sum(squares / sd[None] ** 2, axis=1)
        weights = (1.0 + jnp.sum(count, axis=1) / freedom) / (1.0 + misfit / freedom)
        return Noise(sd, weights)

    return update
