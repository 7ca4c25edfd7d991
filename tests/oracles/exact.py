"""Conjugate linear regression to 100 digits: the reference of the QR posterior.

Float64 inputs are dyadic rationals, so every Gram matrix of the data is formed exactly,
in Python integers; the small systems that remain (p <= 20) are solved by Cholesky in
100-digit arithmetic. At a condition number of 1e12 the Gram matrix has 1e24, so about
76 correct digits are left. Nothing here is shared with the library.

    y_n = J_n tt + e_n,   e_n ~ N(0, L L^T),   tt = mu0 + S z,   z ~ N(0, I)
"""

from dataclasses import dataclass

import mpmath
import numpy as np

mpmath.mp.dps = 100

Array = np.ndarray
_number = np.frompyfunc(mpmath.mpf, 1, 1)
_float = np.frompyfunc(float, 1, 1)


@dataclass(frozen=True)
class Exact:
    """Posterior in 100-digit numbers (object arrays of mpf)."""

    mean: Array  # (p,)
    cov: Array  # (p, p)
    precision_factor: Array  # (p, p) lower C, with C C^T the posterior precision
    log_evidence: mpmath.mpf

    def sd(self) -> Array:
        """Posterior standard deviations, as floats."""
        return np.sqrt(floats(np.diag(self.cov)))


def numbers(x: Array) -> Array:
    """The same values as 100-digit numbers, exactly."""
    return _number(np.asarray(x, float)).astype(object)


def floats(x: Array) -> Array:
    """Nearest float64 values."""
    return np.asarray(_float(x), float)


def integers(x: Array) -> tuple[Array, int]:
    """``x = n 2^e`` exactly, n an array of Python integers."""
    mantissa, exponent = np.frexp(np.asarray(x, float))
    n = (mantissa * 2.0**53).astype(np.int64).astype(object)
    exponent = exponent.astype(object) - 53
    used = exponent[n != 0]
    low = min(used) if used.size else 0
    return n * 2 ** np.where(n == 0, 0, exponent - low), low


def gram(x: Array) -> Array:
    """``x^T x`` exactly, then rounded to 100 digits."""
    n, e = integers(x)
    return _number(np.dot(n.T, n)).astype(object) * mpmath.mpf(2) ** (2 * e)


def cholesky(A: Array) -> Array:
    """Lower factor of a positive definite matrix."""
    A = A.copy()
    p = len(A)
    for j in range(p):
        A[j, j] = mpmath.sqrt(A[j, j])
        A[j + 1 :, j] = A[j + 1 :, j] / A[j, j]
        for k in range(j + 1, p):
            A[k:, k] = A[k:, k] - A[k:, j] * A[k, j]
    A[np.triu_indices(p, 1)] = mpmath.mpf(0)
    return A


def forward(L: Array, B: Array) -> Array:
    """``L^-1 B`` for lower-triangular L."""
    X = B.copy()
    for i in range(len(L)):
        X[i] = (X[i] - np.dot(L[i, :i], X[:i])) / L[i, i] if i else X[i] / L[i, i]
    return X


def log_det(L: Array) -> mpmath.mpf:
    """``log det`` of a triangular factor."""
    return mpmath.fsum(mpmath.log(abs(d)) for d in np.diag(L))


def posterior(
    J: Array, y: Array, noise_factor: Array, mean: Array, scale: Array
) -> Exact:
    """Posterior of the regression; J (N, d, p), y (N, d), L (d, d), S (p, p)."""
    N, d, p = J.shape
    S, mu, L = numbers(scale), numbers(mean), numbers(noise_factor)
    # Gram of [J y] for each pair of outputs, weighted by the noise precision.
    columns = np.concatenate([J, y[:, :, None]], axis=2).reshape(N, d * (p + 1))
    pairs = gram(columns).reshape(d, p + 1, d, p + 1)
    W = forward(L, numbers(np.eye(d)))
    weight = np.dot(W.T, W)
    G = sum(weight[i, j] * pairs[i, :, j] for i in range(d) for j in range(d))
    H, h, yy = G[:p, :p], G[:p, p], G[p, p]
    # Around the prior mean and in its coordinates.
    Hm = np.dot(H, mu)
    b = np.dot(S.T, h - Hm)
    square = yy - 2 * np.dot(h, mu) + np.dot(mu, Hm)
    M = cholesky(np.dot(S.T, np.dot(H, S)) + numbers(np.eye(p)))
    c = forward(M, b[:, None])[:, 0]
    T = forward(M, S.T).T  # cov = T T^T
    evidence = -(square - np.dot(c, c)) / 2 - log_det(M)
    evidence -= N * (log_det(L) + d * mpmath.log(2 * mpmath.pi) / 2)
    inverse_scale = forward(cholesky(np.dot(S, S.T)), numbers(np.eye(p)))
    precision = cholesky(H + np.dot(inverse_scale.T, inverse_scale))
    return Exact(mu + np.dot(T, c), np.dot(T, T.T), precision, evidence)


def whitened(exact: Exact, mean: Array) -> Array:
    """``C^T (mean - exact mean)``: the error in posterior sd along every direction."""
    return floats(np.dot(exact.precision_factor.T, numbers(mean) - exact.mean))


def mean_error(exact: Exact, mean: Array) -> float:
    """Largest error of a mean, in marginal posterior sd."""
    return float(np.max(np.abs(floats(numbers(mean) - exact.mean)) / exact.sd()))


def cov_error(reference: Array, cov: Array) -> float:
    """Largest error of a covariance, each entry relative to its two sd."""
    sd = np.sqrt(floats(np.diag(reference)))
    return float(np.max(np.abs(floats(numbers(cov) - reference)) / np.outer(sd, sd)))
