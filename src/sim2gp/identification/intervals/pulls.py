"""What every window of a fit says of the parameters alone: its pulls.

The windows' rows ``[J_e J_z r]``, whitened by prior and noise, the start state ``e``
eliminated by a QR of each window's own. `sim2gp.identification.intervals.scatter` asks
how far the pulls scatter.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood, linearise
from sim2gp.identification.misfit.tests import must_be_finite
from sim2gp.inference.estimate import Estimate
from sim2gp.types import in_float64

#: Derivatives that a simulator on the host has in memory at once (256 MiB).
TOGETHER = 2**25


@dataclass(frozen=True)
class Pulls:
    """What each window says of ``z`` alone, whitened by prior and noise.

    ``factors`` are square roots of ``F_w``, ``scores`` the gradients ``u_w`` of the
    cost where it was linearised, ``group`` numbers the recordings: windows of one
    follow each other.
    """

    factors: Float[np.ndarray, "W k p"]
    scores: Float[np.ndarray, "W p"]
    group: Int[np.ndarray, " W"]

    @property
    def fisher(self) -> Float[np.ndarray, "W p p"]:
        """``F_w``."""
        return np.swapaxes(self.factors, 1, 2) @ self.factors

    def onto(self, T: Float[np.ndarray, "p k"]) -> "Pulls":
        """Those of ``c`` where ``z = T c``."""
        return Pulls(self.factors @ T, self.scores @ T, self.group)

    def at(self, dz: Float[np.ndarray, " p"]) -> "Pulls":
        """The pulls where the parameters are ``dz`` further, for a linear machine."""
        return Pulls(self.factors, self.scores + self.fisher @ dz, self.group)


@in_float64
def pulls_of_windows(
    likelihood: WindowsLikelihood, fitted: Estimate, group: Int[np.ndarray, " W"]
) -> Pulls:
    """Of a fit and its windows, start states eliminated; ``group`` numbers their logs.

    Raises `NotFinite` E203.
    """
    rows = rows_of(likelihood, fitted, fitted.posterior.mean)
    return pulls_of_rows(rows, likelihood.windows, group)


def pulls_of_rows(
    rows: Float[np.ndarray, "W k npr"], cut: Windows, group: Int[np.ndarray, " W"]
) -> Pulls:
    """Of rows `rows_of`; raises `NotFinite` E203."""
    R = without_starts(rows, cut)
    scores = np.einsum("wkp,wk->wp", R[..., :-1], R[..., -1])
    return Pulls(R[..., :-1], scores, np.asarray(group))


def without_starts(
    rows: Float[np.ndarray, "W k npr"], cut: Windows
) -> Float[np.ndarray, "W q pr"]:
    """Rows ``[J_z r]`` of each window from its best start, of rows `rows_of`.

    Raises `NotFinite` E203.
    """
    must_be_finite("derivatives or residuals", rows, "the intervals")
    n = cut.start.shape[1]
    return np.asarray(np.linalg.qr(rows, mode="r"))[:, n:, n:]


def cost_of_rows(rows: Float[np.ndarray, "W k npr"], cut: Windows) -> float:
    """Half the windows' squared misfit of rows `rows_of`, each from its best start.

    Starts follow by one Gauss-Newton step from where the fit has put them. Infinite
    where the simulation is not finite.
    """
    if not np.isfinite(rows).all():
        return math.inf
    n = cut.start.shape[1]
    both = np.concatenate([rows[..., :n], rows[..., -1:]], axis=-1)
    R = np.asarray(np.linalg.qr(both, mode="r"))
    return 0.5 * float(np.sum(R[:, n:, n] ** 2))


def rows_of(
    likelihood: WindowsLikelihood, fitted: Estimate, tt: Array
) -> Float[np.ndarray, "W k npr"]:
    """Of each window ``[J_e J_z r]``, whitened, the start's prior in its last rows.

    Rows that nothing measures are left out. A simulator on the host is asked for some
    windows at a time: of hundreds of forces all derivatives at once are large.
    """
    (W, L), n = likelihood.windows.span.shape, fitted.nuisances.shape[1]
    one = L * n * (n + len(fitted.prior.mean))
    size = max(1, TOGETHER // one) if likelihood.on_host else W
    parts = (np.arange(k, min(k + size, W)) for k in range(0, W, size))
    most = int(np.asarray(likelihood.windows.mask).any(axis=2).sum(axis=1).max())
    return np.concatenate([_some_rows(likelihood, fitted, tt, i, most) for i in parts])


def _some_rows(
    likelihood: WindowsLikelihood,
    fitted: Estimate,
    tt: Array,
    which: Int[np.ndarray, " w"],
    most: int,
) -> Float[np.ndarray, "w k npr"]:
    """`rows_of` of some windows, of which none has more than ``most`` measured rows."""
    if len(which) < len(fitted.nuisances):
        likelihood = likelihood.some(which)
        fitted = _some(fitted, which)
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
    return np.concatenate([rows.reshape(len(e), -1, n + p + 1), own], axis=1)


def _some(fitted: Estimate, which: Int[np.ndarray, " w"]) -> Estimate:
    """What an estimate says of some of its windows."""
    noise = replace(fitted.noise, weights=fitted.noise.weights[which])
    of_windows = {"nuisances": fitted.nuisances[which], "scores": fitted.scores[which]}
    return replace(fitted, noise=noise, **of_windows)
