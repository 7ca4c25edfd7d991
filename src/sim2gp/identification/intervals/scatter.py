"""Intervals that hold where residuals are coloured: how far do windows really scatter?

Laplace's posterior counts every sample as new. Of a real machine they never are, and
its 95 % intervals then hold the truth in a half of all cases or fewer. The effect of
the windows' errors on the parameters shows in how the windows pull them, for any kind
of error inside. In whitened coordinates (``tt = mu0 + L0 z``), with every window's
start state eliminated,

    u_w = J_w^T r_w,    F_w = J_w^T J_w,    F = sum F_w,    R^T R = F + I,
    v_w = R^-T u_w,     P_w = R^-T F_w R^-1.

If the noise is white and the prior right, the sum of ``v_w`` over any set ``s`` of
windows has covariance ``P_s (I - P_s)``. So, over all runs ``s`` of ``b`` successive
windows,

    G = 1/b sum_s R^T q_s q_s^T R,       q_s = (I - P_s)^-1/2 v_s,       E G = F,

exactly: it is the Bartlett (Newey-West) estimate of the covariance of the whole score,
without its bias of small samples. Blocks of a window share the start that was
eliminated (`SharedStarts`). With ``D_w`` of a window added up over its blocks in ``s``
and ``C_s`` the sum of ``R^-T D_w^T D_w R^-1``, theirs has ``P_s - P_s^2 - C_s``, and

    q_s = P_s^1/2 (I - P_s - P_s^-1/2 C_s P_s^-1/2)^-1/2 P_s^-1/2 v_s.

``b`` follows from how alike successive pulls are (Andrews 1991, with one correlation
for all directions). In the coordinates in which ``F = I`` the eigenvalues ``lambda`` of
G say how many samples count as one. A window more or less matters to a matrix, so G is
drawn towards one number for all directions,

    G <- (nu G + k kappa^2 F) / (nu + k),   kappa^2 = tr(F^-1 G) / p,   k = p (p + 1),

with ``nu`` its degrees of freedom, ``lambda >= 1``, and as wide as Student's t is with
``nu``. Forces that may be missing have a number of their own for the directions that
are not the parameters': they are many, and of other frequencies. The intervals are
those of the prior and of data that count as often as that,

    N(z_c, (F_c + I)^-1),     F_c = F G^-1 F,     z_c = (F_c + I)^-1 F_c z_data,

which is the posterior itself if G = F and the prior where F = 0; it is never narrower
than the first and never wider than the second. All in square roots. (The sandwich:
Huber 1967, White 1982; F G^-1 F: Godambe 1960; in a posterior: Ribatet, Cooley and
Davison 2012, arXiv 0911.5357; (I - P)^-1/2: Bell and McCaffrey 2002.)

A bias that is the same in all windows does not show in their scatter. So some entries
of ``z`` may be weights of forces that the simulator may lack, in groups: a discrepancy
(Kennedy and O'Hagan 2001) of physical shape. A group is on, with its own scale, or off.
In the data's form above scales ``tau`` have a Gaussian posterior and an evidence,

    log p(tau) = 1/2 |Q_1^T d|^2 - log |T|,    [F_c^1/2 D; I] = Q T,  D = diag(1, tau),

and the parameters are reported with the mean and the covariance of a mixture over which
groups are on and at which scale. It has all that a search visits which turns on one
more as long as that pays (`averaging`): what the data leave open of the forces widens
the intervals, what they say of them moves the centre. Where no group is on, mean and
covariance are those of the parameters alone, with the scatter that windows have then.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp import checks
from sim2gp.identification.intervals.averaging import NONE, NOTHING, Groups, averaged
from sim2gp.identification.intervals.pulls import Pulls, SharedStarts
from sim2gp.identification.missing_physics.curves import Curve
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import RANK_TOLERANCE, over
from sim2gp.types import AnyArray, in_float64

#: Below so many degrees of freedom nothing is said about the windows' scatter.
FEWEST = 4.0
#: Of Bartlett's weights: ``1.5 W / b`` degrees of freedom (Priestley 1981).
BARTLETT = 1.5
#: Share of its covariance that a block's pull keeps at least in any direction.
LEFT = 1e-3


@dataclass(frozen=True)
class CorrectedFit:
    """The corrected posterior, or the plain one where windows are too few.

    ``inflation`` is ``kappa^2``, the samples that count as one; ``lag`` the ``b``
    successive windows taken together; ``freedom`` the degrees of freedom ``nu``;
    ``each`` the probability that the simulator lacks a kind of force, by its name, and
    that it lacks nothing (`NONE`); ``curves`` are these forces.
    """

    posterior: Gaussian
    inflation: float
    lag: int
    freedom: float
    enough: bool
    each: Mapping[str, float] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()

    @property
    def missing(self) -> float:
        """The probability that the simulator lacks something."""
        return 1.0 - self.each.get(NONE, 1.0)

    @property
    def found(self) -> tuple[Curve, ...]:
        """Forces that are rather there than not."""
        likely = {kind for kind, p in self.each.items() if kind and p > NOTHING}
        return tuple(c for c in self.curves if likely & set(c.kinds))

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of forces that it may lack."""
        return tuple(name for name in self.each if name != NONE)


