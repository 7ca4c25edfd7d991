"""The one fit: the MAP, the noise by EM, and Laplace's posterior about it.

A likelihood (`AbstractLikelihood`) and a prior (`AbstractPrior`) are least squares in
whitened parameters ``z`` and nuisances ``e``. `estimate` descends to the MAP from
several starts, learns the noise in turns with it, and returns the Gaussian about the
MAP with the log evidence:

    sig_c^2 = (2 floor_c^2 + sum_w w_w E||r_wc||^2 / mean(w)) / (2 + count_c)
    w_w     = (1 + count_w / freedom) / (1 + ||r_w||^2 / freedom)

The prior on the noise counts as two samples at the floor. Weights are Student-t's; an
infinite number of degrees of ``freedom`` makes them 1. Their mean, over windows with
data, is 1 where the update rests. Without it (EM proper) weights take back what the
noise gains, and hundreds of rounds are needed where a window has many samples:
parameter expansion, Liu, Rubin and Wu 1998, Biometrika 85.
"""

import dataclasses
from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp.inference.arrowhead import Elimination, Noise, eliminate
from sim2gp.inference.convergence import (
    CONVERGED,
    DEAD,
    NEAR,
    NOT_FINITE,
    STALLED,
    Convergence,
    converged,
)
from sim2gp.inference.gaussian import LOG_2PI, Gaussian
from sim2gp.inference.host_descent import Progress, best_start, descend
from sim2gp.inference.least_squares import (
    Factor,
    gauss_newton_step,
    log_joint,
    posterior,
    stack,
)
from sim2gp.inference.levenberg_marquardt import (
    AGAIN_DAMPING,
    GRADIENT_TOLERANCE,
    Point,
    evaluate,
    multi_start,
)
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import solve_triangular
from sim2gp.inference.parameters import Parameters
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.types import Key, Scalar, in_float64

SPREAD = 0.7  # prior sd, of starts that are drawn


#: Told of each step that a fit on the host keeps, and how to have its posterior.
Report = Callable[[Progress, Callable[[], "Estimate"]], None]


class Laplace(eqx.Module):
    """The Gaussian about a point, in whitened coordinates, from its factors."""

    at: Point
    arrow: Elimination
    full: Factor  # of data and prior

    @property
    def R(self) -> Float[Array, "p p"]:
        """Factor of the posterior precision: ``R^T R = Sigma_z^-1``."""
        return self.full[:-1, :-1]

    def scale(self) -> Float[Array, "p p"]:
        """Square root of ``Sigma_z``: ``R^-1``."""
        return solve_triangular(self.R, jnp.eye(len(self.R), dtype=self.R.dtype))

    def log_joint(self) -> Scalar:
        """``-L - 1/2 logdet(S0 Sq^-1)``, nats, over ``z`` and the nuisances.

        The Laplace evidence, but for the normalisation of the noise.
        """
        pivots = jnp.diagonal(self.arrow.R11, axis1=1, axis2=2)
        return log_joint(self.full) - jnp.sum(jnp.log(pivots))

    def squares(self) -> tuple[Float[Array, "W c"], Float[Array, "W c"]]:
        """Squared residuals, and squares that the posterior's own spread adds."""
        n = self.at.e.shape[1]
        own, rest = self.at.blocks[..., :n], self.at.blocks[..., n:]
        # Rows of (z, r) with the nuisances at their best.
        reduced = rest - own @ self.arrow.slope[:, None]
        eye = jnp.eye(n)
        root = jax.vmap(lambda R11: solve_triangular(R11, eye))(self.arrow.R11)
        spread = jnp.sum((reduced[..., :-1] @ self.scale()) ** 2, axis=(2, 3))
        spread = spread + jnp.sum((own @ root[:, None]) ** 2, axis=(2, 3))
        return jnp.sum(reduced[..., -1] ** 2, axis=2), spread

    def newton_step_sd(self) -> Scalar:
        """The largest entry of the undamped step, each in its own posterior sd."""
        dz = gauss_newton_step(self.full)  # R dz = -c
        de = self.arrow.slope[..., -1] + self.arrow.slope[..., :-1] @ dz
        own = jnp.einsum("wij,wj->wi", self.arrow.R11, de)
        entries = self.full[:-1, -1], own
        largest = (jnp.max(jnp.abs(x), initial=0.0) for x in entries)
        return jnp.maximum(*largest)

    def convergence(
        self, steps: Int[Array, ""], away: float | Scalar = jnp.inf
    ) -> Convergence:
        """Whether a descent of so many steps has ended at a MAP, or near enough."""
        gradient = self.at.gradient
        step_sd = jnp.minimum(self.newton_step_sd(), away)
        there = (gradient <= GRADIENT_TOLERANCE) | (step_sd <= NEAR)
        status = jnp.where(there, CONVERGED, STALLED)
        data = self.arrow.data
        dead = jnp.all(data[:, :-1] == 0.0) & jnp.any(data[:, -1] != 0.0)
        status = jnp.where(dead, DEAD, status)
        finite = jnp.isfinite(self.at.cost) & jnp.all(jnp.isfinite(self.full))
        status = jnp.where(finite, status, NOT_FINITE)
        dz = gauss_newton_step(self.full)
        away_each = jnp.abs(dz) / jnp.linalg.norm(self.scale(), axis=1)
        return Convergence(status, gradient, step_sd, steps, away_each)


