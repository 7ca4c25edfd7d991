"""Starts of a fit whose model is linear in many of its parameters.

The linear ones are solved for, and the noise with them, the others held (Golub and
Pereyra 1973, SIAM Journal on Numerical Analysis 10):

    w = argmin sum_c N_c log s_c(w) + 1/2 ||w||^2,    s_c^2 = mean ||r_c + J_c w||^2

A descent may begin there, with the noise that is left. It does not find a shape that
turns suddenly, as the width of a dead zone: where the usual shapes already explain what
another fit does not, each is tried over its prior's range.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior

ROUNDS = 15  # of weights given noise, and noise given weights
SHAPES = np.linspace(-2.0, 2.0, 24)  # tried of each shape, in prior sds


def projected(
    likelihood: AbstractLikelihood,
    prior: ParameterPrior,
    also: Float[Array, " p"],
    known: Float[Array, " c"],
) -> tuple[Float[Array, " p"], Float[Array, " c"]]:
    """A whitened start with its weights of groups, and the noise sd that they leave.

    The better of the prior's mean and ``also`` (whitened), for which the weights are
    solved. Where that leaves some channel less noise than is ``known``, each shape of a
    function in turn is searched along its own axis.
    """
    places, about = np.asarray(prior.linear), prior.gaussian
    p, shapes = about.mean.size, np.flatnonzero([p.shape for p in prior.table.free])
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

    def unfinished(carry: tuple) -> Array:
        i, _, best = carry
        return (i < 2) | ((i < len(values)) & jnp.any(best[2] < known))

    def better(carry: tuple) -> tuple:
        """The best so far and one more: some of its entries have other values."""
        i, about, best = carry
        about = jnp.where(begins[i], best[1], about)
        found = one(jnp.where(replaced[i], values[i], about).at[places].set(0.0))
        less = found[0] < best[0]
        best = jax.tree.map(lambda x, y: jnp.where(less, x, y), found, best)
        return i + 1, about, best

    axes = np.repeat(np.eye(p)[shapes], len(SHAPES), axis=0)
    sizes = np.tile(SHAPES, len(shapes))[:, None]
    values = jnp.concatenate([jnp.zeros((1, p)), also[None], sizes * axes])
    replaced = jnp.asarray(np.concatenate([np.ones((2, p), bool), axes > 0.0]))
    # The search of a shape begins where the last one ended.
    begins = jnp.asarray(np.arange(len(values)) % len(SHAPES) == 2)
    best = jnp.asarray(jnp.inf), jnp.zeros(p), first.sd
    start = jnp.zeros((), int), best[1], best
    _, _, (_, found, noise) = jax.lax.while_loop(unfinished, better, start)
    return found, noise
