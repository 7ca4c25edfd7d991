"""Which parameters to open: those whose effect no others can take over.

``J`` has, for each parameter, the change of all predictions in noise sd that one prior
sd of it makes; what start states and nuisances (delays) can take over is projected out.
QR with column pivoting takes the largest effect first, then the largest of what is left
of the others, and so on:

    J P = Q [ R11  R12 ]        |R_kk|: effect of parameter k after all before it,
            [  0   R22 ]        root of the sum of squares over the data.

From the first ``|R_kk| < SILENT`` on, parameters are held. A held parameter that is one
prior sd away changes the predictions of all the data together by less than `SILENT`
noise sd, once the open ones have moved by ``C = R11^-1 R12``. So they represent the
base parameters

    z_i + sum_j C_ij z_j        i open, j held

(Gautier, "Numerical calculation of the base inertial parameters of robots", Journal of
Robotic Systems 8(4), 1991, where R22 is zero up to rounding.)
"""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from sim2gp.identification.identifiability.spectrum import (
    values_and_slopes,
    virtual_columns,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.least_squares import over, stack
from sim2gp.inference.parameters import Parameters
from sim2gp.types import in_float64

SILENT = 0.05  # noise sd, over all of the data
#: Posterior sd by which a held parameter, one prior sd away, moves an open one: less is
#: not reported.
MOVED = 0.1


class Selection(NamedTuple):
    """What to open and what to hold.

    held: of each parameter, the share of its prior sd that the data leave where all are
        open.
    stands_for: of an open parameter, the held ones that it takes over, each with its
        weight in ``open + sum weight held`` (physical units, about the prior's mean).
    """

    held: Mapping[str, float]
    stands_for: Mapping[str, Mapping[str, float]]


@in_float64
def select_parameters(
    parameters: Parameters,
    prior: Gaussian,
    information: Float[Array, "r p"],
    *,
    nuisances: Collection[str] = (),
) -> Selection:
    """Hold the parameters that the data cannot separate from the rest.

    ``information`` is the factor of the data's Fisher, whitened by the prior, about the
    prior's mean; ``nuisances`` are free parameters that are never held. Nothing is held
    where the data determine no parameter at all.
    """
    A, L0 = np.asarray(information), np.asarray(prior.scale)
    sd = np.asarray(prior.sd())
    J = virtual_columns(A, L0) * sd
    known = [name in nuisances for name in parameters.names]
    first, rest = np.flatnonzero(known), np.flatnonzero(np.logical_not(known))
    taken = scipy.linalg.orth(J[:, first]) if first.size else J[:, :0]
    own = J[:, rest] - taken @ (taken.T @ J[:, rest])
    R, order = scipy.linalg.qr(own, mode="r", pivoting=True)
    open_ = int(np.sum(np.abs(np.diag(R)) >= SILENT))
    if open_ == 0:
        return Selection({}, {})
    C = scipy.linalg.solve_triangular(R[:open_, :open_], R[:open_, open_:])
    kept, held = rest[order[:open_]], rest[order[open_:]]
    left = _posterior_sd(J)
    after = _posterior_sd(J[:, np.concatenate([kept, first])])[:open_]
    _, slope = values_and_slopes(parameters, np.asarray(prior.mean))
    size = slope * sd
    stands_for: dict[str, dict[str, float]] = {}
    for i, j in np.argwhere(np.abs(C) > MOVED * after[:, None]):
        name = parameters.names[kept[i]]
        weight = float(C[i, j] * size[kept[i]] / size[held[j]])
        stands_for.setdefault(name, {})[parameters.names[held[j]]] = weight
    shares = {parameters.names[j]: float(left[j]) for j in np.sort(held)}
    return Selection(shares, stands_for)


def _posterior_sd(J: Float[np.ndarray, "r q"]) -> Float[np.ndarray, " q"]:
    """Posterior sd in prior sd, of independent priors."""
    eye = np.eye(J.shape[1])
    return np.asarray(np.linalg.norm(over(eye, stack(J, eye)), axis=1))
