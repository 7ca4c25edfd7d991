"""Intervals that hold where residuals are coloured: how far do windows really scatter?

Laplace's posterior counts every sample as new. Of a real machine they never are, and
its 95 % intervals then hold the truth in a half of all cases or fewer. What the errors
of windows do to the constants shows in how the windows pull them, whatever is wrong
with the samples inside. In whitened coordinates (``tt = mu0 + L0 z``), with every
window's start state eliminated,

    u_w = J_w^T r_w,    F_w = J_w^T J_w,    F = sum F_w,    R^T R = F + I,
    v_w = R^-T u_w,     P_w = R^-T F_w R^-1.

If the noise is white and the prior right, the sum of ``v_w`` over any set ``s`` of
windows has covariance ``P_s (I - P_s)``. So, over all runs ``s`` of ``b`` successive
windows,

    G = 1/b sum_s R^T q_s q_s^T R,       q_s = (I - P_s)^-1/2 v_s,       E G = F,

exactly: it is the Bartlett (Newey-West) estimate of the covariance of the whole score,
without its bias of small samples. ``b`` follows from how alike successive pulls are
(Andrews 1991, with one correlation for all directions). In the coordinates in which
``F = I`` the eigenvalues ``lambda`` of G say how many samples count as one. A window
more or less matters to a matrix, so G is drawn towards one number for all directions,

    G <- (nu G + k kappa^2 F) / (nu + k),   kappa^2 = tr(F^-1 G) / p,   k = p (p + 1),

with ``nu`` its degrees of freedom, ``lambda >= 1``, and as wide as Student's t is with
``nu``. The intervals are those of the prior and of data that count as often as that,

    N(z_c, (F_c + I)^-1),     F_c = F G^-1 F,     z_c = (F_c + I)^-1 F_c z_data,

which is the posterior itself if G = F and the prior where F = 0; it is never narrower
than the first and never wider than the second. All in square roots. (The sandwich:
Huber 1967, White 1982; F G^-1 F: Godambe 1960; in a posterior: Ribatet, Cooley and
Davison 2012, arXiv 0911.5357; (I - P)^-1/2: Bell and McCaffrey 2002.)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.diagnose.misfit import must_be_finite
from sim2gp.diagnose.words import digits
from sim2gp.gaussian import Gaussian
from sim2gp.least_squares import RANK_TOLERANCE
from sim2gp.models.windows import Windows, WindowsBelief, linearise
from sim2gp.types import in_float64

#: Below so many degrees of freedom nothing is said about the windows' scatter.
FEWEST = 4.0
#: Of Bartlett's weights: ``1.5 W / b`` degrees of freedom (Priestley 1981).
BARTLETT = 1.5
TRUSTED = 1.0  # nats that a centre may cost beyond what the linear misfit says
HALVINGS = 6
LIKE_WHITE = 1.3  # times as wide: small samples alone make so much of white noise


@dataclass(frozen=True)
class Pulls:
    """What each window says of ``z`` alone, whitened by prior and noise.

    ``factors`` are square roots of ``F_w``, ``scores`` the gradients ``u_w`` of the
    cost at the MAP, ``group`` numbers the recordings: windows of one follow each other.
    """

    factors: Float[np.ndarray, "W k p"]
    scores: Float[np.ndarray, "W p"]
    group: Int[np.ndarray, " W"]


@dataclass(frozen=True)
class Corrected:
    """The corrected posterior, or the plain one where windows are too few to tell.

    ``inflation`` is ``kappa^2``, the samples that count as one; ``lag`` the ``b``
    successive windows taken together; ``freedom`` the degrees of freedom ``nu``.
    """

    posterior: Gaussian
    inflation: float
    lag: int
    freedom: float
    enough: bool


@in_float64
def pulls_of_windows(
    belief: WindowsBelief, cut: Windows, group: Int[np.ndarray, " W"]
) -> Pulls:
    """Of a fit and its windows, start states eliminated; ``group`` numbers their logs.

    Raises `NotFinite` E203.
    """
    return _pulls(_rows(belief, cut, belief.posterior.mean), cut, group)


@in_float64
def cost_of_windows(belief: WindowsBelief, cut: Windows, tt: Array) -> float:
    """Half the windows' squared misfit at ``tt``, each from the start that suits it.

    Starts follow by one Gauss-Newton step from where the fit has put them. Infinite
    where the simulation is not finite.
    """
    return _cost(_rows(belief, cut, tt), cut)


def _pulls(
    rows: Float[np.ndarray, "W k npr"], cut: Windows, group: Int[np.ndarray, " W"]
) -> Pulls:
    must_be_finite("derivatives or residuals", rows, "the intervals")
    n = cut.start.shape[1]
    R = np.asarray(np.linalg.qr(rows, mode="r"))[:, n:, n:]
    scores = np.einsum("wkp,wk->wp", R[..., :-1], R[..., -1])
    return Pulls(R[..., :-1], scores, np.asarray(group))


def _cost(rows: Float[np.ndarray, "W k npr"], cut: Windows) -> float:
    if not np.isfinite(rows).all():
        return math.inf
    n = cut.start.shape[1]
    both = np.concatenate([rows[..., :n], rows[..., -1:]], axis=-1)
    R = np.asarray(np.linalg.qr(both, mode="r"))
    return 0.5 * float(np.sum(R[:, n:, n] ** 2))


def _rows(
    belief: WindowsBelief, cut: Windows, tt: Array
) -> Float[np.ndarray, "W k npr"]:
    """Of each window ``[J_e J_z r]``, whitened, the start's prior in its last rows."""
    p, n = belief.prior.mean.size, cut.start.shape[1]
    found = linearise(belief, cut, tt)
    weight = np.sqrt(np.asarray(belief.weights))[:, None, None]
    scale = weight / np.asarray(belief.noise)
    r, J = np.asarray(found.residual) * scale, np.asarray(found.jacobian)
    J = J * scale[..., None]
    sd = np.asarray(cut.start_sd)
    away = np.asarray(belief.starts) - np.asarray(cut.start)
    e = np.divide(away, sd, out=np.zeros_like(away), where=sd > 0.0)
    rows = np.concatenate([J[..., p:], J[..., :p], r[..., None]], axis=-1)
    own = np.zeros((len(e), n, n + p + 1))
    own[..., :n], own[..., -1] = np.eye(n), e
    return np.concatenate([rows.reshape(len(e), -1, n + p + 1), own], axis=1)


