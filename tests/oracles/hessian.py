"""The full Hessian of SIM2GP's negative log posterior: what Gauss-Newton leaves out."""

import jax
import jax.numpy as jnp
from jax import Array

from sim2gp.data.transitions import Transitions
from sim2gp.models import Sim2GPBelief
from sim2gp.types import in_float64


@in_float64
def full_hessian(belief: Sim2GPBelief, data: Transitions) -> Array:
    """In coordinates whitened by the prior, at the posterior's mean.

    It equals the Gauss-Newton precision up to residuals times curvature, and may be
    indefinite away from a good fit.
    """
    prior, system, d = belief.prior, belief.system, belief.noise.size

    def loss(z: Array) -> Array:
        tt = prior.at(z)
        f = jax.vmap(lambda s, a: system.transition(tt, s, a, belief.dt)[:d])
        r = f(jnp.asarray(data.state), jnp.asarray(data.action))
        r = (r - jnp.asarray(data.next_state)[:, :d]) / belief.noise[None]
        return 0.5 * (jnp.sum(jnp.where(data.mask[:, None], r, 0.0) ** 2) + z @ z)

    away = belief.posterior.mean - prior.mean
    found: Array = jax.jit(jax.hessian(loss))(jnp.linalg.solve(prior.scale, away))
    return found
