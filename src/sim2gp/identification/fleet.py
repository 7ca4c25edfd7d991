"""Machines of one kind: what they have in common, and what each has of its own.

Machine r has virtual values ``m + d_r``: those of the kind, ``m ~ N(mu0, S0)``, and its
own difference from them, ``d_r ~ N(0, diag(tau^2))``. In prior sds about ``mu0``, with
``R0`` the prior's correlations and ``t = diag(tau / sd0)``, its data are

    exp(-1/2 x^T L_r x + h_r^T x),    L_r = C_r^-1 - R0^-1,    h_r = C_r^-1 x_r

where ``N(x_r, C_r)`` is its posterior alone. With ``d_r`` integrated
(``K_r = I + t L_r t``; nothing is inverted that data may leave open),

    L'_r = L_r - L_r t K_r^-1 t L_r,    h'_r = h_r - L_r t K_r^-1 t h_r
    m | t ~ N(P^-1 b, P^-1),    P = R0^-1 + sum L'_r,    b = sum h'_r
    2 log p(data | t) = b^T P^-1 b - log|P| + sum (h_r^T t K_r^-1 t h_r - log|K_r|) + c

Each spread ``t_j`` has a half-normal prior of one prior sd (Gelman 2006, Bayesian
Analysis 1): it may be zero, and three machines do not determine it. Spreads are sampled
by slices (Neal 2003, Annals of Statistics 31); all else is averaged over them.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.inference.gaussian import Gaussian, of_mixture
from sim2gp.types import in_float64

#: Of log spreads, in prior sds: what is smaller is no difference.
SMALLEST, LARGEST = np.log(1e-5), np.log(10.0)
BURN_IN, SWEEPS, WIDTH = 100, 500, 1.5
NOTHING = 1e-9  # of the largest curvature: data say nothing in this direction


@dataclass(frozen=True)
class Fleet:
    """Gaussians over virtual values; ``spread`` has draws of each parameter's tau.

    ``another`` is a machine of the kind that has no data yet.
    """

    kind: Gaussian
    another: Gaussian
    machines: tuple[Gaussian, ...]
    spread: Float[np.ndarray, "draws p"]
    agreement: float


class _Data(NamedTuple):
    """What machines' data say of ``x``."""

    L: Float[np.ndarray, "R p p"]
    h: Float[np.ndarray, "R p"]
    P0: Float[np.ndarray, "p p"]


class _Given(NamedTuple):
    """Of given spreads: the kind; ``x_r = A_r m + c_r + noise of covariance V_r``."""

    log_evidence: float
    mean: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    A: Float[np.ndarray, "R p p"]
    c: Float[np.ndarray, "R p"]
    V: Float[np.ndarray, "R p p"]


@in_float64
def fit_fleet(
    prior: Gaussian,
    alone: Sequence[Gaussian],
    given: Sequence[Gaussian] | None = None,
    *,
    seed: int = 0,
) -> Fleet:
    """The kind and its machines, from each machine's posterior ``alone``.

    ``given`` are the priors that these posteriors began with, where not ``prior``. What
    data say is taken from each by dividing by its own prior.
    """
    mu, S = np.asarray(prior.mean), np.asarray(prior.covariance())
    sd = np.sqrt(np.diagonal(S))
    priors = [prior] * len(alone) if given is None else given
    pairs = [_of_data(*pair, mu, sd) for pair in zip(alone, priors, strict=True)]
    L, h = (np.stack(part) for part in zip(*pairs, strict=True))
    data = _Data(L, h, np.linalg.solve(S / np.outer(sd, sd), np.eye(len(sd))))
    draws = _spreads(data, np.random.default_rng(seed))
    conditional = [_given(data, t) for t in draws]
    m = np.stack([one.mean for one in conditional])
    Cm = np.stack([one.covariance for one in conditional])
    own = [one.A @ one.mean + one.c for one in conditional]
    each = [
        one.A @ one.covariance @ one.A.transpose(0, 2, 1) + one.V for one in conditional
    ]
    varied = Cm + np.stack([np.diag(t**2) for t in draws])
    machines = zip(np.stack(own, axis=1), np.stack(each, axis=1), strict=True)

    def of(mean: np.ndarray, covariance: np.ndarray) -> Gaussian:
        scales = sd[:, None] * np.linalg.cholesky(covariance)
        even = np.full(len(mean), 1.0 / len(mean))
        found = of_mixture(even, mu + sd * mean, scales)
        return Gaussian(*map(jnp.asarray, found))

    return Fleet(
        of(m, Cm),
        of(m, varied),
        tuple(of(*machine) for machine in machines),
        draws * sd,
        _agreement(draws),
    )


