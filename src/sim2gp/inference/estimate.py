"""The one fit: the MAP, the noise by EM, and Laplace's posterior about it.

A likelihood (`AbstractLikelihood`) and a prior (`AbstractPrior`) are least squares in
whitened parameters ``z`` and nuisances ``e``. `estimate` descends to the MAP from
several starts, learns the noise in turns with it, and returns the Gaussian about the
MAP with the log evidence (`sim2gp.inference.laplace`).
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import TypeGuard

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.inference.arrowhead import Noise, eliminate
from sim2gp.inference.convergence import Convergence, converged
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.host_descent import SMALL, Progress, search
from sim2gp.inference.laplace import Laplace, expected_noise, laplace, log_normaliser
from sim2gp.inference.least_squares import posterior
from sim2gp.inference.levenberg_marquardt import (
    EXACT,
    Ends,
    Point,
    evaluate,
    multi_start,
)
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import library
from sim2gp.inference.parameters import Parameters
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.inference.relevance import linear_of, relevant
from sim2gp.types import AnyArray, AnyScalar, Key, Scalar, in_float64

SPREAD = 0.7  # prior sd, of starts that are drawn
#: How a descent ends after which scales change: roughly, for the next begins elsewhere.
SCALED = Ends(tolerance=1e-2, most=6, until=SMALL)


#: Called with each step that a fit on the host keeps, and a function for its posterior.
Report = Callable[[Progress, Callable[[], "Estimate"]], None]


class Estimate(eqx.Module):
    """A Gaussian over virtual parameters, and the noise, from data and a prior.

    noise: each channel's sd in its unit, and each window's weight.
    nuisances: each window's own unknowns at the MAP, whitened by their prior.
    information: factor of the data's Fisher information, whitened by the prior.
    scores: what each window's data add to the gradient at the MAP, whitened by the
        prior; they sum to minus the prior's part.
    log_evidence: Laplace's, nats.
    """

    prior: Gaussian
    posterior: Gaussian
    noise: Noise
    nuisances: Float[AnyArray, "W n"]
    information: Float[AnyArray, "p p"]
    scores: Float[AnyArray, "W p"]
    log_evidence: AnyScalar
    convergence: Convergence

    def z(self) -> Float[Array, " p"]:
        """The MAP, whitened by the prior; call it under `in_float64`."""
        return self.prior.whitened(self.posterior.mean)

    @in_float64
    def with_measurements(self, table: Parameters) -> "Estimate":
        """The same, with the measured sums of the table counted as prior."""
        if not table.measurements:
            return self
        prior = ParameterPrior(self.prior, table).linearised(self.posterior.mean)
        change = jnp.linalg.solve(self.prior.scale, prior.scale)
        return dataclasses.replace(
            self,
            prior=prior,
            information=self.information @ change,
            scores=self.scores @ change,
        )


def drawn_starts(
    first: Float[AnyArray, "k p"], count: int, key: Key
) -> Float[AnyArray, "count p"]:
    """Whitened starts: these first, the others drawn about the prior's mean."""
    (k, p), xp = first.shape, library(first)
    if xp is np:  # which asks for no program
        normal = np.random.default_rng(np.asarray(jax.random.key_data(key))).normal
        return np.concatenate([first, SPREAD * normal(size=(count - k, p))])
    drawn = jax.random.normal(key, (count - k, p))
    return xp.concatenate([first, SPREAD * drawn])


def estimate(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    *,
    starts: Float[Array, "starts p"],
    rounds: int,
    nuisances: Float[Array, "W n"] | None = None,
    noise: Noise | None = None,
    freedom: float | Scalar = jnp.inf,
    needed: Int[Array, ""] | None = None,
    report: Report | None = None,
    until: float = SMALL,
) -> Estimate:
    """Descend from each of the whitened ``starts``, then ``rounds`` of EM.

    ``nuisances`` and ``noise`` are those of another fit to begin with; zeros and the
    likelihood's own first noise without. Rounds beyond those ``needed``, and starts
    that are no number, are compiled and not taken. A simulator on the host learns the
    noise in turns with its steps until both rest, the step at ``until`` posterior sd.
    After each of them it calls ``report``. What did not converge is reported by
    `Convergence.check`.
    """
    if nuisances is None:
        shape = len(likelihood.counts), likelihood.n_nuisances
        nuisances = jax.device_put(np.zeros(shape))
    if noise is None:
        noise = likelihood.first_noise()
    start = starts, nuisances, noise
    if likelihood.on_host:
        return _estimate_on_host(likelihood, prior, start, freedom, report, until)
    return _estimate(likelihood, prior, *start, freedom, needed, rounds)


