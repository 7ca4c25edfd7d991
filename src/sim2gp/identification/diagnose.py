"""Which parameters the data determine, how well, and which combinations stay open.

Everything follows from four things that every belief about parameters has: the table,
the prior ``N(mu0, L0 L0^T)``, the posterior, and a factor ``A`` of the data's Fisher
information whitened by the prior,

    tt = mu0 + L0 z,      H = L0^T F L0 = A^T A = sum_k l_k v_k v_k^T,

so that ``l_k`` is what the data know of direction ``v_k`` in units of what the prior
knew: ``1/2 log(1 + l_k)`` nats. Verdicts compare sd of *virtual* values, where prior
and posterior are Gaussian; moments and quantiles are reported in physical units.
"""

from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from sim2gp.identification.identifiability.base_parameters import base_parameters
from sim2gp.identification.identifiability.conflicts import prior_conflicts
from sim2gp.identification.identifiability.directions import describe_directions
from sim2gp.identification.identifiability.spectrum import (
    FisherAt,
    Spectrum,
    spectrum,
)
from sim2gp.identification.identifiability.table import add_plain, parameter_entries
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.types import Key, in_float64

__all__ = [
    "FisherAt",
    "Spectrum",
    "arrays",
    "base_parameters",
    "describe_directions",
    "parameter_entries",
    "prior_conflicts",
    "spectrum",
    "summary",
]


@in_float64
def summary(
    parameters: Parameters,
    prior: Gaussian,
    posterior: Gaussian,
    information: Float[Array, "r p"],
    *,
    fisher_at: FisherAt | None = None,
    corrected: Gaussian | None = None,
) -> dict[str, Any]:
    """What summary.json says about the parameters, in physical units and in words.

    ``information`` is the factor ``A`` at the MAP; ``fisher_at(tt)`` the same factor at
    another virtual vector. It separates combinations that hold everywhere from those
    that hold at the MAP only ("locally"). With a ``corrected`` posterior
    (`identification.intervals.scatter`) all sd and intervals are its own, each
    parameter has those of the plain ``posterior`` under ``plain``, and ``widened`` is
    the ratio; what is flat or traded off follows from the Fisher information as ever.
    """
    known = posterior if corrected is None else corrected
    spec = spectrum(parameters, prior, known, information, at=posterior.mean)
    table = parameter_entries(spec)
    if corrected is not None:
        add_plain(table, parameters, posterior)
    return {
        "parameters": table,
        "rank": spec.rank,
        "directions": describe_directions(spec),
        "base_parameters": base_parameters(spec, fisher_at),
        "prior_conflicts": prior_conflicts(spec),
    }


@in_float64
def arrays(
    parameters: Parameters,
    prior: Gaussian,
    posterior: Gaussian,
    *,
    key: Key,
    count: int = 2000,
) -> dict[str, np.ndarray]:
    """Draws of prior and posterior in physical units, and posterior correlations.

    Correlations are those of the virtual values; the maps are increasing, so they are
    the physical ones wherever the posterior is narrow.
    """
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    scale = np.asarray(posterior.scale)
    unit = scale / np.linalg.norm(scale, axis=1, keepdims=True)
    return {
        "parameters/prior_samples": _physical(parameters, prior, rng, count),
        "parameters/samples": _physical(parameters, posterior, rng, count),
        "parameters/correlation": np.clip(unit @ unit.T, -1.0, 1.0),
    }


def _physical(
    parameters: Parameters, gaussian: Gaussian, rng: np.random.Generator, count: int
) -> Float[np.ndarray, "draws p"]:
    """Draws of the parameters in their units."""
    mean, scale = np.asarray(gaussian.mean), np.asarray(gaussian.scale)
    return parameters.constrain(
        mean + rng.normal(size=(count, scale.shape[1])) @ scale.T
    )