def laplace(at: Point, noise: Noise) -> Laplace:
    """The Gaussian about a point, given the noise."""
    arrow = eliminate(at.blocks, at.e, noise)
    return Laplace(at, arrow, stack(arrow.data, at.prior))


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
    nuisances: Float[Array, "W n"]
    information: Float[Array, "p p"]
    scores: Float[Array, "W p"]
    log_evidence: Scalar
    convergence: Convergence

    def z(self) -> Float[Array, " p"]:
        """The MAP, whitened by the prior; call it under `in_float64`."""
        away = self.posterior.mean - self.prior.mean
        return jnp.linalg.solve(self.prior.scale, away)

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
    first: Float[Array, "k p"], count: int, key: Key
) -> Float[Array, "count p"]:
    """Whitened starts: these first, the others drawn about the prior's mean."""
    k, p = first.shape
    return jnp.concatenate([first, SPREAD * jax.random.normal(key, (count - k, p))])


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
) -> Estimate:
    """Descend from each of the whitened ``starts``, then ``rounds`` of EM.

    ``nuisances`` and ``noise`` are those of another fit to begin with; zeros and the
    likelihood's own first noise without. Rounds beyond those ``needed``, and starts
    that are no number, are compiled and not taken. A simulator on the host learns the
    noise in turns with its steps until both rest, and says to ``report`` after each of
    them where it stands. What did not converge is reported by `Convergence.check`.
    """
    if nuisances is None:
        shape = len(likelihood.counts), likelihood.n_nuisances
        nuisances = jnp.zeros(shape)
    if noise is None:
        noise = likelihood.first_noise()
    start = starts, nuisances, noise
    if likelihood.on_host:
        freedom = jnp.asarray(freedom)
        return _estimate_on_host(likelihood, prior, start, freedom, report)
    return _estimate(likelihood, prior, *start, freedom, needed, rounds)


def _estimate_on_host(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    start: tuple[Float[Array, "starts p"], Float[Array, "W n"], Noise],
    freedom: Scalar,
    report: Report | None,
) -> Estimate:
    starts, e, noise = start
    counts, floor = likelihood.counts, likelihood.floor

    def update(at: Point, noise: Noise) -> Noise:
        return _updated(at, noise, counts, floor, freedom)

    best = best_start(likelihood, prior, starts, e, noise, _newton_step_sd)
    begin = (best.at.z, best.at.e), noise, _newton_step_sd, update

    def about(found: Progress) -> Estimate:
        counted = jnp.asarray(found.steps), jnp.asarray(found.away)
        return _about(found.at, found.noise, prior.gaussian, counts, *counted)

    damping = min(best.damping, AGAIN_DAMPING)
    for found in descend(likelihood, prior, *begin, damping=damping):
        if report is not None:
            report(found, partial(about, found))
    return about(found)


@eqx.filter_jit
def _updated(
    at: Point, noise: Noise, counts: Array, floor: Array, freedom: Scalar
) -> Noise:
    squares, spread = laplace(at, noise).squares()
    return expected_noise(noise, squares, spread, counts, floor, freedom)


@eqx.filter_jit
def _newton_step_sd(at: Point, noise: Noise) -> Scalar:
    return laplace(at, noise).newton_step_sd()


@eqx.filter_jit
def _about(
    at: Point,
    noise: Noise,
    prior: Gaussian,
    counts: Float[Array, "W c"],
    steps: Int[Array, ""],
    away: float | Scalar = jnp.inf,
) -> Estimate:
    """Laplace's posterior about the point where a descent has ended.

    ``away`` is how far the MAP may be, in posterior sd, where the descent knows.
    """
    found = laplace(at, noise)
    return Estimate(
        prior,
        posterior(found.full, at.z, prior),
        noise,
        at.e,
        found.arrow.data[:-1, :-1],
        at.scores,
        found.log_joint() + log_normaliser(noise, counts),
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

    def update(at: Point, noise: Noise) -> Noise:
        squares, spread = laplace(at, noise).squares()
        return expected_noise(noise, squares, spread, counts, floor, freedom)

    at, noise, steps, _ = multi_start(
        likelihood,
        prior,
        starts,
        nuisances,
        noise,
        update,
        rounds=rounds,
        needed=needed,
    )
    return _about(at, noise, prior.gaussian, counts, steps)


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


def expected_noise(
    noise: Noise,
    squares: Float[Array, "W c"],
    spread: Float[Array, "W c"],
    counts: Float[Array, "W c"],
    floor: Float[Array, " c"],
    freedom: float | Scalar = jnp.inf,
) -> Noise:
    """EM's update of noise and weights, from squares expected under the posterior."""
    with_data = jnp.sum(counts, axis=1) > 0
    mean = jnp.mean(noise.weights, where=with_data)
    expected = noise.weights @ (squares + spread) / jnp.where(mean > 0, mean, 1.0)
    sd = jnp.sqrt((2.0 * floor**2 + expected) / (2.0 + jnp.sum(counts, axis=0)))
    misfit = jnp.sum(squares / sd[None] ** 2, axis=1)
    weights = (1.0 + jnp.sum(counts, axis=1) / freedom) / (1.0 + misfit / freedom)
    return Noise(sd, weights)


def log_normaliser(noise: Noise, counts: Float[Array, "W c"]) -> Scalar:
    """``-sum_wc count_wc [log sig_c + 1/2 log(2 pi) - 1/2 log w_w]``, nats."""
    N = jnp.sum(counts, axis=0)
    of_noise = jnp.sum(N * (jnp.log(noise.sd) + 0.5 * LOG_2PI))
    return 0.5 * jnp.sum(jnp.sum(counts, axis=1) * jnp.log(noise.weights)) - of_noise