# As in JAX, what is not finite is judged and not warned of.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _estimate_on_host(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    start: tuple[Float[Array, "starts p"], Float[Array, "W n"], Noise],
    freedom: float | Scalar,
    report: Report | None,
    until: float,
) -> Estimate:
    """The same in NumPy: tracing and compiling would take longer than the descent."""
    of_numpy = (likelihood.counts, likelihood.floor, freedom, start, prior)
    of_numpy = jax.tree.map(np.asarray, of_numpy)
    counts, floor, freedom, (starts, e, noise), of_prior = of_numpy

    def update(
        found: Laplace, noise: Noise, prior: AbstractPrior
    ) -> tuple[Noise, AbstractPrior]:
        args = found, noise, prior, counts, floor, freedom
        if not _is_scaled(prior):
            return _learned(*args)
        learned = _learned_in_jax(*jax.device_put(args))
        both: tuple[Noise, AbstractPrior] = jax.tree.map(np.asarray, learned)
        return both

    def about(found: Progress) -> Estimate:
        args = found.noise, found.prior, counts, found.steps, found.away
        known: Estimate = jax.device_put(_about(found.found, *args))
        return known

    for found in search(likelihood, of_prior, starts, e, noise, update, until):
        if report is not None:
            report(found, partial(about, found))
    return about(found)


def _about(
    found: Laplace,
    noise: Noise,
    prior: AbstractPrior,
    counts: Float[AnyArray, "W c"],
    steps: int | Int[AnyArray, ""],
    away: float | Scalar = jnp.inf,
) -> Estimate:
    """Laplace's posterior about the point where a descent has ended.

    ``away`` is how far the MAP may be, in posterior sd, where the descent knows.
    """
    xp, about = library(found.at.z), prior.gaussian
    each = prior.each() if _is_scaled(prior) else xp.ones(about.mean.size)
    evidence = found.log_joint() + log_normaliser(noise, counts)
    return Estimate(
        Gaussian(about.mean, about.scale * each[None]),
        posterior(found.full, found.at.z, about),
        noise,
        found.at.e,
        found.arrow.data[:-1, :-1] * each[None],
        found.at.scores * each[None],
        evidence - xp.sum(xp.log(each)),
        found.convergence(steps, away),
    )


@eqx.filter_jit
def _estimate(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    nuisances: Float[Array, "W n"],
    noise: Noise,
    freedom: float | Scalar,
    needed: Int[Array, ""] | None,
    rounds: int,
) -> Estimate:
    """The whole fit as one program, of simulators that JAX can compile."""
    counts, floor = likelihood.counts, likelihood.floor

    def update(
        at: Point, noise: Noise, prior: AbstractPrior, damping: Scalar
    ) -> tuple[Noise, AbstractPrior]:
        found = laplace(at, noise)
        return _learned(found, noise, prior, counts, floor, freedom, damping)

    at, noise, prior, steps, _ = multi_start(
        likelihood,
        prior,
        starts,
        nuisances,
        noise,
        update,
        rounds=rounds,
        needed=needed,
        ends=SCALED if _is_scaled(prior) else EXACT,
    )
    return _about(laplace(at, noise), noise, prior, counts, steps)


def _learned(
    found: Laplace,
    noise: Noise,
    prior: AbstractPrior,
    counts: Float[AnyArray, "W c"],
    floor: Float[AnyArray, " c"],
    freedom: AnyScalar,
    damping: AnyScalar = 0.0,
) -> tuple[Noise, AbstractPrior]:
    """Noise and scales of the prior, where the data are linearised."""
    expected = expected_noise(noise, *found.squares(), counts, floor, freedom)
    if not _is_scaled(prior):
        return expected, prior
    linear = linear_of(found, expected.weights, counts, floor)
    noise = Noise(noise.sd, expected.weights)
    return relevant(linear, found.at.z, noise, prior, damping)


_learned_in_jax = eqx.filter_jit(_learned)  # scales of a prior: a long iteration


def _is_scaled(prior: AbstractPrior) -> TypeGuard[ParameterPrior]:
    """Whether data choose scales of the prior."""
    return isinstance(prior, ParameterPrior) and len(prior.scales) > 0


@eqx.filter_jit
def estimate_noise(likelihood: AbstractLikelihood, prior: AbstractPrior) -> Estimate:
    """The noise alone, of data without nuisances; the prior is the posterior.

    One step of EM is exact where the parameters' posterior is given. The log evidence
    is that of the data at the parameters' mean.
    """
    W, c = likelihood.counts.shape
    p = prior.gaussian.mean.size
    unit = Noise(jnp.ones(c), jnp.ones(W))
    at = evaluate(likelihood, prior, jnp.zeros(p), jnp.zeros((W, 0)), unit)
    found = Laplace(at, eliminate(at.blocks, at.e, unit), jnp.eye(p + 1))
    squares, spread = found.squares()
    counts, floor = likelihood.counts, likelihood.floor
    noise = expected_noise(unit, squares, spread, counts, floor)
    misfit = jnp.sum(squares / noise.sd[None] ** 2)
    return Estimate(
        prior.gaussian,
        prior.gaussian,
        noise,
        at.e,
        jnp.zeros((p, p)),
        jnp.zeros((W, p)),
        -0.5 * misfit + log_normaliser(noise, counts),
        converged(p),
    )
