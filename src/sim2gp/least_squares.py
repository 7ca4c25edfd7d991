"""The MAP and its Laplace posterior in whitened coordinates, square roots throughout.

With ``tt = mu0 + L0 z`` and residuals ``r`` divided by their noise, the negative log
posterior is a sum of squares,

    L(z) = 1/2 ||r(z)||^2 + 1/2 ||z||^2,          J = dr/dz.

All that Levenberg-Marquardt, the posterior, and the evidence need of the data is the
triangular factor ``R`` of ``[J r]`` (`factor`): it has ``p + 1`` rows however many rows
the data have, it stacks (streaming, windows, prior), and

    [J r; I z] = Q [R c; 0 rho],     Sigma_z = R^-1 R^-T,     ||r||^2 = ||c||^2 + rho^2.

No normal equations, no explicit inverse, no jitter: at a condition number of 1e4 normal
equations already miss the posterior mean by 5e-10 sd, the QR form by 3e-14.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.gaussian import LOG_2PI, Gaussian, log_det_factor
from sim2gp.types import Scalar

#: Triangular factor of ``[J r]``, shape (p + 1, p + 1), diagonal non-negative.
Factor = Float[Array, "p1 p1"]

CONVERGED, STALLED, NOT_FINITE = 0, 1, 2
GRADIENT_TOLERANCE = 1e-8
#: Undamped steps. Under misfit, and where a bound saturates (measured: by 0.9 a step),
#: they converge linearly, not in two.
MAX_POLISH = 200
RANK_TOLERANCE = 1e-8  # singular values below this share of the largest count as zero


def factor(J: Float[Array, "N p"], r: Float[Array, " N"]) -> Factor:
    """Triangular factor of ``[J r]``: the data's square-root information."""
    return triangular(jnp.concatenate([J, r[:, None]], axis=1))


def triangular(rows: Float[Array, "N k"]) -> Float[Array, "k k"]:
    """``R`` of the QR decomposition, square, with non-negative diagonal."""
    N, k = rows.shape
    if N < k:
        rows = jnp.concatenate([rows, jnp.zeros((k - N, k), rows.dtype)])
    R = jnp.linalg.qr(rows, mode="r")
    return jnp.where(jnp.diag(R) < 0.0, -1.0, 1.0)[:, None] * R


def stack(*factors: Float[Array, "_ k"]) -> Float[Array, "k k"]:
    """The factor of several blocks of rows at once."""
    return triangular(jnp.concatenate(factors))


def with_prior(data: Factor, z: Float[Array, " p"]) -> Factor:
    """Add the prior's rows ``[I z]`` to the data's factor."""
    prior = jnp.concatenate([jnp.eye(z.size, dtype=z.dtype), z[:, None]], axis=1)
    return stack(data, prior)


def gauss_newton_step(full: Factor) -> Float[Array, " p"]:
    """The undamped step ``-R^-1 c`` towards the linearised MAP."""
    return -solve_triangular(full[:-1, :-1], full[:-1, -1])


class Fit(eqx.Module):
    """A MAP in whitened coordinates, with everything that follows from its factor."""

    z: Float[Array, " p"]
    data: Factor  # of the data alone, at z
    full: Factor  # of data and prior, at z
    aux: Any  # what the likelihood wants to remember of z
    cost: Scalar
    gradient: Scalar  # ||g_z||_inf / (1 + cost)
    status: Int[Array, ""]
    steps: Int[Array, ""]

    @property
    def R(self) -> Float[Array, "p p"]:
        """Factor of the posterior precision: ``R^T R = Sigma_z^-1``."""
        return self.full[:-1, :-1]

    @property
    def dead(self) -> Bool[Array, " p"]:
        """Parameters that the data do not depend on at all."""
        return jnp.all(self.data[:, :-1] == 0.0, axis=0)

    def scale(self) -> Float[Array, "p p"]:
        """Square root of ``Sigma_z``: ``R^-1``."""
        return solve_triangular(self.R, jnp.eye(self.z.size, dtype=self.z.dtype))

    def posterior(self, prior: Gaussian) -> Gaussian:
        """``N(tt*, Sigma_q)`` by a triangular solve: scale ``L0 R^-1``."""
        return Gaussian(
            prior.mean + prior.scale @ self.z,
            solve_triangular(self.R, prior.scale.T, trans="T").T,
        )

    def log_joint(self) -> Scalar:
        """``-1/2 ||r||^2 - 1/2 ||z||^2 - 1/2 logdet(S0 Sq^-1)``, nats.

        The Laplace evidence, but for the normalisation of the noise.
        """
        return -self.cost - jnp.sum(jnp.log(jnp.diag(self.R)))

    def raise_unless_converged(self, names: tuple[str, ...], where: str) -> None:
        """Raise a typed error on the host, naming what to look at."""
        status = int(self.status)
        if status == NOT_FINITE:
            raise NotFinite(
                "E203",
                "the simulation is not finite at any start of the fit",
                where=where,
                fix="narrow the priors, or shorten the step",
            )
        dead = [name for name, d in zip(names, self.dead.tolist(), strict=True) if d]
        if len(dead) == len(names) and bool(jnp.any(self.data[:, -1] != 0.0)):
            raise DeadParameters(
                "E146",
                "no parameter reaches the data",
                where=where,
                got=f"zero sensitivity to {', '.join(dead)}",
                fix="check the columns, the excitation and what is fixed",
            )
        if status == STALLED:
            raise NotConverged(
                "E201",
                "the MAP did not converge",
                where=where,
                got=f"scaled gradient {float(self.gradient):.1e} "
                f"after {int(self.steps)} steps",
                expected=f"at most {GRADIENT_TOLERANCE:.0e}",
                fix="check units and bounds, or add starts",
            )


