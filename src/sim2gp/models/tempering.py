"""How far a posterior is to be trusted elsewhere: parts of the data give evidence.

A wrong simulator leaves residuals that are no independent noise: one part of the data
pulls the constants one way, another part the other way. With ``g_n`` the score of row
``n`` in whitened coordinates and ``R^T R`` the posterior's precision, the pull of part
``b`` in posterior standard deviations is ``u_b = R^-T sum_{n in b} g_n``. At the MAP of
the right model ``sum_b u_b u_b^T`` has the mean ``(1 - 1/B) I``, but for the prior's
share: the information identity, less one part in ``B`` because all pulls add up to
nothing. Its largest eigenvalue in these units, if above one, is how many rows say no
more than one. It rests on the few parts alone: like a mean over its standard error, an
offset over it has Student's t with ``B - 1`` degrees of freedom, whose variance is
``(B - 1) / (B - 3)``. With both in ``kappa^2`` the posterior in which all rows count
that much less,

    Sigma_z = (R_d^T R_d / kappa^2 + I)^-1,

is as wide as the parts disagree. Parts are a fixed share of the data: where parts keep
contradicting each other more rows do not make the constants certain. (A power
posterior: Gruenwald and van Ommen 2017, arXiv 1412.3730; its rate by batch means of
the scores, as in the magnitude adjustment of composite likelihoods, Ribatet, Cooley and
Davison 2012, arXiv 0911.5357; t of the number of clusters less one, Cameron and Miller
2015, J. Human Resources 50.)
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from sim2gp.gaussian import Gaussian
from sim2gp.least_squares import over, stack
from sim2gp.models.sim2gp import Sim2GPBelief
from sim2gp.types import Scalar

#: Successive parts of the data, each of as many rows: few, for within a part rows may
#: be as dependent as they like.
PARTS = 5
#: Sd of Student's t with ``PARTS - 1`` degrees of freedom. With five parts two normal
#: sides of 2.5 % are cut where those of t are: ``1.96 sqrt(2) = 2.77``.
FEW = ((PARTS - 1) / (PARTS - 3)) ** 0.5


def tempered(
    belief: Sim2GPBelief,
    r: Float[Array, "N d"],
    J: Float[Array, "N d p"],
    mask: Bool[Array, " N"],
) -> tuple[Gaussian, Scalar]:
    """The constants' posterior as wide as the data's parts disagree, and ``kappa``.

    ``r`` are the residuals of the steps at the MAP and ``J`` their Jacobian in the
    virtual constants, state units; masked rows are zero.
    """
    prior = belief.prior.scale
    scores = jnp.einsum("ndp,nd->np", J, r / belief.noise[None] ** 2) @ prior
    kappa = jnp.maximum(1.0, FEW * disagreement(belief.information, scores, mask))
    precision = stack(belief.information / kappa, jnp.eye(len(prior)))
    return Gaussian(belief.posterior.mean, over(prior, precision)), kappa


def disagreement(
    information: Float[Array, "p p"],
    scores: Float[Array, "N p"],
    mask: Bool[Array, " N"],
) -> Scalar:
    """The largest pull of the parts together; one is what the right model expects."""
    count = jnp.maximum(jnp.sum(mask), 1)
    part = (jnp.cumsum(mask) - 1) * PARTS // count
    pulls = jax.ops.segment_sum(scores, part, PARTS)
    R = stack(information, jnp.eye(scores.shape[1]))
    return jnp.linalg.norm(over(pulls, R), ord=2) / jnp.sqrt(1.0 - 1.0 / PARTS)
