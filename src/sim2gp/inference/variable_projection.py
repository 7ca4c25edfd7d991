"""Starts of a fit whose model is linear in many of its parameters.

At a draw of the other parameters the linear ones are solved for, and the noise with
them (Golub and Pereyra 1973, SIAM Journal on Numerical Analysis 10):

    w = argmin sum_c N_c log s_c(w) + 1/2 ||w||^2,    s_c^2 = mean ||r_c + J_c w||^2

The draws that leave least are where a descent may begin, with the noise that is left.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.types import Key

ROUNDS = 15  # of weights given noise, and noise given weights


def projected(
    likelihood: AbstractLikelihood,
    prior: ParameterPrior,
    draws: int,
    best: int,
    key: Key,
) -> tuple[Float[Array, "best p"], Float[Array, "best c"]]:
    """The best of so many draws: whitened starts, and the noise sd at each.

    Linear are the weights of groups. The first draw is the prior's mean.
    """
    places, about = np.asarray(prior.linear), prior.gaussian
    z = jax.random.normal(key, (draws, about.mean.size))
    z = z.at[:, places].set(0.0).at[0].set(0.0)
    counts, first = likelihood.counts, likelihood.first_noise()
    N, e = jnp.sum(counts, axis=0), jnp.zeros((len(counts), likelihood.n_nuisances))
    n = likelihood.n_nuisances

    def one(z: Array) -> tuple[Array, Array, Array]:
        rows = likelihood.blocks(about.at(z), e, about.scale[:, places])[..., n:]
        grams = jnp.einsum("wcij,wcik->cjk", rows, rows)
        G, g, r2 = grams[:, :-1, :-1], grams[:, :-1, -1], grams[:, -1, -1]
        eye = jnp.eye(len(places))

        def turn(_: Array, carry: tuple) -> tuple:
            _, s2 = carry
            A = jnp.einsum("cij,c->ij", G, 1.0 / s2) + eye
            w = -cho_solve(cho_factor(A), jnp.einsum("ci,c->i", g, 1.0 / s2))
            left = r2 + 2.0 * g @ w + jnp.einsum("i,cij,j->c", w, G, w)
            return w, (2.0 * likelihood.floor**2 + left) / (2.0 + N)

        start = jnp.zeros(len(places)), first.sd**2
        w, s2 = jax.lax.fori_loop(0, ROUNDS, turn, start)
        cost = 0.5 * (N @ jnp.log(s2) + w @ w + z @ z)
        return cost, z.at[places].set(w), jnp.sqrt(s2)

    costs, starts, noises = jax.lax.map(one, z)
    order = jnp.argsort(jnp.where(jnp.isfinite(costs), costs, jnp.inf))[:best]
    return starts[order], noises[order]