@in_float64
def corrected_windows(
    belief: WindowsBelief, cut: Windows, group: Int[np.ndarray, " W"]
) -> Corrected:
    """The corrected posterior of a fit, its centre checked with the simulator itself.

    Near a bound the machine is not linear in ``z``, and a centre far from the MAP is
    one that no data suggest. Halfway back, and again, until the misfit there grows by
    no more than the linear one says, to `TRUSTED` nats of data that count as often as
    they should.
    """
    rows = _rows(belief, cut, belief.posterior.mean)
    pulls = _pulls(rows, cut, group)
    found = corrected(belief.prior, belief.posterior, pulls)
    start = np.asarray(belief.posterior.mean)
    step = np.asarray(found.posterior.mean) - start
    if not found.enough or not np.any(step):
        return found
    dz = np.linalg.solve(np.asarray(belief.prior.scale), step)
    score = pulls.scores.sum(axis=0)
    F = np.einsum("wkp,wkq->pq", pulls.factors, pulls.factors)
    before = _cost(rows, cut)
    for share in 0.5 ** np.arange(HALVINGS):
        there = cost_of_windows(belief, cut, jnp.asarray(start + share * step))
        told = share * dz @ (score + 0.5 * share * F @ dz)
        if there - before - told <= TRUSTED * max(found.inflation, 1.0):
            break
    else:
        share = 0.0
    centre = Gaussian(jnp.asarray(start + share * step), found.posterior.scale)
    return replace(found, posterior=centre)


@in_float64
def corrected(prior: Gaussian, plain: Gaussian, pulls: Pulls) -> Corrected:
    """The posterior as wide as the windows' pulls scatter; ``plain`` has the MAP.

    Raises `NotFinite` E203 for a pull that is not a number.
    """
    for what in (pulls.factors, pulls.scores):
        must_be_finite("pulls of windows", what, "the intervals")
    p = len(np.asarray(prior.mean))
    A = np.concatenate(list(pulls.factors))
    _, s, Vt = np.linalg.svd(A, full_matrices=False)
    seen = ~(s <= RANK_TOLERANCE * s.max(initial=0.0))
    s, Vt = s[seen], Vt[seen]
    R = np.asarray(np.linalg.qr(np.concatenate([A, np.eye(p)]), mode="r"))
    v, P = _whitened(pulls, R)
    onto = (Vt @ R.T) / s[:, None]  # from v to the coordinates in which F = I
    W = _effective(P)
    b = _lag(v @ onto.T, W, pulls.group)
    nu = min(W, BARTLETT * W / b)
    if len(s) == 0 or nu < FEWEST:
        return Corrected(plain, math.nan, b, nu, False)
    root, kappa2 = _shrunk(_scatter(v, P, pulls.group, b) @ onto.T, nu)
    _, size, U = np.linalg.svd(root, full_matrices=False)
    spread = np.maximum(size, 1.0) * math.sqrt(nu / (nu - 2.0))
    L0, mu0 = np.asarray(prior.scale), np.asarray(prior.mean)
    z = np.linalg.solve(L0, np.asarray(plain.mean) - mu0)
    # F z_data = (F + I) z at the MAP, where the scores add up to -z.
    data = s * (Vt @ z) - (Vt @ pulls.scores.sum(axis=0)) / s
    weight = U / spread[:, None]
    rows = np.concatenate([weight @ (s[:, None] * Vt), np.eye(p)])
    Q, T = np.linalg.qr(rows)
    centre = np.linalg.solve(T, Q[: len(s)].T @ (weight @ data))
    scale = np.linalg.solve(T.T, L0.T).T
    found = Gaussian(jnp.asarray(mu0 + L0 @ centre), jnp.asarray(scale))
    return Corrected(found, kappa2, b, nu, True)


