"""What every window of a fit says of the parameters alone: its pulls.

The windows' rows ``[J_e J_z r]`` are whitened by prior and noise, and the start state
``e`` is eliminated by a QR of each window's own. Long windows are few: what is left of
one is divided into blocks of successive rows, which share the start that was taken out.
How far the pulls scatter is asked by `sim2gp.identification.intervals.scatter`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp import checks
from sim2gp.data.windows import at_most
from sim2gp.data.windows_likelihood import (
    AnyWindows,
    WindowsLikelihood,
    linearise,
    together,
)
from sim2gp.inference.estimate import Estimate
from sim2gp.types import in_float64

#: Of more windows, successive ones are one: as many say how far they scatter. Numbers
#: that the factors of all may have (64 MiB): of hundreds of forces they are large.
MOST, ROOM = 4096, 2**23
#: Fewer windows are divided into so many blocks, none shorter than so many samples.
BLOCKS, SHORTEST = 10, 10


class SharedStarts(NamedTuple):
    """What blocks of one window have in common: the start that was taken out of all.

    ``onto`` are ``D = Q^T J`` of each block. ``Q`` are its rows of an orthonormal basis
    of what the start does, ``J`` those of its factor: in each ``window`` the ``D`` add
    up to nothing.
    """

    window: Int[np.ndarray, " V"]
    onto: Float[np.ndarray, "V n p"]


class WindowRows(NamedTuple):
    """Runs of windows linearised and whitened, start states eliminated.

    ``factors`` are rows ``[J_z r]`` of each run, every window from its best start,
    ``costs`` half their squared misfit there, one Gauss-Newton step from where the fit
    has put them. A run is one window, a block of one, or successive ones from ``first``
    on; ``starts`` is what blocks share.
    """

    factors: Float[np.ndarray, "V q p1"]
    costs: Float[np.ndarray, " V"]
    first: Int[np.ndarray, " V"]
    starts: SharedStarts | None = None

    @property
    def finite(self) -> bool:
        """Whether the simulation and its derivatives are."""
        return bool(np.isfinite(self.factors).all())

    @property
    def cost(self) -> float:
        """Of all windows; infinite where the simulation is not finite."""
        return float(np.sum(self.costs)) if self.finite else math.inf

    def in_runs(self, group: Int[np.ndarray, " V"], count: int) -> "WindowRows":
        """Joined by so many successive ones of one group."""
        if count == 1:
            return self
        edges = np.flatnonzero(np.diff(group)) + 1
        parts = pairwise([0, *edges.tolist(), len(group)])
        at = np.concatenate([np.arange(*part, count) for part in parts])
        k = self.factors.shape[2]
        factors = np.zeros((len(at), k, k))
        for run, rows in enumerate(np.split(self.factors, at[1:])):
            R = np.asarray(np.linalg.qr(rows.reshape(-1, k), mode="r"))
            factors[run, : len(R)] = R
        return WindowRows(factors, np.add.reduceat(self.costs, at), self.first[at])


@dataclass(frozen=True)
class Pulls:
    """What each window says of ``z`` alone, whitened by prior and noise.

    ``factors`` are square roots of ``F_w``, ``scores`` the gradients ``u_w`` of the
    cost where it was linearised, ``group`` numbers the recordings: windows of one
    follow each other. Of long windows each entry is a block; ``starts`` is what blocks
    of one share.
    """

    factors: Float[np.ndarray, "W k p"]
    scores: Float[np.ndarray, "W p"]
    group: Int[np.ndarray, " W"]
    starts: SharedStarts | None = None

    @property
    def rows(self) -> Float[np.ndarray, "Wk p"]:
        """The factors of all windows, stacked."""
        W, k, p = self.factors.shape
        return self.factors.reshape(W * k, p)

    @property
    def fisher(self) -> Float[np.ndarray, "p p"]:
        """``F``, of all windows together."""
        return self.rows.T @ self.rows

    def onto(self, T: Float[np.ndarray, "p k"]) -> "Pulls":
        """Those of ``c`` where ``z = T c``."""
        starts = self.starts and self.starts._replace(onto=self.starts.onto @ T)
        return Pulls(self.factors @ T, self.scores @ T, self.group, starts)

    def at(self, dz: Float[np.ndarray, " p"]) -> "Pulls":
        """The pulls where the parameters are ``dz`` further, for a linear machine."""
        more = np.einsum("wkp,wk->wp", self.factors, self.factors @ dz)
        return replace(self, scores=self.scores + more)


@in_float64
def pulls_of_windows(
    likelihood: AnyWindows, fitted: Estimate, group: Int[np.ndarray, " W"]
) -> Pulls:
    """Of a fit and its windows, start states eliminated; ``group`` numbers their logs.

    Raises `NotFinite` E203.
    """
    tt = fitted.posterior.mean
    return pulls_of_rows(rows_of(likelihood, fitted, tt, group), group)


def pulls_of_rows(rows: WindowRows, group: Int[np.ndarray, " W"]) -> Pulls:
    """Of runs of windows whose ``group`` is given; raises `NotFinite` E203."""
    R = rows.factors
    checks.finite_results("the intervals", "derivatives or residuals", R)
    scores = np.einsum("wkp,wk->wp", R[..., :-1], R[..., -1])
    return Pulls(R[..., :-1], scores, np.asarray(group)[rows.first], rows.starts)


def rows_of(
    likelihood: AnyWindows,
    fitted: Estimate,
    tt: Array,
    group: Int[np.ndarray, " W"],
) -> WindowRows:
    """The windows at virtual values ``tt``, from the starts of the fit.

    Some windows at a time, all as many: of hundreds of forces all derivatives at once
    are large. Of more windows than `MOST` runs of one ``group``, or than have `ROOM`;
    of more groups, successive ones are one. Of fewer than `BLOCKS`, blocks of each.
    """
    W, most = len(likelihood.windows), likelihood.windows.most
    runs = max(1, min(MOST, ROOM // (fitted.prior.mean.size + 1) ** 2))
    count, group = -(-W // runs), at_most(runs, np.asarray(group))
    measured = int(np.asarray(likelihood.counts).any(axis=1).sum())
    blocks = min(-(-BLOCKS // max(1, measured)), most // SHORTEST)
    size = -(-most // max(1, blocks)) * len(likelihood.windows.outputs)
    n = likelihood.windows.start.shape[1]
    found: list[WindowRows] = []
    run: list[WindowRows] = []  # where one has windows of several parts
    for own, part in likelihood.parts(together(likelihood.system, likelihood.windows)):
        known = fitted.some(np.resize(own, len(part.windows)))
        each = _whitened_rows(part, known, tt, most)[: len(own)], n, own
        some = _in_blocks(*each, size) if blocks > 1 else _whole(*each)
        run.append(some.in_runs(group[own], count))
        if own[-1] + 1 - run[0].first[0] >= count or own[-1] + 1 == W:
            rows = _joined(run)
            several = len(run) > 1
            found.append(rows.in_runs(group[rows.first], W) if several else rows)
            run = []
    return _joined(found)


def _joined(parts: Sequence[WindowRows]) -> WindowRows:
    factors, costs, first, starts = zip(*parts, strict=True)
    each = [np.concatenate(x) for x in (factors, costs, first)]
    shared = [x for x in starts if x is not None]
    if not shared:  # windows are whole in all parts or in none
        return WindowRows(each[0], each[1], each[2])
    window, onto = (np.concatenate(x) for x in zip(*shared, strict=True))
    return WindowRows(each[0], each[1], each[2], SharedStarts(window, onto))


def _whitened_rows(
    likelihood: WindowsLikelihood, fitted: Estimate, tt: Array, most: int
) -> Float[np.ndarray, "w r k"]:
    """``[J_e J_z r]`` of some windows; none has more than ``most`` measured rows.

    First the start's prior, whose residual is ``e``, then channels by row.
    """
    e, p = np.asarray(fitted.nuisances), fitted.prior.mean.size
    n = e.shape[1]
    found = linearise(likelihood, fitted, tt)
    measured = np.asarray(likelihood.windows.mask).any(axis=2)
    order = np.argsort(~measured, axis=1, kind="stable")[:, :most, None]
    r = np.take_along_axis(np.asarray(found.residual), order, axis=1)
    J = np.take_along_axis(np.asarray(found.jacobian), order[..., None], axis=1)
    weight = np.sqrt(np.asarray(fitted.noise.weights))[:, None, None]
    scale = weight / np.asarray(fitted.noise.sd)
    rows = np.concatenate([J[..., p:], J[..., :p], r[..., None]], axis=-1)
    rows *= scale[..., None]
    own = np.zeros((len(e), n, n + p + 1))
    own[..., :n], own[..., -1] = np.eye(n), e
    return np.concatenate([own, rows.reshape(len(e), -1, n + p + 1)], axis=1)


def _whole(
    rows: Float[np.ndarray, "w r k"], n: int, first: Int[np.ndarray, " w"]
) -> WindowRows:
    """Windows without their starts, the first ``n`` columns.

    A triangle has ``n`` rows fewer than a window: of very many short ones it matters.
    """
    if not np.isfinite(rows).all():
        return _nothing(rows, n, first)
    factors = np.asarray(np.linalg.qr(rows, mode="r"))[:, n:, n:]
    of_start = np.concatenate([rows[..., :n], rows[..., -1:]], axis=-1)
    rest = np.asarray(np.linalg.qr(of_start, mode="r"))[:, n:, n]
    return WindowRows(factors, 0.5 * np.sum(rest**2, axis=1), first)


def _nothing(
    rows: Float[np.ndarray, "w r k"], n: int, first: Int[np.ndarray, " w"]
) -> WindowRows:
    """Where a simulation is not finite."""
    w, r, k = rows.shape
    factors = np.full((w, min(r, k) - n, k - n), np.nan)
    return WindowRows(factors, np.full(w, np.nan), first)


def _in_blocks(
    rows: Float[np.ndarray, "w r k"], n: int, first: Int[np.ndarray, " w"], size: int
) -> WindowRows:
    """The same in blocks of ``size`` rows each, the start's prior in the first."""
    if not np.isfinite(rows).all():
        return _nothing(rows, n, first)
    Q = np.asarray(np.linalg.qr(rows[..., :n])[0])
    rest = rows[..., n:] - Q @ (np.swapaxes(Q, 1, 2) @ rows[..., n:])
    basis, rest = (_divided(x, n, size) for x in (Q, rest))
    onto = np.swapaxes(basis, 1, 2) @ rest[..., :-1]
    first = np.repeat(first, len(rest) // len(first))
    factors = np.asarray(np.linalg.qr(rest, mode="r"))
    costs = 0.5 * np.sum(rest[..., -1] ** 2, axis=1)
    return WindowRows(factors, costs, first, SharedStarts(first, onto))


def _divided(
    x: Float[np.ndarray, "w r k"], n: int, size: int
) -> Float[np.ndarray, "wb m k"]:
    """Blocks of windows, all as long; of all but the first the first ``n`` are zero."""
    w, r, k = x.shape
    count = -(-(r - n) // size)
    found = np.zeros((w, count, n + size, k))
    found[:, 0, :n] = x[:, :n]
    data = np.pad(x[:, n:], ((0, 0), (0, count * size + n - r), (0, 0)))
    found[:, :, n:] = data.reshape(w, count, size, k)
    return found.reshape(w * count, n + size, k)
