"""The data's Fisher information in the prior's own units, and its flat directions.

With ``A`` a factor of the whitened Fisher (``H = A^T A``) and ``u_k = L0 v_k`` over the
prior sd, row by row,

    flat      l_k < 1: the prior knows more of this direction than the data do
    rank      singular values of A above 1e-8 of the largest
    P         = sum over flat of u_k u_k^T;   share w_j = P_jj
    tie_ij    = P_ij^2 / P_jj

``tie_ij`` is the share of parameter ``i`` in the flat direction that moves ``j`` most.
For one flat direction it is ``u_i^2``; for several it does not depend on which basis of
an (often degenerate) flat space the decomposition returned.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import RANK_TOLERANCE
from sim2gp.inference.parameters import Parameters
from sim2gp.types import in_float64

#: Virtual parameters -> factor of the data's Fisher there, whitened by the prior.
FisherAt = Callable[[Array], Array]
#: Verdicts: shares of the prior sd that leave a quantity the prior's, or the data's.
DOMINATED, IDENTIFIED = 0.5, 0.2
_ROUNDING = 1e-13  # a sum of terms this much smaller than they are is zero


class Spectrum(eqx.Module):
    """Prior, posterior and Fisher of one table of parameters, decomposed."""

    parameters: Parameters
    prior_mean: Float[np.ndarray, " p"]  # virtual, as all but `theta` and `slope`
    prior_scale: Float[np.ndarray, "p p"]
    prior_sd: Float[np.ndarray, " p"]
    at: Float[np.ndarray, " p"]  # the MAP, where all is linearised
    mean: Float[np.ndarray, " p"]  # of what is known, as `scale` and `sd`
    scale: Float[np.ndarray, "p k"]
    sd: Float[np.ndarray, " p"]
    theta: Float[np.ndarray, " p"]  # physical MAP
    slope: Float[np.ndarray, " p"]  # dtheta/dtt at the MAP
    factor: Float[np.ndarray, "r p"]
    eigenvalues: Float[np.ndarray, " p"]  # l, falling
    directions: Float[np.ndarray, "p p"]  # v_k in columns
    dead: Bool[np.ndarray, " p"]  # zero columns: the data do not depend on them
    rank: int = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free parameters."""
        return self.parameters.names

    @property
    def flat(self) -> Bool[np.ndarray, " p"]:
        """Directions of which the prior knows more than the data."""
        return self.eigenvalues < 1.0

    @property
    def null(self) -> Bool[np.ndarray, " p"]:
        """Directions of which the data know nothing at all."""
        return np.arange(len(self.eigenvalues)) >= self.rank

    def standardised(self) -> Float[np.ndarray, "p p"]:
        """``u_k`` in columns: moves along ``v_k`` in prior sd of each parameter."""
        return self.prior_scale @ self.directions / self.prior_sd[:, None]

    def projection(self, which: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
        """``P`` over the chosen directions."""
        u = self.standardised()[:, which]
        return u @ u.T

    def whitened(self) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p k"]]:
        """Posterior mean and scale of ``z``."""
        z = np.linalg.solve(self.prior_scale, self.mean - self.prior_mean)
        return z, np.linalg.solve(self.prior_scale, self.scale)


@in_float64
def spectrum(
    parameters: Parameters,
    prior: Gaussian,
    posterior: Gaussian,
    information: Float[Array, "r p"],
    *,
    at: Float[Array, " p"] | None = None,
) -> Spectrum:
    """Decompose the information factor; the prior's scale must be square.

    ``at`` is the MAP, where it is not the posterior's mean.
    """
    A, L0 = np.asarray(information), np.asarray(prior.scale)
    p = len(parameters)
    s, V = _right_singular(A)
    # A direction has no sign: let what it measures start with plus.
    weights = np.linalg.solve(L0.T, V) * np.sqrt(np.sum(L0**2, axis=1))[:, None]
    V = V * np.where(_largest_entries(weights) < 0.0, -1.0, 1.0)
    tt = np.asarray(posterior.mean if at is None else at)
    theta, slope = values_and_slopes(parameters, tt)
    return Spectrum(
        parameters,
        np.asarray(prior.mean),
        L0,
        np.sqrt(np.sum(L0**2, axis=1)),
        tt,
        np.asarray(posterior.mean),
        np.asarray(posterior.scale),
        np.linalg.norm(np.asarray(posterior.scale), axis=1),
        theta,
        slope,
        A,
        s**2,
        V,
        zero_columns(A, L0) if p else np.zeros(0, bool),
        _rank(s),
    )


def values_and_slopes(
    parameters: Parameters, tt: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Physical values and their slopes ``dtheta/dtt``."""
    tt = np.asarray(tt, float)
    return parameters.constrain(tt), parameters.slopes(tt)[0]


def virtual_columns(
    A: Float[np.ndarray, "r p"], L0: Float[np.ndarray, "p p"]
) -> Float[np.ndarray, "r p"]:
    """``A L0^-1``: the factor per unit of virtual parameter."""
    return np.linalg.solve(L0.T, A.T).T


def zero_columns(
    A: Float[np.ndarray, "r p"], L0: Float[np.ndarray, "p p"]
) -> Bool[np.ndarray, " p"]:
    """Parameters without any effect: exact zeros, up to a correlated prior's rounding.

    No threshold on size: a small effect is weak, which is another verdict.
    """
    inverse = np.linalg.solve(L0, np.eye(len(L0)))
    terms = np.abs(A) @ np.abs(inverse)
    return np.all(np.abs(virtual_columns(A, L0)) <= _ROUNDING * terms, axis=0)


def null_space(A: Float[np.ndarray, "r q"]) -> Float[np.ndarray, "q k"]:
    """Orthonormal basis of the directions below the structural rank."""
    s, V = _right_singular(A)
    return V[:, _rank(s) :]


def _right_singular(
    A: Float[np.ndarray, "r q"],
) -> tuple[Float[np.ndarray, " q"], Float[np.ndarray, "q q"]]:
    """All right singular vectors; missing rows count as singular values of zero."""
    q = A.shape[1]
    if q == 0:
        return np.zeros(0), np.zeros((0, 0))
    s, Vt = np.linalg.svd(A, full_matrices=True)[1:]
    return np.concatenate([s, np.zeros(q - len(s))]), Vt.T


def _largest_entries(columns: Float[np.ndarray, "p k"]) -> Float[np.ndarray, " k"]:
    """The largest entry of every column, the first of those equal up to rounding."""
    sizes = np.abs(columns)
    first = np.argmax(sizes > (1.0 - 1e-6) * sizes.max(axis=0, initial=0.0), axis=0)
    return np.take_along_axis(columns, first[None], axis=0)[0]


def _rank(s: Float[np.ndarray, " q"]) -> int:
    return int(np.sum(s > RANK_TOLERANCE * s.max(initial=0.0)))