def words(found: Corrected, widened: Sequence[float], windows: int) -> str:
    """Which intervals are told and why, in a sentence or two."""
    if not found.enough:
        return (
            f"Intervals count every sample as new: {windows} windows are too few to "
            "tell whether errors are coloured, and of a real machine they are."
        )
    scatter = digits(math.sqrt(found.inflation), 2)
    if max(widened, default=1.0) < LIKE_WHITE:
        return (
            f"The errors of {windows} windows pull the constants {scatter} times as "
            "far as white noise would: intervals are those of independent samples, "
            f"times {digits(max(widened, default=1.0), 3)} at most."
        )
    few, most = (digits(x, 2) for x in (min(widened), max(widened)))
    times = few if few == most else f"{few} to {most}"
    return (
        f"Intervals are {times} times as wide as if every sample were new: the errors "
        f"of {windows} windows are coloured and pull the constants {scatter} times as "
        "far as white noise would. This covers errors that come and go, not physics "
        "that the model lacks (sim2gp explain)."
    )


def _whitened(
    pulls: Pulls, R: Float[np.ndarray, "p p"]
) -> tuple[Float[np.ndarray, "W p"], Float[np.ndarray, "W p p"]]:
    """``v_w`` and ``P_w``."""
    v = np.linalg.solve(R.T, pulls.scores.T).T
    C = np.linalg.solve(R.T, np.swapaxes(pulls.factors, 1, 2))
    return v, C @ np.swapaxes(C, 1, 2)


def _effective(P: Float[np.ndarray, "W p p"]) -> float:
    """The number of windows, each counted by its share of the information."""
    share = np.trace(P, axis1=1, axis2=2)
    return float(share.sum() ** 2 / max(float(np.sum(share**2)), 1e-300))


def _lag(y: Float[np.ndarray, "W q"], W: float, group: Int[np.ndarray, " W"]) -> int:
    """Andrews' lag for Bartlett's weights; at most a quarter of the windows."""
    pair = group[1:] == group[:-1]
    shared = float(np.sum((y[1:] * y[:-1])[pair]))
    rho = shared / max(float(np.sum(y[:-1][pair] ** 2)), 1e-300)
    rho = float(np.clip(rho, -0.95, 0.95))
    alpha = 4.0 * rho**2 / (1.0 - rho**2) ** 2
    return max(1, min(round(1.1447 * (alpha * W) ** (1 / 3)), int(W) // 4))


def _scatter(
    v: Float[np.ndarray, "W p"],
    P: Float[np.ndarray, "W p p"],
    group: Int[np.ndarray, " W"],
    b: int,
) -> Float[np.ndarray, "S p"]:
    """Rows ``q_s / sqrt(b)`` of all runs of ``b`` windows, ends of recordings too."""
    found = []
    for k in dict.fromkeys(group.tolist()):
        own = group == k
        runs = _running(v[own], b), _running(P[own], b)
        left, Q = np.linalg.eigh(np.eye(v.shape[1]) - runs[1])
        inner = np.einsum("sij,si->sj", Q, runs[0]) / np.sqrt(np.maximum(left, 1e-12))
        found.append(np.einsum("sij,sj->si", Q, inner) / math.sqrt(b))
    return np.concatenate(found)


def _running(x: Float[np.ndarray, "W *p"], b: int) -> Float[np.ndarray, "S *p"]:
    """Sums of ``b`` successive entries, with nothing before and after them."""
    pad = np.zeros((b, *x.shape[1:]))
    total = np.cumsum(np.concatenate([pad, x, pad[1:]]), axis=0)
    return total[b:] - total[:-b]


def _shrunk(
    rows: Float[np.ndarray, "S q"], nu: float
) -> tuple[Float[np.ndarray, "T q"], float]:
    """A root of G drawn towards one number for all directions, and that number."""
    q = rows.shape[1]
    kappa2 = float(np.sum(rows**2)) / q
    k = q * (q + 1)
    own, common = nu / (nu + k), k / (nu + k)
    even = math.sqrt(common * max(kappa2, 1.0)) * np.eye(q)
    return np.concatenate([math.sqrt(own) * rows, even]), kappa2
