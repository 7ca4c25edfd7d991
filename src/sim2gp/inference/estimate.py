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

from sim2gp.compilation import compile_async
from sim2gp.inference.arrowhead import Noise, eliminate
from sim2gp.inference.convergence import NEAR, Convergence, converged
from sim2gp.inference.descent import Learning, Scales, multi_start
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.host_descent import SMALL, STILL, Progress, search
from sim2gp.inference.laplace import Laplace, expected_noise, laplace, log_normaliser
from sim2gp.inference.least_squares import posterior
from sim2gp.inference.levenberg_marquardt import Point, evaluate
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import library
from sim2gp.inference.parameters import Parameters
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.inference.relevance import linear_of, price, relevant
from sim2gp.types import AnyArray, AnyScalar, Key, Scalar, in_float64

SPREAD = 0.7  # prior sd, of starts that are drawn

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
        z = self.prior.on_host().whitened(np.asarray(self.posterior.mean))
        return jnp.asarray(z)

    def of_windows(self, count: int) -> "Estimate":
        """To begin a fit of so many other windows, at the starts guessed for them."""
        e, scores = (
            np.zeros((count, x.shape[1])) for x in (self.nuisances, self.scores)
        )
        noise = Noise(self.noise.sd, np.ones(count))
        return dataclasses.replace(self, nuisances=e, noise=noise, scores=scores)

    def some(self, which: Int[np.ndarray, " w"]) -> "Estimate":
        """What it says of some of its windows, by number."""
        each = self.noise.weights, self.nuisances, self.scores
        weights, e, scores = (np.asarray(x)[which] for x in each)
        noise = dataclasses.replace(self.noise, weights=weights)
        own = {"nuisances": e, "scores": scores}
        return dataclasses.replace(self, noise=noise, **own)

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
    nuisances: Float[Array, "W n"] | None = None,
    noise: Noise | None = None,
    learn: bool = True,
    freedom: float | Scalar = jnp.inf,
    report: Report | None = None,
    until: float | None = None,
) -> Estimate:
    """Descend from each of the whitened ``starts``; from the best, the noise as well.

    ``nuisances`` and ``noise`` are those of another fit to begin with; zeros and the
    likelihood's own first noise without. The noise is learned in turns with the steps
    until both rest, or stays where it is not to ``learn``. Starts that are no number
    are compiled and not taken. A descent rests at a step of ``until`` posterior sd: by
    default `SMALL` on the host, and far less of what is compiled. A simulator on the
    host keeps the scales of a prior, and calls ``report`` after each step. What did not
    converge is reported by `Convergence.check`.
    """
    if nuisances is None:
        shape = len(likelihood.counts), likelihood.n_nuisances
        nuisances = jax.device_put(np.zeros(shape))
    if noise is None:
        noise = likelihood.first_noise()
    start = starts, nuisances, noise
    if likelihood.on_host:
        how = learn, report, SMALL if until is None else until
        return _estimate_on_host(likelihood, prior, start, freedom, *how)
    return _estimate(likelihood, prior, *start, freedom, learn, until)


# As in JAX, what is not finite is judged and not warned of.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def _estimate_on_host(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    start: tuple[Float[Array, "starts p"], Float[Array, "W n"], Noise],
    freedom: float | Scalar,
    learn: bool,
    report: Report | None,
    until: float,
) -> Estimate:
    """The same in NumPy: tracing and compiling would take longer than the descent."""
    of_numpy = (likelihood.counts, likelihood.floor, freedom, start, prior)
    of_numpy = jax.tree.map(np.asarray, of_numpy)
    counts, floor, freedom, (starts, e, noise), of_prior = of_numpy

    def update(found: Laplace, noise: Noise) -> Noise:
        return expected_noise(noise, *found.squares(), counts, floor, freedom)

    def about(found: Progress) -> Estimate:
        args = found.noise, of_prior, counts, found.steps, found.away
        known: Estimate = jax.device_put(about_point(found.found, *args))
        return known

    learned = update if learn else None
    for found in search(likelihood, of_prior, starts, e, noise, learned, until):
        if report is not None:
            report(found, partial(about, found))
    return about(found)


def about_point(
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
    about, each = prior.gaussian, _each(prior)
    return Estimate(
        Gaussian(about.mean, about.scale * each[None]),
        posterior(found.full, found.at.z, about),
        noise,
        found.at.e,
        found.arrow.data[:-1, :-1] * each[None],
        found.at.scores * each[None],
        _evidence(found, noise, prior, counts),
        found.convergence(steps, away),
    )


def _each(prior: AbstractPrior) -> Float[AnyArray, " p"]:
    """What the data multiply each parameter's prior sd by."""
    mean = prior.gaussian.mean
    return prior.each() if _is_scaled(prior) else library(mean).ones(mean.size)


def _evidence(
    found: Laplace, noise: Noise, prior: AbstractPrior, counts: Float[AnyArray, "W c"]
) -> AnyScalar:
    """Laplace's log evidence, nats."""
    xp, each = library(found.at.z), _each(prior)
    return found.log_joint() + log_normaliser(noise, counts) - xp.sum(xp.log(each))


@compile_async
def _estimate(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    nuisances: Float[Array, "W n"],
    noise: Noise,
    freedom: float | Scalar,
    learn: bool,
    until: float | None,
) -> Estimate:
    """The whole fit as one program, of simulators that JAX can compile."""
    counts, floor = likelihood.counts, likelihood.floor

    def learned(at: Point, noise: Noise) -> Noise:
        squares = laplace(at, noise).squares()
        return expected_noise(noise, *squares, counts, floor, freedom)

    def choose(
        at: Point, noise: Noise, prior: AbstractPrior, trust: Scalar
    ) -> tuple[Noise, AbstractPrior, Scalar]:
        assert _is_scaled(prior)
        linear = linear_of(laplace(at, noise), noise.weights, counts, floor)
        noise, chosen = relevant(linear, at.z, noise, prior, trust)
        other = jnp.max(jnp.abs(jnp.log(chosen.scales / prior.scales)))
        return noise, chosen, other

    def score(at: Point, noise: Noise, prior: AbstractPrior) -> Scalar:
        assert _is_scaled(prior)
        evidence = _evidence(laplace(at, noise), noise, prior, counts)
        return evidence - price(prior.scales)

    start, learning = (starts, nuisances, noise), Learning()
    if learn:
        scales = Scales(choose, score) if _is_scaled(prior) else None
        learning = Learning(learned, scales)
        if scales or until:
            learning = learning._replace(until=until or NEAR, still=STILL)
    at, noise, prior, steps, _ = multi_start(likelihood, prior, *start, learning)
    return about_point(laplace(at, noise), noise, prior, counts, steps)


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
