"""What `sim2gp.identification.intervals.scatter` was chosen from, and an
oracle.

Each gives centre and sd in prior sd of the virtual constants, from the linearisation of
a fit at its MAP. None of these is part of the library.
"""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from scipy.optimize import nnls

from sim2gp.data.windows_likelihood import WindowsLikelihood, linearise
from sim2gp.identification.intervals.scatter import Pulls
from sim2gp.inference.estimate import Estimate
from sim2gp.models.tempering import FEW, disagreement

#: Correlation times of the mixture, in samples; 0 is white noise.
TIMES = (0, 1, 2, 4, 8, 16, 32)

Found = tuple[np.ndarray, np.ndarray]  # centre and sd, prior sd


@dataclass(frozen=True)
class Linear:
    """Samples of every window in noise sd, derivatives per prior sd: (W, L, c, ...)."""

    z: np.ndarray
    r: np.ndarray
    Jz: np.ndarray
    Je: np.ndarray
    e: np.ndarray
    noise: np.ndarray
    valid: np.ndarray  # (W, L): whether there is a sample at all
    pulls: Pulls

    @property
    def F(self) -> np.ndarray:
        """The Fisher information with the start states eliminated."""
        A = np.concatenate(list(self.pulls.factors))
        return A.T @ A


def linear(likelihood: WindowsLikelihood, fitted: Estimate, pulls: Pulls) -> Linear:
    """Of a fit whose prior has a diagonal scale."""
    p = pulls.scores.shape[1]
    found = linearise(likelihood, fitted, fitted.posterior.mean)
    mask = np.asarray(likelihood.windows.mask)
    stamped = np.flatnonzero(mask.any(axis=(0, 2)))
    noise = np.asarray(fitted.noise.sd)
    r = np.asarray(found.residual)[:, stamped] / noise
    J = np.asarray(found.jacobian)[:, stamped] / noise[:, None]
    prior_sd = np.diag(np.asarray(fitted.prior.scale))
    z = np.asarray(fitted.posterior.mean - fitted.prior.mean) / prior_sd
    e = np.asarray(fitted.nuisances)
    valid = mask[:, stamped].all(axis=2)
    return Linear(z, r, J[..., :p], J[..., p:], e, noise, valid, pulls)


def clusters(x: Linear) -> Found:
    """The textbook's sandwich about the MAP: a window is a cluster, jackknifed (CR3).

    The prior's own part is what keeps its directions: ``H^-1 (G + I) H^-1``.
    """
    F, p = x.F, x.pulls.scores.shape[1]
    H = F + np.eye(p)
    own = np.einsum("wkp,wkq->wpq", x.pulls.factors, x.pulls.factors)
    left = np.eye(p) - own @ np.linalg.solve(H, np.eye(p))
    u = np.linalg.solve(left, x.pulls.scores[..., None])[..., 0]
    root = np.concatenate([u, np.eye(p)])
    return x.z, np.linalg.norm(np.linalg.solve(H, root.T), axis=1)


def five_parts(x: Linear) -> Found:
    """`sim2gp.models.tempering`, about the MAP: one number from five parts."""
    A = np.linalg.qr(np.concatenate(list(x.pulls.factors)), mode="r")
    found = disagreement(
        jnp.asarray(A), jnp.asarray(x.pulls.factors), jnp.asarray(x.pulls.scores)
    )
    kappa = max(1.0, FEW * float(found))
    return x.z, _sd(x.F / kappa**2)


