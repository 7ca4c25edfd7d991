"""The structural null space, in coordinates where it is a short and constant list.

At a virtual vector ``tt`` the data are blind to moves ``dtt`` with ``A L0^-1 dtt = 0``.
In coordinates ``phi`` (``theta`` itself, or ``log theta`` where all are positive) these
are ``dphi = dphi/dtt dtt``, the columns of ``N``. Reduced so that chosen *pivots* carry
the identity, ``N = [I; C]``, each column is one trade-off, and each row of

    phi_i - sum_j C_ij phi_pivot_j

is orthogonal to all of them: a base parameter. Parameters that no null direction
connects form separate blocks, each with its own coordinates.
"""

import itertools
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Bool, Float
from scipy.sparse.csgraph import connected_components

from sim2gp.identification.identifiability.spectrum import (
    FisherAt,
    Spectrum,
    null_space,
    values_and_slopes,
    zero_columns,
)

Kind = Literal["linear", "log"]
_TOUCHED = 1e-6  # components of a null direction below this are rounding
_SAME = 1e-6  # principal angle at which two null spaces are the same
_SPREAD = 0.5  # prior sd between the MAP and the points where constancy is tested
_POINTS = 4
_CANDIDATES = 600  # pivot sets tried
_DEGENERATE = 1e-4  # volume of orthonormal directions, seen in the pivots alone


class NullSpacePoint(eqx.Module):
    """The null space at one virtual vector, in prior sd of every parameter."""

    theta: Float[np.ndarray, " p"]
    slope: Float[np.ndarray, " p"]
    null: Float[np.ndarray, "p k"]


class Block(eqx.Module):
    """Parameters tied by null directions, seen at the MAP (first) and elsewhere."""

    index: np.ndarray
    points: tuple[NullSpacePoint, ...]
    scale: Float[np.ndarray, " q"]  # physical prior sd, linearised at the MAP
    share: Float[np.ndarray, " q"]  # of each parameter's prior variance that is null
    positive: bool = eqx.field(static=True)

    def basis(self, kind: Kind, point: NullSpacePoint) -> Float[np.ndarray, "q k"]:
        """Orthonormal null directions in scaled coordinates."""
        size = point.slope / self.points[0].slope
        if kind == "log":
            size = size * self.scale / point.theta
        return _column_space(size[:, None] * point.null)

    def union(self, kind: Kind) -> Float[np.ndarray, "q u"]:
        """All directions that are null at any of the points."""
        return _column_space(np.hstack([self.basis(kind, x) for x in self.points]))

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Coordinates that these parameters allow."""
        return ("linear", "log") if self.positive else ("linear",)


class Reduced(eqx.Module):
    """``N = [I; C]``: trade-offs in columns, per unit of each pivot's coordinate."""

    pivots: tuple[int, ...] = eqx.field(static=True)
    columns: Float[np.ndarray, "q k"]
    unrecognised: int = eqx.field(static=True)

    def covectors(self) -> dict[int, Float[np.ndarray, " q"]]:
        """What each remaining parameter must be combined with; lone ones left out."""
        out = {}
        for i in range(len(self.columns)):
            if i not in self.pivots and np.any(self.columns[i] != 0.0):
                row = np.zeros(len(self.columns))
                row[i] = 1.0
                row[list(self.pivots)] = -self.columns[i]
                out[i] = row
        return out


def blocks(spec: Spectrum, fisher_at: FisherAt | None = None) -> list[Block]:
    """The live parameters that structurally null directions touch, block by block."""
    points = [_null_space_at(spec, spec.at, spec.factor, spec.dead)]
    k = points[0].null.shape[1]
    if k == 0:
        return []
    if fisher_at is not None:
        points += _elsewhere(spec, fisher_at, k)
    # A tie at any point is a tie: their union alone would look like separate axes.
    P = np.stack([x.null @ x.null.T for x in points])
    touched = np.flatnonzero(np.any(np.diagonal(P, 0, 1, 2) > _TOUCHED**2, axis=0))
    tied = np.any(np.abs(P) > _TOUCHED**2, axis=0)
    labels = connected_components(tied[np.ix_(touched, touched)], directed=False)[1]
    return [_block(spec, points, touched[labels == n]) for n in np.unique(labels)]


