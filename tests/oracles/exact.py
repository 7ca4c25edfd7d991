"""Conjugate linear regression to 150 digits: the reference of the QR posterior.

Float64 inputs are dyadic rationals, so every Gram matrix of the data is formed exactly:
the columns are cut into 20-bit digits whose products float64 adds without rounding. The
small systems that remain (p <= 20) are solved by Cholesky in fixed point, Python
integers that count units of 2^-F. At a condition number of 1e12 the Gram matrix has
1e24, so more than 100 correct digits are left. Nothing is shared with the library.

    y_n = J_n tt + e_n,   e_n ~ N(0, L L^T),   tt = mu0 + S z,   z ~ N(0, I)
"""

import math
from dataclasses import dataclass

import mpmath
import numpy as np

Array = np.ndarray
F = 640  # bits behind the point
ONE = 1 << F
DIGIT = 20  # bits of a digit: products of two, summed over 2^12 rows, stay exact

_number = np.frompyfunc(lambda x: _fixed(float(x)), 1, 1)


def _fixed(x: float) -> int:
    numerator, denominator = x.as_integer_ratio()
    return (numerator << F) // denominator  # exact unless below 2^-(F - 52)


@dataclass(frozen=True)
class Exact:
    """Posterior in fixed point (object arrays of int), evidence as a float."""

    mean: Array  # (p,)
    cov: Array  # (p, p)
    scale: Array  # (p, p) the prior's S
    factor: Array  # (p, p) lower C: the precision is S^-T C C^T S^-1
    log_evidence: float

    def sd(self) -> Array:
        """Posterior standard deviations."""
        return np.sqrt(floats(np.diag(self.cov)))

    def mean_error(self, mean: Array) -> float:
        """Largest error of a mean, in marginal posterior sd."""
        return float(np.max(np.abs(floats(numbers(mean) - self.mean)) / self.sd()))

    def whitened_error(self, mean: Array) -> float:
        """Norm of the error in posterior sd: the largest over all directions."""
        z = forward(self.scale, numbers(mean) - self.mean)  # S must be lower
        return float(np.linalg.norm(floats(product(self.factor.T, z))))


def numbers(x: Array) -> Array:
    """The same values in fixed point."""
    return np.asarray(_number(np.asarray(x)), object)


def floats(x: Array) -> Array:
    """Nearest float64 values."""
    return np.asarray(x / ONE, float)


def product(A: Array, B: Array) -> Array:
    """Matrix product in fixed point."""
    return np.dot(A, B) >> F


def gram(x: Array) -> Array:
    """``x^T x`` in fixed point: exact sums, rounded once."""
    assert len(x) <= 4096
    e = np.frexp(np.max(np.abs(x), axis=0, initial=0.0))[1]
    rest, digits = np.ldexp(x, -e), []
    while np.any(rest):
        rest = rest * 2.0**DIGIT
        digits.append(np.trunc(rest))
        rest = rest - digits[-1]
    K, m = len(digits), x.shape[1]
    if not K:
        return numbers(np.zeros((m, m)))
    D = np.concatenate(digits, axis=1)
    parts = (D.T @ D).astype(np.int64).reshape(K, m, K, m)
    total = np.zeros((m, m), object)
    for s in range(2 * K - 1):
        part = sum(parts[a, :, s - a] for a in range(K) if 0 <= s - a < K)
        total = (total << DIGIT) + part.astype(object)
    # Counted so far in units of 2^-(2 DIGIT K), each column times 2^-e.
    shift = (e[:, None] + e[None, :]).astype(object) + F - 2 * DIGIT * K
    return (total << np.maximum(shift, 0)) >> np.maximum(-shift, 0)


def cholesky(A: Array) -> Array:
    """Lower factor of a positive definite matrix."""
    A = A.copy()
    p = len(A)
    for j in range(p):
        A[j, j] = math.isqrt(A[j, j] << F)
        A[j + 1 :, j] = (A[j + 1 :, j] << F) // A[j, j]
        for k in range(j + 1, p):
            A[k:, k] -= (A[k:, j] * A[k, j]) >> F
        A[j, j + 1 :] = 0
    return A


def forward(L: Array, B: Array) -> Array:
    """``L^-1 B`` for lower-triangular L."""
    X = B.copy()
    for i in range(len(L)):
        rest = (X[i] << F) - np.dot(L[i, :i], X[:i]) if i else X[i] << F
        X[i] = rest // L[i, i]
    return X


def log_det(L: Array) -> mpmath.mpf:
    """``log det`` of a triangular factor."""
    return mpmath.fsum(mpmath.log(mpmath.mpf(int(d)) / ONE) for d in np.diag(L))


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
    weight = product(W.T, W)
    G = sum(weight[i, j] * pairs[i, :, j] for i in range(d) for j in range(d)) >> F
    H, h, yy = G[:p, :p], G[:p, p], G[p, p]
    # Around the prior mean and in its coordinates.
    Hm = product(H, mu)
    b = product(S.T, h - Hm)
    square = yy - product(2 * h - Hm, mu)
    C = cholesky(product(S.T, product(H, S)) + numbers(np.eye(p)))
    c = forward(C, b)
    T = forward(C, S.T).T  # cov = T T^T
    with mpmath.workdps(100):
        evidence = -mpmath.mpf(int(square - product(c, c))) / ONE / 2 - log_det(C)
        evidence -= N * (log_det(L) + d * mpmath.log(2 * mpmath.pi) / 2)
    return Exact(mu + product(T, c), product(T, T.T), S, C, float(evidence))


def cov_error(reference: Array, cov: Array) -> float:
    """Largest error of a covariance, each entry relative to its two sd."""
    sd = np.sqrt(floats(np.diag(reference)))
    return float(np.max(np.abs(floats(numbers(cov) - reference)) / np.outer(sd, sd)))
