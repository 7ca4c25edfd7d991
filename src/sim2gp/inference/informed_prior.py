"""The prior with what was weighed in it, as a Gaussian.

A weighed sum is a row of the fit (`sim2gp.inference.linear_measurements`), exact in its
bounded constants. A posterior is compared with what was known before the logs; that is
the prior and the sums, linearised where the posterior is:

    [ K  r - K z ]   rows of the sums at z,
    [ I     0    ]   the prior's own.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import gauss_newton_step, posterior, stack
from sim2gp.inference.parameters import Parameters
from sim2gp.types import in_float64


@in_float64
def informed(table: Parameters, prior: Gaussian, tt: Float[Array, " p"]) -> Gaussian:
    """The prior given the table's weighed sums, linearised at the virtual ``tt``."""
    z = jnp.linalg.solve(prior.scale, jnp.asarray(tt, float) - prior.mean)
    rows = table.known(prior, z)
    about = rows.at[:, -1].add(-rows[:, :-1] @ z)
    full = stack(about, jnp.eye(z.size, z.size + 1, dtype=z.dtype))
    return posterior(full, gauss_newton_step(full), prior)


@in_float64
def informed_prior(table: Parameters) -> Gaussian:
    """What is known before any log, linearised at its mode."""
    import scipy.optimize  # a third of a second that a refused project need not wait

    prior = table.prior()
    if not table.weighed:
        return prior
    rows = jax.jit(lambda z: table.known(prior, z))

    def joint(z: np.ndarray) -> np.ndarray:
        return np.concatenate([np.asarray(rows(z))[:, -1], z])

    def slopes(z: np.ndarray) -> np.ndarray:
        return np.concatenate([np.asarray(rows(z))[:, :-1], np.eye(len(z))])

    start = np.zeros(len(table))
    found = scipy.optimize.least_squares(
        joint, start, slopes, xtol=1e-15, ftol=1e-15, gtol=1e-12
    )
    return informed(table, prior, prior.mean + prior.scale @ jnp.asarray(found.x))
