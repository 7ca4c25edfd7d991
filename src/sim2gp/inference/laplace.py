"""Laplace's Gaussian about a point, and what it says of the noise.

Whitened parameters ``z`` and nuisances ``e`` are those of
`sim2gp.inference.levenberg_marquardt`. The noise's update is EM's:

    sig_c^2 = (2 floor_c^2 + sum_w w_w E||r_wc||^2 / mean(w)) / (2 + count_c)
    w_w     = (1 + count_w / freedom) / (1 + ||r_w||^2 / freedom)

The prior on the noise counts as two samples at the floor. Weights are Student-t's; an
infinite number of degrees of ``freedom`` makes them 1. Their mean, over windows with
data, is 1 where the update rests. Without it (EM proper) weights take back what the
noise gains, and hundreds of rounds are needed where a window has many samples:
parameter expansion, Liu, Rubin and Wu 1998, Biometrika 85.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float, Int

from sim2gp.inference.arrowhead import Elimination, Noise, eliminate
from sim2gp.inference.convergence import (
    CONVERGED,
    DEAD,
    NEAR,
    NOT_FINITE,
    STALLED,
    Convergence,
)
from sim2gp.inference.gaussian import LOG_2PI
from sim2gp.inference.least_squares import Factor, gauss_newton_step, log_joint, stack
from sim2gp.inference.levenberg_marquardt import GRADIENT_TOLERANCE, Point
from sim2gp.inference.linalg import each_window, library, solve_triangular
from sim2gp.types import AnyArray, AnyScalar


class Laplace(eqx.Module):
    """The Gaussian about a point, in whitened coordinates, from its factors."""

    at: Point
    arrow: Elimination
    full: Factor  # of data and prior

    @property
    def R(self) -> Float[AnyArray, "p p"]:
        """Factor of the posterior precision: ``R^T R = Sigma_z^-1``."""
        return self.full[:-1, :-1]

    def scale(self) -> Float[AnyArray, "p p"]:
        """Square root of ``Sigma_z``: ``R^-1``."""
        eye = library(self.R).eye(len(self.R), dtype=self.R.dtype)
        return solve_triangular(self.R, eye)

    def log_joint(self) -> AnyScalar:
        """``-L - 1/2 logdet(S0 Sq^-1)``, nats, over ``z`` and the nuisances.

        The Laplace evidence, but for the normalisation of the noise.
        """
        xp = library(self.full)
        pivots = xp.diagonal(self.arrow.R11, axis1=1, axis2=2)
        return log_joint(self.full) - xp.sum(xp.log(pivots))

    def squares(self) -> tuple[Float[AnyArray, "W c"], Float[AnyArray, "W c"]]:
        """Squared residuals, and squares that the posterior's own spread adds."""
        xp, (reduced, spread) = library(self.full), self.reduced()
        more = xp.sum((reduced[..., :-1] @ self.scale()) ** 2, axis=(2, 3))
        return xp.sum(reduced[..., -1] ** 2, axis=2), more + spread

    def reduced(self) -> tuple[Float[AnyArray, "W c k p1"], Float[AnyArray, "W c"]]:
        """Rows ``[J_z r]`` with the nuisances at their best, and what these spread."""
        xp, n = library(self.full), self.at.e.shape[1]
        own, rest = self.at.blocks[..., :n], self.at.blocks[..., n:]
        eye = xp.eye(n)
        root = each_window(lambda R11: solve_triangular(R11, eye), self.arrow.R11)
        spread = xp.sum((own @ root[:, None]) ** 2, axis=(2, 3))
        return rest - own @ self.arrow.slope[:, None], spread

    def newton_step_sd(self) -> AnyScalar:
        """The largest entry of the undamped step, each in its own posterior sd."""
        xp, dz = library(self.full), gauss_newton_step(self.full)  # R dz = -c
        de = self.arrow.slope[..., -1] + self.arrow.slope[..., :-1] @ dz
        own = xp.einsum("wij,wj->wi", self.arrow.R11, de)
        entries = self.full[:-1, -1], own
        largest = (xp.max(xp.abs(x), initial=0.0) for x in entries)
        return xp.maximum(*largest)

    def convergence(
        self, steps: int | Int[AnyArray, ""], away: AnyScalar = jnp.inf
    ) -> Convergence:
        """Whether a descent of so many steps has ended at a MAP, or near enough."""
        gradient, xp = self.at.gradient, library(self.full)
        step_sd = xp.minimum(self.newton_step_sd(), away)
        there = (gradient <= GRADIENT_TOLERANCE) | (step_sd <= NEAR)
        status = xp.where(there, CONVERGED, STALLED)
        data = self.arrow.data
        dead = xp.all(data[:, :-1] == 0.0) & xp.any(data[:, -1] != 0.0)
        status = xp.where(dead, DEAD, status)
        finite = xp.isfinite(self.at.cost) & xp.all(xp.isfinite(self.full))
        status = xp.where(finite, status, NOT_FINITE)
        dz = gauss_newton_step(self.full)
        away_each = xp.abs(dz) / xp.linalg.norm(self.scale(), axis=1)
        return Convergence(status, gradient, step_sd, steps, away_each)


def laplace(at: Point, noise: Noise) -> Laplace:
    """The Gaussian about a point, given the noise."""
    arrow = eliminate(at.blocks, at.e, noise)
    return Laplace(at, arrow, stack(arrow.data, at.prior))


def expected_noise(
    noise: Noise,
    squares: Float[AnyArray, "W c"],
    spread: Float[AnyArray, "W c"],
    counts: Float[AnyArray, "W c"],
    floor: Float[AnyArray, " c"],
    freedom: AnyScalar = jnp.inf,
) -> Noise:
    """EM's update of noise and weights, from squares expected under the posterior."""
    xp = library(squares)
    with_data = xp.sum(counts, axis=1) > 0
    mean = xp.mean(noise.weights, where=with_data)
    expected = noise.weights @ (squares + spread) / xp.where(mean > 0, mean, 1.0)
    sd = xp.sqrt((2.0 * floor**2 + expected) / (2.0 + xp.sum(counts, axis=0)))
    misfit = xp.sum(squares / sd[None] ** 2, axis=1)
    weights = (1.0 + xp.sum(counts, axis=1) / freedom) / (1.0 + misfit / freedom)
    return Noise(sd, weights)


def log_normaliser(noise: Noise, counts: Float[AnyArray, "W c"]) -> AnyScalar:
    """``-sum_wc count_wc [log sig_c + 1/2 log(2 pi) - 1/2 log w_w]``, nats."""
    xp, N = library(counts), counts.sum(axis=0)
    of_noise = xp.sum(N * (xp.log(noise.sd) + 0.5 * LOG_2PI))
    return 0.5 * xp.sum(xp.sum(counts, axis=1) * xp.log(noise.weights)) - of_noise
