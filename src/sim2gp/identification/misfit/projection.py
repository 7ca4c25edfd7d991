"""Residuals of a fit, projected on what it could not move."""

from collections.abc import Callable
from functools import cached_property
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import fdtrc

from sim2gp.inference.least_squares import RANK_TOLERANCE

SPARE = 5  # degrees of freedom that must be left for each one that is tested
#: Residuals below a tenth of the noise are rounding or the prior's pull, not misfit.
QUIET = 0.1
FEATURE_TOLERANCE = 1e-6
ROWS = 8192  # that are eliminated at once

Columns = Float[np.ndarray, "N d _"]


class ProjectedResiduals:
    """Residuals free of all that the fit could move; ``d`` channels in ``N`` rows."""

    def __init__(
        self,
        r: Columns,
        J: Columns,
        own: Columns,
        run: Int[np.ndarray, " N"],
        valid: Bool[np.ndarray, "N d"],
    ) -> None:
        self.r, self.J, self.own, self.run, self.valid = r, J, own, run, valid
        self.first = np.flatnonzero(np.diff(run, prepend=-1))  # rows of the groups
        self.own_basis, self.own_rank = _grouped_basis(own, self.first)
        flat = self._without_own(J).reshape(-1, J.shape[2])
        self.basis, self.size = _orthonormal_basis(flat)
        self.e = self.without(r)[..., 0]
        self.count = int(valid.sum())
        self.freedom = self.count - self.own_rank - self.basis.shape[1]

    @cached_property
    def hat(self) -> Columns:
        """Rows ``H`` with ``P = H H^T`` inside a group."""
        N, d = self.valid.shape
        fitted = self.basis.reshape(N, d, self.basis.shape[1])
        return np.concatenate([self.own_basis, fitted], axis=2)

    def _without_own(self, A: Columns) -> Columns:
        """``A`` minus its projection on the nuisances of each group."""
        own = self.own_basis
        if own.shape[2] == 0:
            return A
        found = np.empty_like(A)
        for j in range(A.shape[2]):  # all products at once are several times ``A``
            products = np.einsum("ndi,nd->ni", own, A[..., j])
            sums = np.add.reduceat(products, self.first, axis=0)[self.run]
            found[..., j] = A[..., j] - np.einsum("ndi,ni->nd", own, sums)
        return found

    def without(self, A: Columns) -> Columns:
        """``(I - P) A``."""
        A = np.where(self.valid[..., None], A, 0.0)
        flat = self._without_own(A).reshape(-1, A.shape[2])
        for _ in range(2):  # the second pass removes the first one's rounding
            flat = flat - self.basis @ (self.basis.T @ flat)
        return flat.reshape(A.shape)

    def rms(self) -> Float[np.ndarray, " d"]:
        """Of each channel's residuals, with the degrees of freedom left to it."""
        left = self.valid.sum(axis=0) - np.sum(self.hat**2, axis=(0, 2))
        return np.sqrt(np.sum(self.e**2, axis=0) / np.maximum(left, 1.0))

    def in_units_of(self, scale: Float[np.ndarray, " d"]) -> "ProjectedResiduals":
        """The same with each channel's noise at ``scale``, but never below QUIET."""
        unit = np.maximum(scale, QUIET)[None, :, None]
        return ProjectedResiduals(
            self.r / unit, self.J / unit, self.own / unit, self.run, self.valid
        )

    def explains(
        self, count: int, column: Callable[[int], Float[np.ndarray, "N d"]]
    ) -> tuple[float, int, float]:
        """F ratio, degrees of freedom, p value of ``count`` further columns.

        NaN if they are too many. They are made and projected one by one: of a long log
        all at once, with what their projection takes, need several times the memory.
        """
        flat, size = np.empty((self.e.size, count), order="F"), 0.0
        for j in range(count):
            new = column(j)
            size = max(size, float(np.linalg.norm(new)))
            flat[:, j] = self.without(new[..., None]).reshape(-1)
        e = self.e.reshape(-1)
        gains = _gains(flat, e, FEATURE_TOLERANCE * size)
        q = gains.size
        rest = self.freedom - q
        if q == 0 or rest < SPARE * q:
            return np.nan, q, np.nan
        gained = float(np.sum(gains**2))
        # The floor holds where all residuals are below QUIET, or all are explained.
        noise = max((float(e @ e) - gained) / rest, 0.25)
        ratio = gained / q / noise
        return ratio, q, float(fdtrc(q, rest, ratio))


def _orthonormal_basis(
    A: Float[np.ndarray, "M c"],
) -> tuple[Float[np.ndarray, "M q"], Float[np.ndarray, " q"]]:
    """Orthonormal columns that span ``A``'s (`RANK_TOLERANCE`), and singular values."""
    U, s, _ = np.linalg.svd(A, full_matrices=False)
    kept = s > RANK_TOLERANCE * np.max(s, initial=0.0)
    return U[:, kept], s[kept]


def _gains(
    A: Float[np.ndarray, "M c"], e: Float[np.ndarray, " M"], limit: float
) -> Float[np.ndarray, " q"]:
    """``U^T e``, of the left singular vectors of ``A`` with a value above ``limit``.

    From the triangle of ``A``, of which some rows after the others are eliminated: its
    vectors, as long as the data, are not formed.
    """
    c = A.shape[1]
    R = np.zeros((0, c + 1))
    for i in range(0, len(A), ROWS):
        rows = np.column_stack([A[i : i + ROWS], e[i : i + ROWS]])
        R = np.asarray(np.linalg.qr(np.concatenate([R, rows]), mode="r"))
    U, s, _ = np.linalg.svd(R[:c, :c], full_matrices=False)
    return np.asarray((U.T @ R[:c, c])[s > limit])


def _grouped_basis(own: Columns, first: Int[np.ndarray, " G"]) -> tuple[Columns, int]:
    """An orthonormal basis of each group's own columns, in its rows; and all ranks."""
    basis, rank = np.zeros_like(own), 0
    if own.shape[2] == 0 or not own.any():
        return own[..., :0], 0
    for i, j in pairwise([*first.tolist(), len(own)]):
        U, _ = _orthonormal_basis(own[i:j].reshape(-1, own.shape[2]))
        basis[i:j, :, : U.shape[1]] = U.reshape(j - i, own.shape[1], -1)
        rank += U.shape[1]
    return basis, rank