def minimise(
    factor_of: Callable[[Float[Array, " p"]], tuple[Factor, Any]],
    z: Float[Array, " p"],
    *,
    max_steps: int = 60,
    tolerance: float = 1e-10,
    search: bool | Bool[Array, ""] = True,
    exact: bool | Bool[Array, ""] = True,
) -> Fit:
    """One Levenberg-Marquardt descent, finished by undamped QR steps.

    ``factor_of(z)`` is the factor of the whitened data residual and its Jacobian, and
    whatever the caller wants back at the MAP. Without ``search`` the QR steps start at
    once, which is enough near the MAP; ``exact`` asks for a zero gradient.
    """

    def full_of(z: Array) -> Factor:
        return with_prior(factor_of(z)[0], z)

    # The factor's last column has the residual's norm and its first columns the
    # residual's Gauss-Newton matrix, so LM on this small problem *is* LM on the data.
    @jax.custom_jvp
    def compressed(z: Array) -> Array:
        return full_of(z)[:, -1]

    @compressed.defjvp
    def compressed_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        full = full_of(primals[0])
        return full[:, -1], full[:, :-1] @ tangents[0]

    def descend(z: Array) -> tuple[Array, Array]:
        solution: Any = optx.least_squares(
            lambda z, _: compressed(z),
            optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance),
            z,
            max_steps=max_steps,
            throw=False,
        )
        return solution.value, solution.stats["num_steps"]

    none = jax.eval_shape(descend, z)[1]

    def stay(z: Array) -> tuple[Array, Array]:
        return z, jnp.zeros(none.shape, none.dtype)

    z, steps = jax.lax.cond(search, descend, stay, z)
    return polish(factor_of, z, steps, exact=exact)


def polish(
    factor_of: Callable[[Float[Array, " p"]], tuple[Factor, Any]],
    z: Float[Array, " p"],
    steps: Int[Array, ""],
    *,
    exact: bool | Bool[Array, ""] = True,
) -> Fit:
    """Undamped QR steps: two, or where ``exact`` on to a zero gradient; the verdict.

    A step that improves nothing is halved: under misfit the Gauss-Newton step may be
    too long along a flat direction, though never in the wrong direction.
    """
    blank = jax.eval_shape(factor_of, z)
    data, aux = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), blank)
    infinite = jnp.asarray(jnp.inf, z.dtype)
    here = (z, data, aux, infinite, infinite)

    def improve(carry: tuple) -> tuple:
        here, z_try, length, count = carry
        data, aux = factor_of(z_try)
        full = with_prior(data, z_try)
        there = (z_try, data, aux, _cost(full), _gradient(full))
        # Rounding in the cost must not refuse the last, gradient-only digits.
        slack = 1e-9 * here[3] + 1e-12
        same = (there[3] <= here[3] + slack) & (there[4] < here[4])
        keep = (there[3] < here[3] - slack) | same | (count == 0)
        here = jax.tree.map(lambda new, old: jnp.where(keep, new, old), there, here)
        length = jnp.where(keep, 1.0, 0.5 * length)
        step = length * gauss_newton_step(with_prior(here[1], here[0]))
        return here, here[0] + step, length, count + 1

    def unfinished(carry: tuple) -> Array:
        here, _, length, count = carry
        small = here[4] <= 0.1 * GRADIENT_TOLERANCE
        hopeless = ~jnp.isfinite(here[3]) | (length < 1e-6) | (count > MAX_POLISH)
        return (count <= 2) | (exact & ~small & ~hopeless)

    start = (here, z, jnp.ones((), z.dtype), jnp.zeros((), int))
    here, _, _, _ = jax.lax.while_loop(unfinished, improve, start)
    z, data, aux, cost, gradient = here
    full = with_prior(data, z)
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(full))
    status = jnp.where(gradient <= GRADIENT_TOLERANCE, CONVERGED, STALLED)
    status = jnp.where(finite, status, NOT_FINITE)
    return Fit(z, data, full, aux, cost, gradient, status, steps)