@in_float64
def correct_posterior(
    prior: Gaussian,
    plain: Gaussian,
    pulls: Pulls,
    groups: Groups | None = None,
) -> CorrectedFit:
    """The posterior as wide as the windows' pulls scatter, about the data's centre.

    ``plain`` has the point where the pulls were linearised. It is returned where
    windows are too few; ``groups`` are places of what the simulator may lack. Raises
    `NotFinite` E203 for a pull that is not a number.
    """
    for what in (pulls.factors, pulls.scores):
        checks.finite_results("the intervals", "pulls of windows", what)
    L0, mu0 = np.asarray(prior.scale), np.asarray(prior.mean)
    z, pulls, data, R = _at_the_map(prior, plain.mean, pulls)
    p = len(mu0)
    _, s, Vt = np.linalg.svd(data, full_matrices=False)
    seen = ~(s <= RANK_TOLERANCE * s.max(initial=0.0))
    s, Vt = s[seen], Vt[seen]
    unit, P = _whitened(pulls, R)
    onto = (Vt @ R.T) / s[:, None]  # from v to the coordinates in which F = I
    W = _effective(P)
    b = _lag(unit.scores @ onto.T, W, pulls.group)
    nu = min(W, BARTLETT * W / b)
    if len(s) == 0 or nu < FEWEST:
        return CorrectedFit(plain, math.nan, b, nu, False)
    columns = s[:, None] * Vt
    own = np.setdiff1d(np.arange(p), _places(groups or {}))
    rows = _scatter(unit, P, b) @ onto.T
    root, kappa2 = _shrink_apart(rows, columns[:, own], nu)
    _, size, U = np.linalg.svd(np.linalg.qr(root, mode="r"), full_matrices=False)
    spread = np.maximum(size, 1.0) * math.sqrt(nu / (nu - 2.0))
    # F z_data = (F + I) z at the MAP, where the scores add up to -z.
    known = s * (Vt @ z) - (Vt @ pulls.scores.sum(axis=0)) / s
    weight = U / spread[:, None]
    root, rest = weight @ columns, weight @ known
    alone = _without_forces(z, pulls, own) if groups else None
    centre, scale, each = averaged(root, rest, groups or {}, alone)
    found = jax.device_put(Gaussian(mu0 + L0 @ centre, L0 @ scale))
    return CorrectedFit(found, kappa2, b, nu, True, each)


@in_float64
def posterior_of(prior: Gaussian, at: Float[AnyArray, " p"], pulls: Pulls) -> Gaussian:
    """Of a linear machine whose every sample is new; pulls were taken at ``at``."""
    z, _, _, R = _at_the_map(prior, at, pulls)
    scale = over(np.asarray(prior.scale), R)
    return Gaussian(prior.at(jnp.asarray(z)), jnp.asarray(scale))


def _at_the_map(
    prior: Gaussian, at: Float[AnyArray, " p"], pulls: Pulls
) -> tuple[
    Float[np.ndarray, " p"],
    Pulls,
    Float[np.ndarray, "q p"],
    Float[np.ndarray, "p p"],
]:
    """The MAP of what is linear, whitened, and the pulls there: the same where ``at``
    is it; the factor of the data's information, and R, that of the posterior's."""
    z = prior.on_host().whitened(np.asarray(at))
    data = np.asarray(np.linalg.qr(pulls.rows, mode="r"))
    R = np.asarray(np.linalg.qr(np.concatenate([data, np.eye(len(z))]), mode="r"))
    step = -np.linalg.solve(R, np.linalg.solve(R.T, z + pulls.scores.sum(axis=0)))
    return z + step, pulls.at(step), data, R


def _whitened(
    pulls: Pulls, R: Float[np.ndarray, "p p"]
) -> tuple[Pulls, Float[np.ndarray, "W p p"]]:
    """The pulls ``v_w``, whitened by the posterior, and their ``P_w``."""
    whole = pulls.onto(over(np.eye(len(R)), R))
    return whole, np.swapaxes(whole.factors, 1, 2) @ whole.factors


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


def _scatter(pulls: Pulls, P: Float[np.ndarray, "W p p"], b: int) -> AnyArray:
    """Rows ``q_s / sqrt(b)`` (S, p) of all runs of ``b`` pulls, ends of recordings too.

    ``pulls`` are whitened (`_whitened`).
    """
    found = []
    for k in dict.fromkeys(pulls.group.tolist()):
        own = pulls.group == k
        size, Q = np.linalg.eigh(_running(P[own], b))
        v = np.einsum("sij,si->sj", Q, _running(pulls.scores[own], b))
        lost = _lost(pulls.starts, own, b)
        inner = _as_wide(v, size, lost if lost is None else _turned(lost, Q))
        found.append(np.einsum("sij,sj->si", Q, inner) / math.sqrt(b))
    return np.concatenate(found)


