"""The fit of a machine with groups of parameters that the data may not need.

The model is linear in the groups, as functions of unknown shape are in their weights.
A fit starts where all groups are off; one after the other is turned on. Where they
explain much, that ends at parameters that explain little with much noise. So the groups
are also solved for linearly (`sim2gp.inference.variable_projection`) at the better of
that fit's parameters and the prior's mean. Where this leaves less noise, a fit starts
there with all groups on.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.compilation import compile_async
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import CONVERGED, NOT_FINITE
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF
from sim2gp.inference.variable_projection import SAME, Projected, projected
from sim2gp.types import Scalar

BROAD = 3.0  # scale of every group in a first descent
ROWS = 64  # that judge starts


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


@compile_async
def estimate_groups(
    likelihood: AbstractLikelihood,
    prior: ParameterPrior,
    last: Start,
    freedom: float | Scalar = jnp.inf,
) -> Estimate:
    """From the last fit; where that no longer explains the data, the fit of highest
    evidence from all groups off, and from projected parameters.

    ``freedom``: as in `estimate`.

    What did not converge is reported by `Convergence.check`.
    """
    prior = prior.scaled(jnp.full(len(prior.scales), BROAD))
    some, first = likelihood.thinned(ROWS), likelihood.first_noise()
    no = jnp.zeros((), bool)
    off = last.z.at[np.asarray(prior.linear)].set(0.0)
    fitted = last._replace(z=jnp.where(last.enough, last.z, jnp.nan))
    plain = Start(off, first.sd, OFF / BROAD * prior.scales, no)
    each = fitted, plain, Start(off, first.sd, prior.scales, no, True)

    def descend(start: Start) -> Estimate:
        noise = Noise(start.noise, first.weights)
        about = prior.scaled(start.scales)
        return estimate(
            likelihood, about, starts=start.z[None], noise=noise, freedom=freedom
        )

    def skip(start: Start) -> Estimate:
        shapes = jax.eval_shape(descend, start)
        none: Estimate = jax.tree.map(lambda x: jnp.full(x.shape, -1, x.dtype), shapes)
        return none

    def turn(carry: tuple[Array, Array], start: Start) -> tuple[Any, Estimate]:
        done, before = carry
        z, sd, less = jax.lax.cond(
            start.project & ~done,
            lambda: projected(some, prior, before),
            lambda: Projected(start.z, start.noise, ~no),
        )
        done = done | ~less
        found = jax.lax.cond(done, skip, descend, start._replace(z=z, noise=sd))
        same = jnp.all(found.noise.sd <= SAME * start.noise)
        ended = found.convergence.status == CONVERGED
        now = prior.gaussian.whitened(found.posterior.mean)
        done = done | (start.enough & same & ended)
        return (done, now), found

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _, found = jax.lax.scan(turn, (no, off), stacked)
    return best_ended(found)


def best_ended(found: Estimate) -> Estimate:
    """Of stacked fits the one of highest evidence; of those that ended best.

    A fit that stalled says more than a start that was not taken.
    """
    status = found.convergence.status
    there = jnp.isfinite(found.log_evidence) & (status >= CONVERGED)
    status = jnp.where(there, status, NOT_FINITE)
    there = there & (status == jnp.min(status))
    ranked = jnp.where(there, found.log_evidence, -jnp.inf)
    best: Estimate = jax.tree.map(lambda x: x[jnp.argmax(ranked)], found)
    return best
