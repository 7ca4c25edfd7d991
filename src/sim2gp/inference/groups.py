"""The fit of a machine with groups of parameters that the data may not need.

The model is linear in the groups, as functions of unknown shape are in their weights.
Where they explain much, a descent from the prior's mean ends at parameters that explain
little with much noise. Fits start from draws of the other parameters for which the
groups are solved linearly (`sim2gp.inference.variable_projection`), with the noise that
is left there, and where all groups are off.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import CONVERGED
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF
from sim2gp.inference.variable_projection import projected
from sim2gp.types import Key

DRAWS = 64  # of the other parameters
BROAD = 3.0  # scale of every group in a first descent
SAME = 1.2  # times the last noise: the last fit still explains the data


class Start(NamedTuple):
    """Where a descent begins: whitened parameters, noise, scales of the groups.

    ``enough`` asks for no other start where it leaves no more noise than it began with;
    ``project`` for projected parameters and their noise in place of these.
    """

    z: Float[Array, "*s p"]
    noise: Float[Array, "*s d"]
    scales: Float[Array, "*s g"]
    enough: Bool[Array, "*s"]
    project: bool | Bool[Array, "*s"] = False


@eqx.filter_jit
def estimate_groups(
    likelihood: AbstractLikelihood,
    some: AbstractLikelihood,
    prior: ParameterPrior,
    last: Start,
    key: Key,
) -> Estimate:
    """From the last fit; where that no longer explains the data, the fit of highest
    evidence from projected parameters, and with all groups off.

    Draws are judged by ``some`` of the data. What did not converge is reported by
    `Convergence.check`.
    """
    prior = prior.scaled(jnp.full(len(prior.scales), BROAD))
    first, no = likelihood.first_noise().sd, jnp.zeros((), bool)
    off = last.z.at[np.asarray(prior.linear)].set(0.0)
    fitted = last._replace(z=jnp.where(last.enough, last.z, jnp.nan))
    plain = Start(off, first, OFF / BROAD * prior.scales, no)
    each = fitted, Start(off, first, prior.scales, no, True), plain

    def best_draw(_: Start) -> tuple[Array, Array]:
        (z,), (sd,) = projected(some, prior, DRAWS, 1, key)
        return z, sd

    def descend(start: Start) -> Estimate:
        given = lambda start: (start.z, start.noise)  # noqa: E731
        z, sd = jax.lax.cond(start.project, best_draw, given, start)
        noise, about = Noise(sd, jnp.ones(1)), prior.scaled(start.scales)
        return estimate(likelihood, about, starts=z[None], noise=noise)

    def skip(start: Start) -> Estimate:
        shapes = jax.eval_shape(descend, start)
        none: Estimate = jax.tree.map(lambda x: jnp.full(x.shape, -1, x.dtype), shapes)
        return none

    def turn(done: Array, start: Start) -> tuple[Array, Estimate]:
        found = jax.lax.cond(done, skip, descend, start)
        same = jnp.all(found.noise.sd <= SAME * start.noise)
        ended = found.convergence.status == CONVERGED
        return done | (start.enough & same & ended), found

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _, found = jax.lax.scan(turn, no, stacked)
    there = found.convergence.status == CONVERGED
    there = there & jnp.isfinite(found.log_evidence)
    ranked = jnp.where(there, found.log_evidence, -jnp.inf)
    best: Estimate = jax.tree.map(lambda x: x[jnp.argmax(ranked)], found)
    return best