def multi_start(
    factor_of: Callable[[Float[Array, " p"], Any], tuple[Factor, Any]],
    starts: Float[Array, "starts p"],
    noise: Any,
    update: Callable[[Fit, Any], Any],
    *,
    rounds: int,
    searches: int,
    tolerance: float = 1e-10,
) -> tuple[Fit, Any, Float[Array, " starts"]]:
    """The best of several descents; then ``rounds`` of noise update and descent (EM).

    The first ``searches`` rounds descend as the starts do, because the noise falls far
    there; later ones only take QR steps. Every descent is one turn of the same scan, so
    that the likelihood is compiled once. Returns the fit, its noise, and the cost that
    each start reached.
    """

    def descend(z: Array, noise: Any, search: Array, exact: Array) -> Fit:
        return minimise(
            lambda z: factor_of(z, noise),
            z,
            tolerance=tolerance,
            search=search,
            exact=exact,
        )

    yes = jnp.asarray(True)
    shapes = jax.eval_shape(descend, starts[0], noise, yes, yes)
    best = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    nothing = (jnp.asarray(jnp.inf), jnp.full_like(best.status, NOT_FINITE))
    best = eqx.tree_at(lambda f: (f.cost, f.status), best, nothing)

    def turn(carry: tuple[Fit, Any], x: tuple[Array, ...]) -> tuple[tuple, Array]:
        best, noise = carry
        start, searching, far, last = x

        def pick(yes: Any, no: Any) -> Any:
            return jax.tree.map(lambda y, n: jnp.where(searching, y, n), yes, no)

        noise = pick(noise, update(best, noise))
        z = jnp.where(searching, start, best.z)
        fit = descend(z, noise, far, last)
        # A cost that is not finite never wins; a comparison with NaN is false.
        better = jnp.where(searching, fit.cost < best.cost, True)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), fit, best)
        return (best, noise), fit.cost

    count = len(starts)
    schedule = jnp.concatenate([starts, jnp.zeros((rounds, starts.shape[1]))])
    turns = jnp.arange(count + rounds)
    far = turns < count + searches
    plan = (schedule, turns < count, far, (turns == count + rounds - 1) | (rounds == 0))
    (fit, noise), costs = jax.lax.scan(turn, (best, noise), plan)
    return fit, noise, costs[:count]


def linear_fit(J: Float[Array, "N p"], r: Float[Array, " N"]) -> Fit:
    """The exact conjugate posterior of ``r(z) = r + J z``: one QR, then refinement."""
    zeros = jnp.zeros(J.shape[1], J.dtype)
    return polish(lambda z: (factor(J, r + J @ z), ()), zeros, jnp.zeros((), int))


def linear_posterior(
    J: Float[Array, "N d p"],
    y: Float[Array, "N d"],
    noise_scale: Float[Array, "d d"],
    prior: Gaussian,
) -> tuple[Gaussian, Scalar]:
    """Exact posterior and log evidence of ``y_n = J_n tt + eps_n``.

    ``eps_n ~ N(0, L L^T)`` with ``L = noise_scale`` lower-triangular, in the units of
    ``y``. With no rows the prior comes back as it is.
    """
    N, d, p = J.shape
    if N == 0:
        return prior, jnp.zeros((), J.dtype)
    rows = jnp.concatenate([J @ prior.scale, (J @ prior.mean - y)[:, :, None]], axis=2)
    white = jax.vmap(lambda block: solve_triangular(noise_scale, block, lower=True))
    rows = white(rows).reshape(N * d, p + 1)
    fit = linear_fit(rows[:, :-1], rows[:, -1])
    normaliser = N * (log_det_factor(noise_scale) + 0.5 * d * LOG_2PI)
    return fit.posterior(prior), fit.log_joint() - normaliser


def _cost(full: Factor) -> Scalar:
    return 0.5 * full[:, -1] @ full[:, -1]


def _gradient(full: Factor) -> Scalar:
    """``||g_z||_inf / (1 + cost)``, zero for a problem without parameters."""
    g = full[:-1, :-1].T @ full[:-1, -1]
    return jnp.max(jnp.abs(g), initial=0.0) / (1.0 + _cost(full))
