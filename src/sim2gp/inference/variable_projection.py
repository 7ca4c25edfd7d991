"""Starts of a fit whose model is linear in many of its parameters.

At a draw of the other parameters the linear ones are solved for, and the noise with
them (Golub and Pereyra 1973, SIAM Journal on Numerical Analysis 10):

    w = argmin sum_c N_c log s_c(w) + 1/2 ||w||^2,    s_c^2 = mean ||r_c + J_c w||^2

The draw that leaves least is where a descent may begin, with the noise that is left. A
descent does not find a shape that turns suddenly, as the width of a dead zone: it is
tried over its prior's range, the others held.
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
#: Of each shape, in prior sds, and of draws so many times as many.
SHAPES = np.linspace(-2.0, 2.0, 24)
DRAWS = 2


def projected(
    likelihood: AbstractLikelihood,
    prior: ParameterPrior,
    key: Key,
    also: Float[Array, " p"] | None = None,
) -> tuple[Float[Array, " p"], Float[Array, " c"]]:
    """The best of some draws: a whitened start, and the noise sd there.

    Linear are the weights of groups. The first draw is the prior's mean, the second
    ``also`` (whitened). Each shape of a function is then searched along its own axis.
    """
    places, about = np.asarray(prior.linear), prior.gaussian
    p, shapes = about.mean.size, np.flatnonzero([p.shape for p in prior.table.free])
    z = jax.random.normal(key, (DRAWS + len(shapes), len(SHAPES), p))
    z = z.at[0, 0].set(0.0)
    z = z if also is None else z.at[0, 1].set(also)
    axes = np.zeros((len(z), p))
    axes[np.arange(DRAWS, len(z)), shapes] = 1.0
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

    def better(best: tuple, plan: tuple) -> tuple[tuple, None]:
        """The best so far and some more: draws, or itself with one of its shapes."""
        tried, axis = plan
        along = (best[1] * (1.0 - axis))[None] + SHAPES[:, None] * axis[None]
        tried = jnp.where(jnp.any(axis > 0.0), along, tried).at[:, places].set(0.0)
        found = jax.lax.map(one, tried)
        k = jnp.argmin(jnp.where(jnp.isfinite(found[0]), found[0], jnp.inf))
        new = jax.tree.map(lambda x: x[k], found)
        less = new[0] < best[0]
        return jax.tree.map(lambda x, y: jnp.where(less, x, y), new, best), None

    best = jnp.asarray(jnp.inf), jnp.zeros(p), first.sd
    (_, start, noise), _ = jax.lax.scan(better, best, (z, jnp.asarray(axes)))
    return start, noise