def mixture(x: Linear) -> Found:
    """A covariance of the noise itself: white and exponentials of several times.

    Non-negative variances by the moments of products within windows, whose expectation
    knows what the fit has taken out of the residuals; then the intervals of data with
    that noise, as those of the library.
    """
    W, L, c, p = x.Jz.shape
    flat = lambda A: A.reshape(W, L * c, A.shape[-1])  # noqa: E731
    Je, Jz = flat(x.Je), flat(x.Jz)
    own = np.einsum("wik,wil->wkl", Je, Je) + np.eye(Je.shape[-1])
    J = Jz - Je @ np.linalg.solve(own, np.einsum("wik,wip->wkp", Je, Jz))
    F = x.F
    Q = np.eye(L * c) - Je @ np.linalg.solve(own, np.swapaxes(Je, 1, 2))
    Q -= J @ np.linalg.solve(F + np.eye(p), np.swapaxes(J, 1, 2))
    full = x.valid.all(axis=1)
    Q, r = Q[full].reshape(-1, L, c, L, c), x.r[full]
    kernels = [_kernel(L, t) for t in TIMES]
    seen = np.einsum("wic,wjc->cij", r, r)
    expected = np.stack(
        [
            np.einsum("wicj,jl,wkcl->cik", Q[..., d], K, Q[..., d], optimize=True)
            for d in range(c)
            for K in kernels
        ]
    )
    lags, pairs = range(L), len(r) * (L - np.arange(L))
    weight = 1.0 / np.sqrt(pairs * np.where(np.arange(L) == 0, 2.0, 1.0))

    def products(E: np.ndarray) -> np.ndarray:
        traced = np.stack([np.trace(E, k, -2, -1) for k in lags], axis=-1) * weight
        return traced.reshape(*E.shape[:-3], -1)

    variances = nnls(products(expected).T, products(seen))[0].reshape(c, -1)
    J = J.reshape(W * L, c, p)[x.valid.ravel()]
    G = sum(
        variances[d, m] * J[:, d].T @ _kernel(len(J), t) @ J[:, d]
        for d in range(c)
        for m, t in enumerate(TIMES)
        if variances[d, m] > 0.0
    )
    return _godambe(x, F, G)


def oracle(x: Linear, rho: float, noise: float) -> Found:
    """The same windows, weighted by the true covariance of AR(1) noise of sd ``noise``.

    One Gauss-Newton step from the MAP, start states unknown as in the fit.
    """
    W, L, c, p = x.Jz.shape
    n = x.Je.shape[-1]
    rows = np.zeros((W, L, c, W * n + p + 1))
    for w in range(W):
        rows[w, ..., n * w : n * (w + 1)] = x.Je[w]
    rows[..., W * n : -1], rows[..., -1] = x.Jz, x.r
    rows = rows.reshape(W * L, c, -1)[x.valid.ravel()]
    rows *= x.noise[:, None] / noise
    rows[1:] = (rows[1:] - rho * rows[:-1]) / np.sqrt(1.0 - rho**2)
    prior = np.eye(W * n + p, W * n + p + 1)
    prior[:, -1] = np.concatenate([x.e.ravel(), x.z])
    R = np.linalg.qr(np.concatenate([rows.reshape(-1, rows.shape[-1]), prior]), "r")
    R = R[W * n : -1, W * n :]
    return x.z - np.linalg.solve(R[:, :-1], R[:, -1]), _sd(
        R[:, :-1].T @ R[:, :-1] - np.eye(p)
    )


def _godambe(x: Linear, F: np.ndarray, G: np.ndarray) -> Found:
    """Of prior and data with ``F G^-1 F``, never more certain than ``F``."""
    values, V = np.linalg.eigh(F)
    s = np.sqrt(np.maximum(values, 1e-30))
    size, U = np.linalg.eigh((V / s).T @ G @ (V / s))
    B = (U / np.sqrt(np.maximum(size, 1.0))).T @ (s[:, None] * V.T)
    F_c = B.T @ B
    data = F_c @ (x.z + np.linalg.solve(F, x.z))
    return np.linalg.solve(F_c + np.eye(len(F)), data), _sd(F_c)


def _sd(F: np.ndarray) -> np.ndarray:
    """Posterior sd of data with Fisher information ``F``, whitened by the prior."""
    I = np.eye(len(F))
    return np.sqrt(np.diag(np.linalg.solve(F + I, I)))


def _kernel(count: int, time: float) -> np.ndarray:
    lag = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    return np.exp(-lag / time) if time > 0 else np.eye(count)
