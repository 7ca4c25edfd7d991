"""Draws of the exact posterior by NUTS, to hold Laplace's Gaussian against.

All unknowns of a fit are drawn, at its noise and weights: the parameters and the start
states of the windows,

    log p(z, e | data) = -L(z, e) + const,

in coordinates in which Laplace's joint Gaussian is standard normal,

    z = z* + R^-1 a,    e_w = e*_w - S_w (z - z*) + R_w^-1 b_w,

(``S_w`` and ``R_w``: slope and factor of `sim2gp.inference.arrowhead`), so that only
what is not Gaussian bends the paths. The gradient is ``J^T r`` of the linearisation
that the fit itself takes: simulators on the host are drawn from like those in JAX.

The sampler is BlackJAX's (extra ``mcmc``): Hoffman and Gelman 2014, J. Machine Learning
Research 15. Chains are trusted where split R-hat is at most 1.01 and the effective
draws suffice (Vehtari, Gelman, Simpson, Carpenter and Bürkner 2021, Bayesian Analysis
16).
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import missing_extra
from sim2gp.identification.exact_posterior.importance import (
    describe_shifts,
    differs,
    moment_changes,
    standardised_directions,
)
from sim2gp.identification.words import finite_or_none, join_names
from sim2gp.inference.arrowhead import Noise, eliminate
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.least_squares import stack
from sim2gp.inference.levenberg_marquardt import evaluate
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import solve_triangular
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.types import Key, in_float64

CHAINS, WARM_UP, DRAWS = 4, 200, 250  # draws of each chain
MIXED, ENOUGH = 1.01, 400.0  # split R-hat, effective draws


@dataclass(frozen=True)
class ChainSummary:
    """``shift`` and ``ratio`` are NUTS' mean and sd in those of the Gaussian.

    ``draws`` are effective ones, of the parameter that has the fewest; ``divergent``
    counts the paths that the sampler gave up.
    """

    shift: Float[np.ndarray, " p"]
    ratio: Float[np.ndarray, " p"]
    r_hat: float
    draws: float
    divergent: int

    @property
    def mixed(self) -> bool:
        """Whether the chains may be believed."""
        return self.r_hat <= MIXED and self.draws >= ENOUGH and self.divergent == 0

    def far(self) -> Bool[np.ndarray, " p"]:
        """Parameters whose mean or sd differs from the Gaussian's."""
        return differs(self.shift, self.ratio)

    def as_dict(self, names: tuple[str, ...]) -> dict[str, Any]:
        """For summary.json."""
        return {
            "mixed": self.mixed,
            "r_hat": finite_or_none(self.r_hat),
            "draws": finite_or_none(self.draws),
            "divergent": self.divergent,
            "text": self.words(names),
            "constants": moment_changes(names, self.shift, self.ratio),
        }

    def words(self, names: tuple[str, ...]) -> str:
        """What the chains found, in a sentence."""
        about = f"R-hat {self.r_hat:.3f}, {self.draws:.0f} effective draws"
        if not self.mixed:
            return (
                f"NUTS did not settle ({about}, {self.divergent} divergent): "
                "it says nothing of the Gaussian."
            )
        shifts = describe_shifts(names, self.shift, self.ratio)
        if shifts:
            return f"NUTS ({about}) differs from the Gaussian in {join_names(shifts)}."
        return f"NUTS ({about}) agrees with the Gaussian in every parameter."


def sampler() -> ModuleType:
    """BlackJAX (E135 without the extra ``mcmc``)."""
    try:
        import blackjax
    except ImportError as error:
        raise missing_extra("NUTS needs its sampler", error, "mcmc") from error
    found: ModuleType = blackjax
    return found


@in_float64
def sample_windows(
    likelihood: WindowsLikelihood, fitted: Estimate, *, key: Key
) -> ChainSummary:
    """The posterior of a fit by NUTS against Laplace's, given the fit's noise.

    Raises E135 without the extra ``mcmc``.
    """
    prior = ParameterPrior(fitted.prior, likelihood.system.parameters)
    at = fitted.z(), fitted.nuisances, fitted.noise
    draws, divergent = sample_posterior(likelihood, prior, *at, key)
    unit = standardised_directions(fitted.posterior)
    return summarise_chains(np.asarray(draws), np.asarray(divergent), unit)


