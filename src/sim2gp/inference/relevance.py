"""Which groups of parameters the data need: the scale of each group's prior.

The weights of one function share a scale ``tau`` of their prior. It maximises the
evidence of the linearised model, together with the noise (type-II maximum likelihood;
automatic relevance determination: MacKay 1992, Neural Computation 4; Tipping 2001, JMLR
1). A group that the data do not need goes to zero. With ``x`` the mean and ``S`` the
covariance of the whitened parameters, and ``i`` those of a group,

    tau^2 = mean_i (x_i^2 + S_ii)                       (EM)
    tau^2 = sum_i x_i^2 / sum_i (1 - S_ii / tau^2)      (MacKay's fixed point)

The second is faster and prunes what is needed where the first rounds take it: EM comes
first. Where noise alone would do, one scale in three ends above zero, with little
evidence: a group stays on where that is `EARNED` nats more than without it,

    log p(y | tau) / p(y | 0) = 1/2 (x^T S^-1 x + log |S / tau^2|)

(the ratio of prior and posterior density at zero: Dickey 1971). Two groups that can do
the same both go off so, and neither round turns one on again. So, of the groups that
are off, the one that would earn most is turned on. With ``s`` the Fisher information of
its weights and ``q`` the gradient of the log likelihood at zero, the others
marginalised (Tipping and Faul 2003, AISTATS),

    log p(y | tau) / p(y | 0) = 1/2 q^T (1/tau^2 + s)^-1 q - 1/2 log |1 + tau^2 s|

Only scales and noise are taken from here, never a posterior, so that normal equations
do: a round costs a Cholesky factor of the parameters' number.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.laplace import Laplace
from sim2gp.inference.linalg import eigh
from sim2gp.inference.prior import ParameterPrior
from sim2gp.types import AnyScalar, Scalar

EM_ROUNDS, ROUNDS = 100, 200  # at most
#: Relative changes of the squared scales: EM has found what is needed, all rest.
SLOW, RESTS = 0.02, 1e-4
EARNED = 3.0  # nats: noise alone gives one group as much in 1 of 400 cases
#: Of a group that is off, and of one that is as strong as it may be, in prior sd.
OFF, MOST = 1e-4, 20.0
ON = 10.0 * OFF  # from here on a group is on
NEVER = 0.1 * OFF  # a group of this scale stays off
TRIED = np.geomspace(1.2 * ON, MOST, 32)  # scales of a group that may be turned on


class Linear(NamedTuple):
    """The linearised data of each channel: Gram matrices of their rows ``[J r]``.

    ``spread`` are the squares that the nuisances' own uncertainty adds.
    """

    grams: Float[Array, "c k k"]
    spread: Float[Array, " c"]
    counts: Float[Array, " c"]
    floor: Float[Array, " c"]


def relevant(
    linear: Linear,
    z: Float[Array, " p"],
    noise: Noise,
    prior: ParameterPrior,
    trust: AnyScalar = 0.0,
) -> tuple[Noise, ParameterPrior]:
    """Noise and scales of highest evidence on data that are linearised at ``z``.

    ``trust`` is a precision that keeps the other parameters where they are, in that of
    their prior: far away the linear model is not true.
    """
    members, may = jnp.asarray(prior.members), prior.scales > NEVER
    held = trust * (1.0 - jnp.sum(members, axis=0))

    def unfinished(carry: tuple) -> Array:
        i, (_, _, change) = carry
        return (i < ROUNDS) & ((i <= EM_ROUNDS) | (change > RESTS))

    def turn(carry: tuple) -> tuple:
        i, (variance, tau2, _) = carry
        x, S = _posterior(linear, z, variance, prior.each(jnp.sqrt(tau2)), held)
        rows = jnp.append(x - z, 1.0)
        squares = jnp.einsum("i,cij,j->c", rows, linear.grams, rows)
        spread = jnp.einsum("cij,ji->c", linear.grams[:, :-1, :-1], S)
        expected = squares + spread + linear.spread
        variance = (2.0 * linear.floor**2 + expected) / (2.0 + linear.counts)
        own = jnp.diag(S)
        em = members @ (x**2 + own) / jnp.sum(members, axis=1)
        determined = jnp.sum(members, axis=1) - members @ own / tau2
        fixed_point = members @ x**2 / jnp.maximum(determined, 1e-6)
        new = jnp.where(i < EM_ROUNDS, em, jnp.minimum(em, fixed_point))
        new = jnp.where(may, jnp.clip(new, OFF**2, MOST**2), NEVER**2)
        change = jnp.max(jnp.abs(jnp.log(new / tau2)), initial=0.0)
        settled = (i < EM_ROUNDS) & (change < SLOW)
        return jnp.where(settled, EM_ROUNDS, i + 1), (variance, new, change)

    zero, far = jnp.zeros((), int), jnp.full((), jnp.inf)
    start = noise.sd**2, prior.scales**2, far
    _, (variance, tau2, _) = jax.lax.while_loop(unfinished, turn, (zero, start))
    each = prior.each(jnp.sqrt(tau2))
    x, S = _posterior(linear, z, variance, each, held)
    whitened = S / jnp.outer(each, each)
    # Where the linear model would go far to do without it, a group stays.
    gain = jax.vmap(_gained, (0, None, None))
    earned = jnp.maximum(*(gain(members, w / each, whitened) for w in (x, z)))
    scales = jnp.where(earned > EARNED, jnp.sqrt(tau2), jnp.where(may, OFF, NEVER))
    scales = _one_more(linear, z, variance, prior.scaled(scales), held)
    return Noise(jnp.sqrt(variance), noise.weights), prior.scaled(scales)


def _one_more(
    linear: Linear,
    z: Float[Array, " p"],
    variance: Float[Array, " c"],
    prior: ParameterPrior,
    held: Float[Array, " p"],
) -> Float[Array, " g"]:
    """The scales, with the group on that earns most of those that are off."""
    each, scales = prior.each(), prior.scales
    x, S = _posterior(linear, z, variance, each, held)
    total = jnp.sum(linear.grams / variance[:, None, None], axis=0)
    gradient = -(total[:-1, :-1] @ (x - z) + total[:-1, -1])
    gains = gains_if_on(total[:-1, :-1], gradient, S, prior.members)
    off = (scales > NEVER) & (scales <= ON)
    best = jnp.argmax(jnp.where(off[:, None], gains, -jnp.inf))
    group, k = jnp.unravel_index(best, gains.shape)
    earns = off[group] & (gains[group, k] > EARNED)
    more = jnp.where(earns, jnp.asarray(TRIED)[k], scales[group])
    return scales.at[group].set(more)


def gains_if_on(
    information: Float[Array, "p p"],
    gradient: Float[Array, " p"],
    covariance: Float[Array, "p p"],
    members: Float[np.ndarray, "g p"],
) -> Float[Array, "g t"]:
    """The evidence for each group that is off at the scales `TRIED`, nats.

    ``information`` is the data's, ``gradient`` that of the log likelihood at the
    posterior mean, ``covariance`` the posterior's, all of whitened parameters.
    """
    sizes = members.sum(axis=1).astype(int)
    places = np.argsort(-members, axis=1, kind="stable")[:, : sizes.max(initial=0)]
    own = np.take_along_axis(members, places, axis=1)
    rest = information - information @ covariance @ information
    s = rest[places[:, :, None], places[:, None]] * own[:, :, None] * own[:, None]
    known, U = jax.vmap(eigh)(s)
    q = jnp.einsum("gij,gi->gj", U, gradient[places] * own)
    tau2 = jnp.asarray(TRIED**2)[None, :, None]
    known, q = jnp.maximum(known, 0.0)[:, None], q[:, None]
    one = 1.0 + tau2 * known
    return 0.5 * jnp.sum(tau2 * q**2 / one - jnp.log(one), axis=2)


def price(scales: Float[Array, " g"]) -> Scalar:
    """Nats that the groups of these scales must have earned."""
    return jnp.sum(jnp.where(scales > ON, EARNED, 0.0))


def _posterior(
    linear: Linear,
    z: Float[Array, " p"],
    variance: Float[Array, " c"],
    each: Float[Array, " p"],
    held: Float[Array, " p"],
) -> tuple[Float[Array, " p"], Float[Array, "p p"]]:
    """Mean and covariance of the whitened parameters."""
    total = jnp.sum(linear.grams / variance[:, None, None], axis=0)
    known = 1.0 / each**2
    # In units of the prior's sd the matrix has eigenvalues of one or more.
    A = each[:, None] * (total[:-1, :-1] * each[None]) + jnp.diag(1.0 + held * each**2)
    slope = each * (total[:-1, -1] + known * z)
    root = cho_factor(A)
    inverse = cho_solve(root, jnp.eye(z.size))
    return z - each * (inverse @ slope), each[:, None] * inverse * each[None]


def _gained(
    members: Float[Array, " p"], x: Float[Array, " p"], S: Float[Array, "p p"]
) -> Scalar:
    """The evidence for a group, nats; its mean and covariance are in units of tau."""
    own, x = S * jnp.outer(members, members) + jnp.diag(1.0 - members), members * x
    root = cho_factor(own)
    half_log_det = jnp.sum(jnp.log(jnp.diag(root[0])))
    return 0.5 * x @ cho_solve(root, x) + half_log_det


def linear_of(
    found: Laplace,
    weights: Float[Array, " W"],
    counts: Float[Array, "W c"],
    floor: Float[Array, " c"],
) -> Linear:
    """The data about a point, with nuisances at what the noise there makes them."""
    reduced, spread = found.reduced()
    grams = jnp.einsum("w,wcij,wcik->cjk", weights, reduced, reduced)
    return Linear(grams, weights @ spread, jnp.sum(counts, axis=0), floor)
