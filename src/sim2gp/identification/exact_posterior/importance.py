"""Is the posterior as Laplace says? Importance sampling against the exact one.

Draws ``z_i`` of Laplace's Gaussian ``q`` are weighted by the likelihood that the fit
descended, at the fit's noise,

    log w_i = log p(z_i | data) - log q(z_i),
    log p(z | data) = -min_e L(z, e) - sum_w log |R_w(z)| + const,

where the start states ``e`` of the windows are integrated by Laplace at every draw
(``R_w`` is the factor of their precision). The largest weights follow a generalised
Pareto law whose shape ``k`` says how many moments they have: below .5 the variance is
finite and the Gaussian is near the posterior, above .7 importance sampling itself fails
(Vehtari, Simpson, Gelman, Yao and Gabry 2024, J. Machine Learning Research 25). The
shape by Zhang and Stephens 2009 (Technometrics 51); smoothed weights give the exact
posterior's mean and sd, in sd of the Gaussian.
"""

import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.words import digits, finite_or_none, join_names
from sim2gp.inference.arrowhead import Noise, eliminate
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.types import Key, in_float64

DRAWS = 256
STEPS = 3  # of Gauss-Newton for the start states of a draw
FINE, STRAINED = 0.5, 0.7  # of k
MOVED, STRETCHED = 0.5, 1.5  # mean in sd, ratio of sds: beyond these, named
#: An sd below this many draws' worth of weights is not reported.
ENOUGH = 20.0


@dataclass(frozen=True)
class ImportanceCheck:
    """``shift`` and ``ratio`` are the exact mean and sd in those of the Gaussian.

    ``k`` is the shape of the weights' tail, ``draws`` the effective number of draws.
    """

    k: float
    draws: float
    shift: Float[np.ndarray, " p"]
    ratio: Float[np.ndarray, " p"]

    @property
    def verdict(self) -> str:
        """fine, strained, or not to be trusted.

        ``k`` sees a Gaussian that is too narrow; one that is too wide, as along a
        curved ridge, has light tails and other moments.
        """
        if not self.k <= STRAINED:
            return "not to be trusted"
        far = self.draws < ENOUGH or bool(np.any(self.far()))
        return "strained" if far or self.k > FINE else "fine"

    def far(self) -> Bool[np.ndarray, " p"]:
        """Parameters whose mean or sd differs from the Gaussian's."""
        return differs(self.shift, self.ratio)

    def as_dict(self, names: tuple[str, ...]) -> dict[str, Any]:
        """For summary.json; JSON has no infinity."""
        return {
            "verdict": self.verdict,
            "k": finite_or_none(self.k),
            "draws": self.draws,
            "text": self.words(names),
            "constants": moment_changes(names, self.shift, self.ratio),
        }

    def words(self, names: tuple[str, ...]) -> str:
        """What the check found, in a sentence or two."""
        head = f"Against the exact posterior Laplace's Gaussian is {self.verdict}"
        k = f"Pareto k {digits(self.k, 2)}"
        if not math.isfinite(self.k):
            k = "weights without end" if self.k > 0.0 else "all weights alike"
        text = f"{head} ({k}, {self.draws:.0f} effective draws of {DRAWS})"
        if self.draws < ENOUGH:
            return f"{text}: too few to say how it differs."
        shifts = describe_shifts(names, self.shift, self.ratio)
        return f"{text}; it differs in {join_names(shifts)}." if shifts else f"{text}."


def differs(
    shift: Float[np.ndarray, " p"], ratio: Float[np.ndarray, " p"]
) -> Bool[np.ndarray, " p"]:
    """Whether a mean or an sd is another than the Gaussian's; a NaN is."""
    same = (ratio > 1.0 / STRETCHED) & (ratio < STRETCHED)
    return ~(same & (np.abs(shift) <= MOVED))


def describe_shifts(
    names: tuple[str, ...],
    shift: Float[np.ndarray, " p"],
    ratio: Float[np.ndarray, " p"],
) -> list[str]:
    """The parameters that differ, and how."""
    return [
        f"{names[j]} (mean by {shift[j]:.1f} sd, sd times {ratio[j]:.2f})"
        for j in np.flatnonzero(differs(shift, ratio))
    ]


def moment_changes(
    names: tuple[str, ...],
    shift: Float[np.ndarray, " p"],
    ratio: Float[np.ndarray, " p"],
) -> dict[str, Any]:
    """Of all parameters, for summary.json."""
    return {
        name: {"shift": finite_or_none(s), "sd_ratio": finite_or_none(r)}
        for name, s, r in zip(names, shift, ratio, strict=True)
    }


def standardised_directions(posterior: Gaussian) -> Float[np.ndarray, "p p"]:
    """A row for each parameter: its direction among the standardised unknowns."""
    scale = np.asarray(posterior.scale)
    found: np.ndarray = scale / np.linalg.norm(scale, axis=1)[:, None]
    return found