def sample_posterior(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
    key: Key,
) -> tuple[Float[Array, "chains S p"], Bool[Array, "chains S"]]:
    """Draws of ``a`` about the MAP ``z, e``, and which paths diverged."""
    # Not the user's setting: the sampler adds integers to floats.
    with jax.numpy_dtype_promotion("standard"):
        found: tuple[Array, Array] = _chains(likelihood, prior, z, e, noise, key)
    return found


@eqx.filter_jit
def _chains(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
    key: Key,
) -> tuple[Array, Array]:
    blackjax = sampler()
    density = _log_density(likelihood, prior, z, e, noise)

    def chain(key: Key) -> tuple[Array, Array]:
        first, warm, rest = jax.random.split(key, 3)
        # Over-dispersed, so that chains which do not meet are seen.
        start = 1.5 * jax.random.normal(first, (z.size + e.size,))
        adaptation = blackjax.window_adaptation(blackjax.nuts, density)
        (state, tuned), _ = adaptation.run(warm, start, num_steps=WARM_UP)
        kernel = blackjax.nuts(density, **tuned)

        def step(state: Any, key: Key) -> tuple[Any, tuple[Array, Array]]:
            state, info = kernel.step(key, state)
            return state, (state.position[: z.size], info.is_divergent)

        found: tuple[Array, Array] = jax.lax.scan(
            step, state, jax.random.split(rest, DRAWS)
        )[1]
        return found

    # One after the other: side by side, each step waits for the longest path.
    found: tuple[Array, Array] = jax.lax.map(chain, jax.random.split(key, CHAINS))
    return found


def _log_density(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z0: Float[Array, " p"],
    e0: Float[Array, "W n"],
    noise: Noise,
) -> Callable[[Array], Array]:
    """``-L`` of the standardised unknowns, with the fit's own gradient."""
    here = evaluate(likelihood, prior, z0, e0, noise)
    arrow = eliminate(here.blocks, e0, noise)
    R = stack(arrow.data, here.prior)[:-1, :-1]

    @jax.custom_vjp
    def density(z: Array, e: Array) -> Array:
        return forward(z, e)[0]

    def forward(z: Array, e: Array) -> tuple[Array, tuple[Array, Array]]:
        at = evaluate(likelihood, prior, z, e, noise)
        return -at.cost, (at.by_z, at.by_e)

    def backward(by: tuple[Array, Array], g: Array) -> tuple[Array, Array]:
        return -g * by[0], -g * by[1]

    density.defvjp(forward, backward)

    def standardised(x: Array) -> Array:
        dz = solve_triangular(R, x[: z0.size])
        own = x[z0.size :].reshape(e0.shape)
        de = jax.vmap(solve_triangular)(arrow.R11, own) - arrow.slope[..., :-1] @ dz
        found: Array = density(z0 + dz, e0 + de)
        return found

    return standardised


@in_float64
def summarise_chains(
    draws: Float[np.ndarray, "chains S p"],
    divergent: Bool[np.ndarray, "chains S"],
    unit: Float[np.ndarray, "p p"],
) -> ChainSummary:
    """Moments per parameter, whose direction in ``a`` is its row of ``unit``."""
    from blackjax.diagnostics import effective_sample_size, potential_scale_reduction

    x = draws @ unit.T
    S = x.shape[1] // 2
    halves = np.concatenate([x[:, :S], x[:, S : 2 * S]])  # a drift splits a chain
    whole = x.reshape(-1, x.shape[-1])
    return ChainSummary(
        whole.mean(axis=0),
        whole.std(axis=0),
        float(np.max(potential_scale_reduction(halves))),
        float(np.min(effective_sample_size(x))),
        int(divergent.sum()),
    )