def _as_wide(
    v: Float[np.ndarray, "S p"],
    size: Float[np.ndarray, "S p"],
    lost: Float[np.ndarray, "S p p"] | None,
) -> Float[np.ndarray, "S p"]:
    """``q_s`` in coordinates in which ``P_s`` is diagonal, ``lost`` being ``C_s``."""
    if lost is None:
        return v / np.sqrt(np.maximum(1.0 - size, 1e-12))
    seen = size > RANK_TOLERANCE
    root = np.sqrt(np.where(seen, size, 1.0))
    left = np.where(seen, 1.0 - size, 1.0)[..., None] * np.eye(size.shape[1])
    both = root[:, :, None] * root[:, None, :]
    left -= np.where(seen[:, :, None] & seen[:, None, :], lost / both, 0.0)
    share, Q = np.linalg.eigh(left)
    inner = np.einsum("sij,si->sj", Q, np.where(seen, v / root, 0.0))
    inner /= np.sqrt(np.maximum(share, LEFT))
    return root * np.einsum("sij,sj->si", Q, inner)


def _lost(
    starts: SharedStarts | None, own: Bool[np.ndarray, " W"], b: int
) -> Float[np.ndarray, "S p p"] | None:
    """``C_s`` of runs of ``b`` blocks: sums of ``D^T D``, a window's blocks as one."""
    if starts is None:
        return None
    window, total = starts.window[own], 0.0
    for w in np.unique(window):
        D = _running(np.where((window == w)[:, None, None], starts.onto[own], 0.0), b)
        total = total + np.swapaxes(D, 1, 2) @ D
    return np.asarray(total)


def _turned(
    x: Float[np.ndarray, "S p p"], Q: Float[np.ndarray, "S p p"]
) -> Float[np.ndarray, "S p p"]:
    return np.asarray(np.swapaxes(Q, 1, 2) @ x @ Q)


def _running(x: Float[np.ndarray, "W *p"], b: int) -> Float[np.ndarray, "S *p"]:
    """Sums of ``b`` successive entries, with nothing before and after them."""
    pad = np.zeros((b, *x.shape[1:]))
    total = np.cumsum(np.concatenate([pad, x, pad[1:]]), axis=0)
    return total[b:] - total[:-b]


def _places(groups: Groups) -> Int[np.ndarray, " k"]:
    """Those of all groups."""
    return np.concatenate([np.zeros(0, int), *groups.values()])


def _without_forces(
    z: Float[np.ndarray, " p"], pulls: Pulls, own: Int[np.ndarray, " k"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]] | None:
    """Mean and scale of the parameters' entries ``own`` where nothing is missing.

    Forces that are free absorb a part of slow errors, so the windows scatter less with
    them than without. None where windows are too few.
    """
    p, k = len(z), len(own)
    onto = np.eye(p)[:, own]
    unit = np.eye(k)
    still = pulls.at(onto @ z[own] - z).onto(onto)
    found = correct_posterior(
        Gaussian(np.zeros(k), unit), Gaussian(z[own], unit), still
    )
    if not found.enough:
        return None
    mean, scale = np.asarray(found.posterior.mean), np.asarray(found.posterior.scale)
    return onto @ mean, onto @ scale @ onto.T


def _shrink_apart(
    rows: Float[np.ndarray, "S q"], own: Float[np.ndarray, "q p"], nu: float
) -> tuple[Float[np.ndarray, "T q"], float]:
    """A root of G, and the number of the parameters' own directions.

    What errors do in the span of ``own`` is drawn towards one number and what they do
    to forces alone towards another: there are many more forces, of other frequencies.
    """
    Q = np.linalg.qr(own, mode="complete")[0]
    mine, others = np.split(Q, [min(own.shape)], axis=1)
    root, kappa2 = _shrink_scatter(rows @ mine, nu)
    if others.shape[1] == 0:
        return root @ mine.T, kappa2
    more, _ = _shrink_scatter(rows @ others, nu)
    return np.concatenate([root @ mine.T, more @ others.T]), kappa2


def _shrink_scatter(
    rows: Float[np.ndarray, "S q"], nu: float
) -> tuple[Float[np.ndarray, "T q"], float]:
    """A root of G drawn towards one number for all directions, and that number."""
    q = rows.shape[1]
    kappa2 = float(np.sum(rows**2)) / q
    k = q * (q + 1)
    own, common = nu / (nu + k), k / (nu + k)
    even = math.sqrt(common * max(kappa2, 1.0)) * np.eye(q)
    return np.concatenate([math.sqrt(own) * rows, even]), kappa2