def reduce(
    N: Float[np.ndarray, "q k"],
    kind: Kind,
    scale: Float[np.ndarray, " q"],
    share: Float[np.ndarray, " q"],
) -> Reduced:
    """The reduced form whose coefficients read best.

    Tried are all sets of pivots (a few hundred at most): first round coefficients, then
    few of them, then sums rather than differences, then the pivots that the data
    leave most open (``share``).
    """
    q, k = N.shape
    best: tuple[tuple, Reduced] | None = None
    surest = tuple(
        sorted(scipy.linalg.qr(N.T, mode="r", pivoting=True)[1][:k].tolist())
    )
    tried = itertools.islice(itertools.combinations(range(q), k), _CANDIDATES)
    for pivots in (*tried, surest):
        square = N[list(pivots)]
        if pivots != surest and abs(np.linalg.det(square)) < _DEGENERATE:
            continue
        C = np.linalg.solve(square.T, N.T).T
        C[np.abs(C) < _TOUCHED] = 0.0
        units = scale if kind == "linear" else np.ones(q)
        C = C * units[:, None] / units[None, list(pivots)]
        C, unknown = _recognise(C, kind)
        C[list(pivots)] = np.eye(k)
        others = [i for i in range(q) if i not in pivots]
        differences = int(np.sum(C[others] > 0.0)) if kind == "linear" else 0
        nonzero = int(np.count_nonzero(C[others]))
        score = (
            unknown,
            nonzero,
            differences,
            -round(float(share[list(pivots)].sum()), 6),
        )
        if best is None or score < best[0]:
            best = score, Reduced(pivots, C, unknown)
    assert best is not None
    return best[1]


def _block(
    spec: Spectrum, points: Sequence[NullSpacePoint], index: np.ndarray
) -> Block:
    free = [spec.parameters.free[j] for j in index]
    positive = all(p.low >= 0.0 or p.map == "log" for p in free)
    positive = positive and all(bool(np.all(x.theta[index] > 0.0)) for x in points)
    seen = tuple(
        NullSpacePoint(x.theta[index], x.slope[index], _column_space(x.null[index]))
        for x in points
    )
    scale = (spec.slope * spec.prior_sd)[index]
    return Block(index, seen, scale, np.sum(seen[0].null ** 2, axis=1), positive)


def _null_space_at(
    spec: Spectrum,
    tt: Float[np.ndarray, " p"],
    A: Float[np.ndarray, "r p"],
    dead: Bool[np.ndarray, " p"],
) -> NullSpacePoint:
    theta, slope = values_and_slopes(spec.parameters, tt)
    null = spec.prior_scale @ null_space(A) / spec.prior_sd[:, None]
    # The unit vectors of dead parameters are null too; what remains is without them.
    return NullSpacePoint(
        theta, slope, _column_space(np.where(dead[:, None], 0.0, null))
    )


def _elsewhere(spec: Spectrum, fisher_at: FisherAt, k: int) -> list[NullSpacePoint]:
    """Points around the MAP where the simulation is finite and as blind as there."""
    normal = np.random.default_rng(0).standard_normal((_POINTS, len(spec.mean)))
    points = []
    for eps in normal:
        tt = spec.at + _SPREAD * spec.prior_scale @ eps
        A = np.asarray(fisher_at(jnp.asarray(tt, float)))
        if not np.all(np.isfinite(A)):
            continue
        point = _null_space_at(
            spec, tt, A, spec.dead | zero_columns(A, spec.prior_scale)
        )
        if point.null.shape[1] == k:
            points.append(point)
    return points


def _column_space(N: Float[np.ndarray, "q k"]) -> Float[np.ndarray, "q u"]:
    """Orthonormal basis of the column space, columns counted at unit length."""
    length = np.linalg.norm(N, axis=0)
    N = N[:, length > _TOUCHED] / length[length > _TOUCHED]
    if N.shape[1] == 0:
        return N
    U, s, _ = np.linalg.svd(N, full_matrices=False)
    return U[:, s > _SAME * s[0]]


def _recognise(
    C: Float[np.ndarray, "q k"], kind: Kind
) -> tuple[Float[np.ndarray, "q k"], int]:
    """Coefficients rounded where they are round, and how many are not.

    Round is a decimal of three digits in a sum, a multiple of 1/2 or 1/3 in an
    exponent; that a coefficient is so by chance has odds of about 1 to 500.
    """
    out, unknown = C.copy(), 0
    for at, c in np.ndenumerate(C):
        near = round(6.0 * c) / 6.0 if kind == "log" else float(f"{c:.3g}")
        if abs(near - c) <= 1e-6 * abs(c):
            out[at] = near
        else:
            unknown += 1
    return out, unknown