@in_float64
def check_windows(
    likelihood: WindowsLikelihood, fitted: Estimate, *, key: Key
) -> ImportanceCheck:
    """Laplace's posterior of a fit against the exact one, given the fit's noise."""
    prior = ParameterPrior(fitted.prior, likelihood.system.parameters)
    z, e = fitted.z(), fitted.nuisances
    white = jax.random.normal(key, (DRAWS, z.size))
    scale = jnp.linalg.solve(fitted.prior.scale, fitted.posterior.scale)
    draws = z[None] + white @ scale.T
    found = _log_posterior(likelihood, prior, draws, e, fitted.noise)
    log_weights = np.asarray(found) + 0.5 * np.sum(np.asarray(white) ** 2, axis=1)
    unit = standardised_directions(fitted.posterior)
    return check_weights(log_weights, np.asarray(white) @ unit.T)


@eqx.filter_jit
def _log_posterior(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    draws: Float[Array, "S p"],
    e: Float[Array, "W n"],
    noise: Noise,
) -> Float[Array, " S"]:
    """Of each draw, the start states integrated around their best."""

    def one(z: Array) -> Array:
        offset, about = prior.rows(z)[:, -1], prior.gaussian

        def step(e: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            blocks = likelihood.blocks(about.at(z), e, about.scale)
            arrow = eliminate(blocks, e, noise)
            r = noise.scale(blocks)[..., -1]
            cost = 0.5 * (jnp.sum(r**2) + jnp.sum(e**2) + offset @ offset)
            pivots = jnp.diagonal(arrow.R11, axis1=1, axis2=2)
            return e - arrow.slope[..., -1], (cost, jnp.sum(jnp.log(pivots)))

        _, (cost, log_det) = jax.lax.scan(step, e, None, length=STEPS)
        best = jnp.argmin(jnp.where(jnp.isfinite(cost), cost, jnp.inf))
        return -cost[best] - log_det[best]

    found: Array = jax.lax.map(one, draws)
    return found


def check_weights(
    log_weights: Float[np.ndarray, " S"], draws: Float[np.ndarray, "S p"]
) -> ImportanceCheck:
    """Shape and moments; a draw at which nothing is finite has no weight.

    ``draws`` are in sd of the Gaussian, about its mean.
    """
    finite = np.isfinite(log_weights)
    log_weights = np.where(finite, log_weights, -np.inf)
    if not finite.any():
        nowhere = np.full(draws.shape[1], np.nan)
        return ImportanceCheck(math.inf, 0.0, nowhere, nowhere)
    smooth, k = pareto_smooth(log_weights)
    weight = np.exp(smooth - np.max(smooth))
    weight /= weight.sum()
    mean = weight @ draws
    sd = np.sqrt(weight @ (draws - mean) ** 2)
    own = np.sqrt(np.mean((draws - draws.mean(axis=0)) ** 2, axis=0))
    # Against the draws' own moments: what sampling moved moves both.
    return ImportanceCheck(
        k, float(1.0 / np.sum(weight**2)), mean - draws.mean(axis=0), sd / own
    )


def pareto_smooth(log_weights: Float[np.ndarray, " S"]) -> tuple[np.ndarray, float]:
    """Log weights with the largest at the quantiles of their Pareto law, and ``k``.

    Infinite where there is no tail of different weights to fit.
    """
    S = len(log_weights)
    count = min(S // 5, math.ceil(3.0 * math.sqrt(S)))
    order = np.argsort(log_weights)
    tail, below = order[S - count :], log_weights[order[S - count - 1]]
    x = log_weights - log_weights.max()
    cutoff = math.exp(below - log_weights.max())
    excess = np.exp(x[tail]) - cutoff
    if count < 5 or not np.all(excess > 0.0):
        same = float(np.ptp(log_weights)) < 1e-9
        return log_weights, -math.inf if same else math.inf
    k, sigma = pareto(excess)
    place = (np.arange(count) + 0.5) / count
    size = cutoff + _quantile(place, k, sigma)
    out = x.copy()
    out[tail] = np.minimum(np.log(size), 0.0)
    return out, k


def _quantile(p: np.ndarray, k: float, sigma: float) -> np.ndarray:
    if abs(k) < 1e-10:
        return np.asarray(-sigma * np.log1p(-p))
    return np.asarray(sigma / k * np.expm1(-k * np.log1p(-p)))


def pareto(x: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Shape and scale of a generalised Pareto law of rising positive ``x``.

    Zhang and Stephens' empirical Bayes estimate, the shape drawn to .5 with the weight
    of ten values as in Vehtari et al.
    """
    n = len(x)
    m = 30 + math.isqrt(n)
    quarter = x[max(int(n / 4 + 0.5) - 1, 0)]
    j = np.arange(1, m + 1)
    theta = 1.0 / x[-1] + (1.0 - np.sqrt(m / (j - 0.5))) / (3.0 * quarter)
    shape = np.mean(np.log1p(-theta[:, None] * x), axis=1)
    profile = n * (np.log(-theta / shape) - shape - 1.0)
    weight = np.exp(profile - profile.max())
    best = float(np.sum(weight * theta) / np.sum(weight))
    k = float(np.mean(np.log1p(-best * x)))
    return (n * k + 10.0 * 0.5) / (n + 10.0), -k / best
