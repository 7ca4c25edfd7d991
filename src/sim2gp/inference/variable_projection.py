"""Starts of a fit whose model is linear in many of its parameters.

The linear ones are solved for, the others held (Golub and Pereyra 1973, SIAM Journal on
Numerical Analysis 10), and the noise has the highest evidence, by EM:

    w = argmin 1/2 sum_c ||r_c + J_c w||^2 / s_c^2 + 1/2 ||w||^2
    s_c^2 = mean (||r_c + J_c w||^2 + tr(J_c A^-1 J_c^T))

with ``A = I + sum_c J_c^T J_c / s_c^2``. Without the trace, many weights would leave
few rows less noise than they have. A descent may begin there, with that noise. It does
not find a shape that turns suddenly, as the width of a dead zone: where the usual
shapes already explain what another fit does not, each is tried over its prior's range.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float

from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.types import Scalar

ROUNDS = 15  # of weights given noise, and noise given weights
SHAPES = np.linspace(-2.0, 2.0, 24)  # tried of each shape, in prior sds
SAME = 1.2  # times another noise: no more than that, or no less


class Projected(NamedTuple):
    """A whitened start, its noise, and whether that is ``less`` than of another fit."""

    z: Float[Array, " p"]
    noise: Float[Array, " c"]
    less: Bool[Array, ""]


class _Solved(NamedTuple):
    """At some parameters; ``given`` is the noise with the weights as they were."""

    cost: Scalar
    z: Float[Array, " p"]
    noise: Float[Array, " c"]
    given: Float[Array, " c"]


def projected(
    likelihood: AbstractLikelihood, prior: ParameterPrior, also: Float[Array, " p"]
) -> Projected:
    """Weights at the better of the prior's mean and a fit's ``also`` (whitened).

    Where they leave some channel less noise than ``also`` does itself, each shape of a
    function in turn is searched along its own axis.
    """
    p = prior.gaussian.mean.size
    shapes = np.flatnonzero([each.shape for each in prior.table.free])

    def less(best: _Solved, known: Array) -> Array:
        return ~jnp.all(best.noise >= known / SAME)

    def unfinished(carry: tuple) -> Array:
        i, _, best, known = carry
        return (i < 2) | ((i < len(values)) & less(best, known))

    def better(carry: tuple) -> tuple:
        """The best so far and one more: some of its entries have other values."""
        i, about, best, known = carry
        about = jnp.where(begins[i], best.z, about)
        found = _solved(likelihood, prior, jnp.where(replaced[i], values[i], about))
        cheaper = found.cost < best.cost
        best = jax.tree.map(lambda x, y: jnp.where(cheaper, x, y), found, best)
        return i + 1, about, best, jnp.where(i == 1, found.given, known)

    axes = np.repeat(np.eye(p)[shapes], len(SHAPES), axis=0)
    sizes = np.tile(SHAPES, len(shapes))[:, None]
    values = jnp.concatenate([jnp.zeros((1, p)), also[None], sizes * axes])
    replaced = jnp.asarray(np.concatenate([np.ones((2, p), bool), axes > 0.0]))
    # The search of a shape begins where the last one ended.
    begins = jnp.asarray(np.arange(len(values)) % len(SHAPES) == 2)
    none = likelihood.first_noise().sd
    best = _Solved(jnp.asarray(jnp.inf), jnp.zeros(p), none, none)
    start = jnp.zeros((), int), best.z, best, none
    _, _, best, known = jax.lax.while_loop(unfinished, better, start)
    return Projected(best.z, best.noise, less(best, known))


def _solved(
    likelihood: AbstractLikelihood, prior: ParameterPrior, z: Float[Array, " p"]
) -> _Solved:
    """Weights and noise for the other parameters, and minus the evidence."""
    places, about, n = np.asarray(prior.linear), prior.gaussian, likelihood.n_nuisances
    own, z = z[places], z.at[places].set(0.0)
    counts, first = likelihood.counts, likelihood.first_noise()
    N, e = jnp.sum(counts, axis=0), jnp.zeros((len(counts), n))
    rows = likelihood.blocks(about.at(z), e, about.scale[:, places])[..., n:]
    grams = jnp.einsum("wcij,wcik->cjk", rows, rows)
    G, g, r2 = grams[:, :-1, :-1], grams[:, :-1, -1], grams[:, -1, -1]

    def squares(w: Array) -> Array:
        left = r2 + 2.0 * g @ w + jnp.einsum("i,cij,j->c", w, G, w)
        return 2.0 * likelihood.floor**2 + left

    def turn(_: Array, carry: tuple) -> tuple:
        _, s2, _ = carry
        root = cho_factor(jnp.einsum("cij,c->ij", G, 1.0 / s2) + jnp.eye(own.size))
        w = -cho_solve(root, jnp.einsum("ci,c->i", g, 1.0 / s2))
        spread = jnp.einsum("cij,ji->c", G, cho_solve(root, jnp.eye(own.size)))
        half_log_det = jnp.sum(jnp.log(jnp.diag(root[0])))
        cost = 0.5 * (N @ jnp.log(s2) + jnp.sum(squares(w) / s2) + w @ w)
        return w, (squares(w) + spread) / (2.0 + N), cost + half_log_det

    start = jnp.zeros_like(own), first.sd**2, jnp.zeros(())
    w, s2, cost = jax.lax.fori_loop(0, ROUNDS, turn, start)
    noise = (jnp.sqrt(x) for x in (s2, squares(own) / (2.0 + N)))
    return _Solved(cost + 0.5 * (z @ z), z.at[places].set(w), *noise)
