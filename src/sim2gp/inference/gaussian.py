"""A Gaussian held by a square root of its covariance.

``x = mean + scale @ eps`` with ``eps ~ N(0, I)``, so ``cov = scale scale^T``. The scale
may be any matrix ``(n, k)``: positive semidefinite by construction, never a covariance
that must be proved positive, and no jitter anywhere.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.errors import InputError, error
from sim2gp.inference.linalg import library, solve_triangular, triangular
from sim2gp.types import AnyArray, Key, Scalar

LOG_2PI = 1.8378770664093453


class Gaussian(eqx.Module):
    """``N(mean, scale scale^T)`` over ``R^n``."""

    mean: Float[AnyArray, " n"]
    scale: Float[AnyArray, "n k"]

    def at(self, eps: Float[AnyArray, " k"]) -> Float[AnyArray, " n"]:
        """The point at standard normal coordinates ``eps``."""
        return self.mean + self.scale @ eps

    def whitened(self, x: Float[AnyArray, " n"]) -> Float[AnyArray, " n"]:
        """The standard normal coordinates of a point; ``scale`` must be square."""
        xp = library(x, self.mean, self.scale)
        found: AnyArray = xp.linalg.solve(self.scale, x - self.mean)
        return found

    def on_host(self) -> "Gaussian":
        """The same in NumPy, which compiles nothing for sizes that are new."""
        return Gaussian(np.asarray(self.mean), np.asarray(self.scale))

    def sample(self, key: Key) -> Float[Array, " n"]:
        """One draw."""
        return self.at(jax.random.normal(key, (self.scale.shape[1],), self.scale.dtype))

    def push(self, A: Float[Array, "d n"], b: Float[Array, " d"]) -> "Gaussian":
        """The distribution of ``A x + b``."""
        return Gaussian(A @ self.mean + b, A @ self.scale)

    def plus(self, scale: Float[Array, "n l"]) -> "Gaussian":
        """The distribution of ``x + scale @ eps``, eps independent of ``x``."""
        return Gaussian(self.mean, jnp.concatenate([self.scale, scale], axis=1))

    def marginal(self, at: Int[np.ndarray, " m"]) -> "Gaussian":
        """That of the coordinates at some places, with a square scale."""
        mine = Gaussian(self.mean[at], self.scale[at])
        return Gaussian(mine.mean, mine.triangular())

    def with_block(self, at: Int[np.ndarray, " m"], other: "Gaussian") -> "Gaussian":
        """``other`` at these places, the rest as it was, independent of it.

        Both scales are square, and this one has no covariance with these places.
        """
        mean, scale = np.array(self.mean), np.array(self.scale)
        mean[at], scale[np.ix_(at, at)] = other.mean, other.scale
        found: Gaussian = jax.device_put(Gaussian(mean, scale))
        return found

    def covariance(self) -> Float[Array, "n n"]:
        """``scale scale^T``, exactly symmetric."""
        cov = self.scale @ self.scale.T
        return 0.5 * (cov + cov.T)

    def sd(self) -> Float[AnyArray, " n"]:
        """Standard deviation of each coordinate."""
        xp = library(self.scale)
        return xp.sqrt(xp.sum(self.scale**2, axis=1))

    def triangular(self) -> Float[AnyArray, "n n"]:
        """The lower-triangular scale with non-negative diagonal (by QR, not Cholesky).

        Raises ValueError when the scale has fewer columns than rows: the covariance is
        then singular and no density exists.
        """
        n, k = self.scale.shape
        if k < n:
            raise ValueError(
                f"Gaussian of dimension {n} has a scale of {k} columns: its covariance "
                "is singular; add noise with `plus` before asking for a density"
            )
        return lower_factor(self.scale)

    def log_prob(self, x: Float[Array, " n"]) -> Scalar:
        """Log density at ``x``, nats."""
        L = self.triangular()
        z = solve_triangular(L, x - self.mean, lower=True)
        return -0.5 * (z @ z + z.size * LOG_2PI) - log_det_factor(L)

    def entropy(self) -> Scalar:
        """Differential entropy, nats."""
        n = self.mean.size
        return 0.5 * n * (1.0 + LOG_2PI) + log_det_factor(self.triangular())

    def kl(self, other: "Gaussian") -> Scalar:
        """``KL[self || other]``, nats."""
        L0, L1 = self.triangular(), other.triangular()
        A = solve_triangular(L1, L0, lower=True)
        e = solve_triangular(L1, self.mean - other.mean, lower=True)
        quadratic = jnp.sum(A**2) + e @ e - e.size
        return 0.5 * quadratic + log_det_factor(L1) - log_det_factor(L0)


def from_covariance(
    mean: Float[np.ndarray, " n"],
    covariance: Float[np.ndarray, "n n"],
    names: Sequence[str] = (),
) -> Gaussian:
    """The Gaussian of a covariance that another tool made; call it under `in_float64`.

    ``names`` of the coordinates go into the message. Raises `InputError` E143 where the
    matrix is no covariance, beyond the rounding of its own numbers.
    """
    diagonal = np.diag(covariance)
    unit = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = covariance / np.outer(unit, unit)
    slack = 16 * len(mean) * np.finfo(covariance.dtype).eps
    where = list(names) or [f"coordinate {i}" for i in range(len(mean))]
    bad = ~np.isfinite(scaled) | (np.abs(scaled - scaled.T) > slack)
    if bad.any() or not np.isfinite(mean).all():
        i, j = np.argwhere(bad)[0] if bad.any() else [np.argmin(np.isfinite(mean))] * 2
        got = f"{covariance[i, j]:g} and {covariance[j, i]:g}, mean {mean[i]:g}"
        raise _no_covariance(f"{where[i]}, {where[j]}", got, "a symmetric matrix")
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < -slack:
        i = int(np.argmax(np.abs(vectors[:, 0])))
        got = f"a smallest eigenvalue of {values[0]:.3g}, of the correlations"
        raise _no_covariance(where[i], got, "none below zero")
    scale = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return Gaussian(jnp.asarray(mean), jnp.asarray(scale))


def of_mixture(
    weights: Float[np.ndarray, " k"],
    means: Float[np.ndarray, "k n"],
    scales: Float[np.ndarray, "k n q"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Mean and a scale of a mixture of ``N(mean, scale scale^T)``; weights sum to 1."""
    mean = weights @ means
    away = (means - mean)[:, None]
    rows = np.concatenate([np.swapaxes(scales, 1, 2), away], axis=1)
    rows = np.sqrt(weights)[:, None, None] * rows
    R = np.asarray(np.linalg.qr(rows.reshape(-1, rows.shape[2]), mode="r"))
    return mean, R.T


def _no_covariance(where: str, got: str, expected: str) -> InputError:
    return error("not_a_covariance", where=where, got=got, expected=expected)


def lower_factor(scale: Float[AnyArray, "n k"]) -> Float[AnyArray, "n n"]:
    """Lower-triangular L with ``L L^T = scale scale^T`` and non-negative diagonal."""
    return triangular(scale.T).T


def log_det_factor(L: Float[Array, "n n"]) -> Scalar:
    """``log |det L|`` of a triangular matrix."""
    return jnp.sum(jnp.log(jnp.abs(jnp.diag(L))))
