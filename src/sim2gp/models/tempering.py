"""How far a posterior is to be trusted elsewhere: parts of the data give evidence.

A wrong simulator leaves residuals that are no independent noise: one part of the data
pulls the parameters one way, another part the other way. With ``g_n`` the score of row
``n`` in whitened coordinates and ``R^T R`` the posterior's precision, the pull of part
``b`` in posterior standard deviations is ``u_b = R^-T sum_{n in b} g_n``. At the MAP of
the right model, parts of equal information have ``E sum_b u_b u_b^T = (1 - 1/B) I``,
but for the prior's share: the information identity, less one part in ``B`` because all
pulls add up to nothing. The largest eigenvalue in these units is how many rows say no
more than one. It rests on the few parts alone: like a mean over its standard error, an
offset over it has Student's t with ``B - 1`` degrees of freedom, whose variance is
``(B - 1) / (B - 3)``. With both in ``kappa^2`` the posterior's covariance is that of
data in which all rows count that much less,

    Sigma_z = (R_d^T R_d / kappa^2 + I)^-1,

about the MAP, where residuals are learned. One parameter's interval is then as wide as
the parts scatter. For several it is on the safe side, because the largest of several
directions is more than one by chance: with six the right model has a ``kappa`` of 2.6.
Inflating each direction by its own eigenvalue (a floored sandwich) was measured to
cover too little where the simulator is wrong: four pulls do not span six directions.

Parts are a fixed share of the information: where parts keep contradicting each other,
more rows do not make the parameters certain, and a pole at rest is not counted as
evidence. (A power posterior: Gruenwald and van Ommen 2017, arXiv 1412.3730; its rate by
batch means of the scores, as in the magnitude adjustment of composite likelihoods,
Ribatet, Cooley and Davison 2012, arXiv 0911.5357; t of the number of clusters less one,
Cameron and Miller 2015, J. Human Resources 50.)
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import over, stack
from sim2gp.models.sim2gp import Sim2GPBelief
from sim2gp.types import Scalar

#: Successive parts of the data: few, for within a part rows may be as dependent as
#: they like.
PARTS = 5
#: Sd of Student's t with ``PARTS - 1`` degrees of freedom. With five parts two normal
#: sides of 2.5 % are cut where those of t are: ``1.96 sqrt(2) = 2.77``.
FEW = ((PARTS - 1) / (PARTS - 3)) ** 0.5


def tempered(
    belief: Sim2GPBelief, r: Float[Array, "N d"], J: Float[Array, "N d p"]
) -> tuple[Gaussian, Scalar]:
    """The parameters' posterior as wide as the data's parts disagree, and ``kappa``.

    ``r`` are the residuals of the steps at the MAP and ``J`` their Jacobian in the
    virtual parameters, state units; masked rows are zero. A ``frozen`` simulator's
    posterior, which holds no data of its own, comes back as it is.
    """
    prior = belief.prior.scale
    white = J @ prior / belief.noise[None, :, None]
    pull = jnp.einsum("ndp,nd->np", white, r / belief.noise[None])
    kappa = jnp.maximum(1.0, FEW * disagreement(belief.information, white, pull))
    precision = stack(belief.information / kappa, jnp.eye(len(prior)))
    return Gaussian(belief.posterior.mean, over(prior, precision)), kappa


def disagreement(
    information: Float[Array, "p p"],
    rows: Float[Array, "N d p"],
    scores: Float[Array, "N p"],
) -> Scalar:
    """The largest pull of the parts together; one is the right model's, in a direction.

    ``rows`` are the Jacobians and ``scores`` their pulls, whitened by prior and noise;
    ``information`` is the rows' factor.
    """
    N, d, p = rows.shape
    R = stack(information, jnp.eye(p))
    leverage = jnp.sum(over(rows.reshape(-1, p), R) ** 2, axis=1)
    pulls = jax.ops.segment_sum(scores, parts(leverage.reshape(N, d).sum(1)), PARTS)
    return jnp.linalg.norm(over(pulls, R), ord=2) / jnp.sqrt(1.0 - 1.0 / PARTS)


def parts(leverage: Float[Array, " N"]) -> Int[Array, " N"]:
    """Each row's part: successive rows, each part the same share of the sum."""
    total = jnp.sum(leverage)
    middle = jnp.cumsum(leverage) - 0.5 * leverage
    share = middle / jnp.where(total > 0.0, total, 1.0)
    # Clipped, so that a row that is not a number stays in the sum and is seen.
    return jnp.clip((PARTS * share).astype(int), 0, PARTS - 1)