def _of_data(
    posterior: Gaussian,
    prior: Gaussian,
    mu: Float[np.ndarray, " p"],
    sd: Float[np.ndarray, " p"],
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """Curvature and slope at zero of what data say, in prior sds about ``mu``.

    Along directions in which a posterior is no narrower than its prior, nothing.
    """
    (x, C), (x0, C0) = (
        ((np.asarray(g.mean) - mu) / sd, np.asarray(g.covariance()) / np.outer(sd, sd))
        for g in (posterior, prior)
    )
    root = np.linalg.cholesky(C0)
    white = np.linalg.solve(root, np.linalg.solve(root, C).T)
    variance, V = np.linalg.eigh(0.5 * (white + white.T))
    gained = 1.0 / variance - 1.0
    gained = np.where(gained > NOTHING * max(gained.max(), 1.0), gained, 0.0)
    back = np.linalg.solve(root.T, V)  # columns: directions, in prior sds
    # z = V y: data say exp(-1/2 gained (y - y*)^2), y* where their slope is zero.
    y, known = V.T @ np.linalg.solve(root, x - x0), gained > 0.0
    best = np.where(known, y * (1.0 + 1.0 / np.where(known, gained, 1.0)), 0.0)
    L = (back * gained) @ back.T
    h = back @ (gained * best) + L @ x0
    return L, h


def _given(data: _Data, t: Float[np.ndarray, " p"]) -> _Given:
    """The kind and its machines for given spreads, in prior sds."""
    L, h, P0 = data
    p = t.size
    K = np.eye(p) + t[:, None] * L * t
    # (diag(1/t^2) + L)^-1, for t = 0 as well.
    B = t[:, None] * np.linalg.solve(K, np.broadcast_to(np.diag(t), K.shape))
    A = np.eye(p) - B @ L
    c = np.einsum("rij,rj->ri", B, h)
    P = P0 + np.sum(L @ A, axis=0)
    b = np.sum(h - np.einsum("rij,rj->ri", L, c), axis=0)
    C = np.linalg.solve(P, np.eye(p))
    C = 0.5 * (C + C.T)
    log_det = np.linalg.slogdet(K)[1].sum() + np.linalg.slogdet(P)[1]
    evidence = 0.5 * (b @ C @ b + np.sum(h * c) - log_det)
    return _Given(float(evidence), C @ b, C, A, c, B)


def _spreads(data: _Data, rng: np.random.Generator) -> Float[np.ndarray, "draws p"]:
    """Draws of the spreads given all data, in prior sds."""

    def log_density(u: Float[np.ndarray, " p"]) -> float:
        t = np.exp(u)  # whose density in u has the factor t
        return _given(data, t).log_evidence - 0.5 * float(t @ t) + float(u.sum())

    u = np.full(len(data.P0), np.log(0.1))
    found = []
    for sweep in range(BURN_IN + SWEEPS):
        for j in rng.permutation(u.size).tolist():
            u = _slice(log_density, u, j, rng)
        if sweep >= BURN_IN:
            found.append(np.exp(u))
    return np.stack(found)


def _slice(
    log_density: Callable[[np.ndarray], float],
    u: Float[np.ndarray, " p"],
    j: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, " p"]:
    """One coordinate, from where the density is above a random share of its own."""

    def at(x: float) -> np.ndarray:
        moved = u.copy()
        moved[j] = x
        return moved

    level = log_density(u) + np.log(rng.uniform())

    def inside(x: float) -> bool:
        return bool(SMALLEST < x < LARGEST and log_density(at(x)) > level)

    low = u[j] - WIDTH * rng.uniform()
    high = low + WIDTH
    while inside(low):
        low -= WIDTH
    while inside(high):
        high += WIDTH
    while True:
        x = rng.uniform(low, high)
        if inside(x):
            return at(x)
        low, high = (x, high) if x < u[j] else (low, x)


def _agreement(draws: Float[np.ndarray, "draws p"]) -> float:
    """How far the halves of the chain disagree: the largest R-hat, 1 where they agree.

    Gelman and Rubin 1992, Statistical Science 7.
    """
    logs = np.log(draws[: len(draws) // 2 * 2])
    halves = np.stack(np.split(logs, 2))
    within = halves.var(axis=1, ddof=1).mean(axis=0)
    between = halves.mean(axis=1).var(axis=0, ddof=1)
    return float(np.sqrt(1.0 + np.max(between / within)))
