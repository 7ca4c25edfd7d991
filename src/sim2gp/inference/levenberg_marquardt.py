"""MAP and Laplace posterior of least squares whose data have nuisance unknowns.

Windows ``w`` of data share the whitened unknowns ``z`` (p), each has its own ``e_w``
(n, possibly none), and each channel ``c`` its noise:

    L(z, e) = 1/2 sum_w [ w_w sum_c ||r_wc(z, e_w)||^2 / sig_c^2 + ||e_w||^2 ]
              + 1/2 ||z||^2 + 1/2 ||r_known(z)||^2

(``r_known``: sums of constants that were weighed, in their sd.)

Levenberg-Marquardt adds ``sqrt(mu) I`` to both parts of the eliminated system
(`sim2gp.inference.arrowhead`), so its step is the damped step of the whole problem;
memory and time are linear in the data. One copy of the likelihood is compiled, in the
one loop that descends.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.inference.arrowhead import Blocks, Elimination, Noise, eliminate
from sim2gp.inference.gaussian import LOG_2PI, Gaussian
from sim2gp.inference.least_squares import (
    Factor,
    gauss_newton_step,
    log_joint,
    posterior,
    with_prior,
)
from sim2gp.inference.linalg import eigh, solve_triangular
from sim2gp.types import Scalar

CONVERGED, STALLED, NOT_FINITE = 0, 1, 2
#: Of the gradient over ``1 + cost``, or in posterior sds (`Fit.left`): rounding keeps
#: the first one of data without noise above it.
GRADIENT_TOLERANCE = 1e-8
#: Of the first and the second at once, which also make a MAP: no nearer comes a descent
#: on differences of a simulator on the host.
JOINT_TOLERANCE = 1e-6, 1e-4
#: Steps of the last descent. Under misfit, and where a bound saturates (measured: by
#: 0.9 a step), Gauss-Newton converges linearly, not in two.
MAX_STEPS = 300
FIRST_DAMPING = 1.0  # the prior's own precision: trust one prior standard deviation
AGAIN_DAMPING = 1e-2  # of a descent that follows another
LEAST_DAMPING = 1e-5  # below this the step is undamped
MOST_DAMPING = 1e14


class AbstractLikelihood(eqx.Module):
    """What a descent asks of data and simulator; both whitened by the prior."""

    @abstractmethod
    def blocks(self, z: Float[Array, " p"], e: Float[Array, "W n"]) -> Blocks:
        """The factors at a point, of residuals in the channels' own units."""

    @abstractmethod
    def known(self, z: Float[Array, " p"]) -> Float[Array, "q p1"]:
        """Rows ``[K r]`` of what is known of the parameters beside their prior."""

    @abstractmethod
    def curvature(
        self, z: Float[Array, " p"], gradient: Float[Array, " p"]
    ) -> Float[Array, "p p"]:
        """The Hessian that the parameters' maps add, given the data's gradient.

        It shapes steps only, never the posterior: where a bound saturates it is several
        times Gauss-Newton's, and steps without it zigzag or crawl.
        """


class Point(eqx.Module):
    """One linearisation, and how good it is under some noise."""

    z: Float[Array, " p"]
    e: Float[Array, "W n"]
    blocks: Blocks
    known: Float[Array, "q p1"]
    cost: Scalar
    by_z: Float[Array, " p"]  # gradient of the cost
    by_e: Float[Array, "W n"]

    @property
    def gradient(self) -> Scalar:
        """``||g||_inf / (1 + cost)``; zero for a problem without unknowns."""
        largest = jnp.maximum(
            jnp.max(jnp.abs(self.by_z), initial=0.0),
            jnp.max(jnp.abs(self.by_e), initial=0.0),
        )
        return largest / (1.0 + self.cost)


class Fit(eqx.Module):
    """A MAP in whitened coordinates, with everything that follows from its factor."""

    at: Point
    arrow: Elimination
    full: Factor  # of data, prior and what is known beside it
    left: Scalar  # largest entry of the undamped step to the MAP, in posterior sd
    status: Int[Array, ""]
    steps: Int[Array, ""]

    @property
    def z(self) -> Float[Array, " p"]:
        """The MAP."""
        return self.at.z

    @property
    def e(self) -> Float[Array, "W n"]:
        """The nuisances at the MAP."""
        return self.at.e

    @property
    def cost(self) -> Scalar:
        """The negative log joint that was minimised, without constants."""
        return self.at.cost

    @property
    def gradient(self) -> Scalar:
        """What remains of the gradient, relative to 1 + cost."""
        return self.at.gradient

    @property
    def data(self) -> Factor:
        """Factor of the data alone."""
        return self.arrow.data

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
        return posterior(self.full, self.z, prior)

    def log_joint(self) -> Scalar:
        """``-L - 1/2 logdet(S0 Sq^-1)``, nats, over ``z`` and the nuisances.

        The Laplace evidence, but for the normalisation of the noise.
        """
        pivots = jnp.diagonal(self.arrow.R11, axis1=1, axis2=2)
        return log_joint(self.full) - jnp.sum(jnp.log(pivots))

    def log_evidence(self, noise: Noise, count: Float[Array, "W c"]) -> Scalar:
        """Laplace's evidence of ``count`` samples per window and channel, nats.

            log_joint - sum_wc count_wc [log sig_c + 1/2 log(2 pi) - 1/2 log w_w]

        ``noise`` is that of the fit.
        """
        N = jnp.sum(count, axis=0)
        normaliser = jnp.sum(N * (jnp.log(noise.sd) + 0.5 * LOG_2PI))
        weighted = 0.5 * jnp.sum(jnp.sum(count, axis=1) * jnp.log(noise.weights))
        return self.log_joint() - normaliser + weighted

    def squares(self) -> tuple[Float[Array, "W c"], Float[Array, "W c"]]:
        """Squared residuals, and squares that the posterior's own spread adds."""
        n = self.e.shape[1]
        own, rest = self.at.blocks[..., :n], self.at.blocks[..., n:]
        # Rows of (z, r) with the nuisances at their best.
        reduced = rest - own @ self.arrow.slope[:, None]
        eye = jnp.eye(n)
        root = jax.vmap(lambda R11: solve_triangular(R11, eye))(self.arrow.R11)
        spread = jnp.sum((reduced[..., :-1] @ self.scale()) ** 2, axis=(2, 3))
        spread = spread + jnp.sum((own @ root[:, None]) ** 2, axis=(2, 3))
        return jnp.sum(reduced[..., -1] ** 2, axis=2), spread

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
                expected="data that depend on one of them at least",
                fix="check the columns, the excitation and what is fixed",
            )
        if status == STALLED:
            raise NotConverged(
                "E201",
                "the MAP did not converge",
                where=where,
                got=f"scaled gradient {float(self.gradient):.1e} "
                f"({float(self.left):.1e} posterior sd) after {int(self.steps)} steps",
                expected=f"at most {GRADIENT_TOLERANCE:.0e}",
                fix="check units and bounds, or add starts",
            )


def minimise(
    likelihood: AbstractLikelihood,
    start: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
) -> Fit:
    """One Levenberg-Marquardt descent to a zero gradient, and its verdict."""
    one = start[None]
    return multi_start(likelihood, one, e, noise, lambda _, noise: noise, rounds=0)[0]


def multi_start(
    likelihood: AbstractLikelihood,
    starts: Float[Array, "starts p"],
    e: Float[Array, "W n"],
    noise: Noise,
    update: Callable[[Fit, Noise], Noise],
    *,
    rounds: int,
    needed: Int[Array, ""] | None = None,
    tolerance: float = 1e-4,
) -> tuple[Fit, Noise, Float[Array, " starts"]]:
    """The best of several descents; then ``rounds`` of noise update and descent (EM).

    A descent ends where a step improves the cost by less than ``tolerance`` relative;
    one more turn, the last, goes on to a zero gradient. Every descent is a turn of the
    same scan, so that the likelihood is compiled once; a start that is no number, and
    rounds beyond those ``needed``, are compiled and not taken. Returns the fit, its
    noise, and the cost that each start reached.
    """
    p = starts.shape[1]
    blank = jax.eval_shape(likelihood.blocks, starts[0], e)
    infinite = jnp.asarray(jnp.inf, starts.dtype)
    # No number: where nothing finite is ever found, nothing must look like a fit.
    unknown = jnp.full(blank.shape, jnp.nan, blank.dtype)
    zero, rows = jnp.zeros(p), jax.eval_shape(likelihood.known, starts[0])
    known = jnp.full(rows.shape, jnp.nan, rows.dtype)
    nowhere = Point(zero, e, unknown, known, infinite, zero, jnp.zeros_like(e))
    count = len(starts)
    turns = jnp.arange(count + rounds + 1)
    schedule = jnp.concatenate([starts, jnp.zeros((rounds + 1, p))])

    def turn(carry: tuple, x: tuple[Array, ...]) -> tuple[tuple, Array]:
        best, noise, steps = carry
        start, index = x
        searching, last = index < count, index == count + rounds
        taken = count + (rounds if needed is None else needed)
        idle = jnp.where(searching, jnp.isnan(start).any(), ~last & (index >= taken))
        # The last turn only finishes the one before it.
        settled = update(_verdict(best, noise, steps), noise)
        stay = searching | last | idle
        noise = jax.tree.map(lambda new, old: jnp.where(stay, old, new), settled, noise)
        again = point(best.z, best.e, best.blocks, best.known, noise)
        here = _select(searching, nowhere, again)
        kind = searching, last, idle
        found, more = _descend(likelihood, here, (start, e), kind, noise, tolerance)
        # A cost that is not finite never wins; a comparison with NaN is false.
        better = jnp.where(searching, found.cost < best.cost, True)
        best = _select(better, found, best)
        return (best, noise, jnp.where(last, more, steps + more)), found.cost

    carry = (nowhere, noise, jnp.zeros((), int))
    (best, noise, steps), costs = jax.lax.scan(turn, carry, (schedule, turns))
    return _verdict(best, noise, steps), noise, costs[:count]


def _descend(
    likelihood: AbstractLikelihood,
    here: Point,
    start: tuple[Float[Array, " p"], Float[Array, "W n"]],
    kind: tuple[Bool[Array, ""], ...],
    noise: Noise,
    tolerance: float,
) -> tuple[Point, Int[Array, ""]]:
    """Levenberg-Marquardt from ``start`` where that is fresh, else from ``here``.

    A turn's ``kind``: fresh, to a zero gradient, none at all. The damping follows the
    ratio of gained to promised cost (Nielsen 1999).
    """

    fresh, exact, idle = kind

    def improve(carry: tuple) -> tuple:
        here, damping, count, _ = carry
        dz, de, promise = _step(likelihood, here, noise, damping)
        first = fresh & (count == 0)
        z = jnp.where(first, start[0], here.z + dz)
        e = jnp.where(first, start[1], here.e + de)
        there = point(z, e, likelihood.blocks(z, e), likelihood.known(z), noise)
        gained = here.cost - there.cost
        # Rounding in the cost must not refuse the last, gradient-only digits.
        slack = 1e-12 * (1.0 + there.cost)
        lost_in_rounding = (jnp.abs(gained) <= slack) & (there.gradient < here.gradient)
        keep = (gained > slack) | lost_in_rounding
        settled = keep & (gained <= tolerance * (1.0 + there.cost))
        # Differences of a simulator on the host hide what such a step would gain.
        flat, near = JOINT_TOLERANCE
        vain = ~keep & (damping < LEAST_DAMPING) & (promise <= 0.5 * near**2)
        settled = jnp.where(exact, vain & (here.gradient <= flat), settled)
        ratio = jnp.where(lost_in_rounding, 1.0, gained / promise)  # rounding has none
        lowered = damping * jnp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
        raised = 4.0 * jnp.maximum(damping, LEAST_DAMPING)
        # A start has nothing to be compared with.
        damping = jnp.where(first, damping, jnp.where(keep, lowered, raised))
        return _select(keep, there, here), damping, count + 1, settled

    def unfinished(carry: tuple) -> Array:
        here, damping, count, settled = carry
        finite = jnp.isfinite(here.cost)
        small = finite & (here.gradient <= 0.1 * GRADIENT_TOLERANCE)
        hopeless = ~finite | ~(damping < MOST_DAMPING) | (count > MAX_STEPS)
        hopeless = (count > 0) & hopeless
        # Two steps at least: a gradient that is small beside a large cost is not zero.
        done = settled | jnp.where(exact, small & (count >= 2), small)
        return ~done & ~hopeless & ~idle

    damping = jnp.where(exact, 0.0, jnp.where(fresh, FIRST_DAMPING, AGAIN_DAMPING))
    carry = (here, damping, jnp.zeros((), int), jnp.zeros((), bool))
    here, _, count, _ = jax.lax.while_loop(unfinished, improve, carry)
    return here, count


def _step(
    likelihood: AbstractLikelihood, here: Point, noise: Noise, damping: Scalar
) -> tuple[Float[Array, " p"], Float[Array, "W n"], Scalar]:
    """The damped step of the whole problem, and what it should gain."""
    damping = jnp.where(damping < LEAST_DAMPING, 0.0, damping)
    arrow = eliminate(here.blocks, here.e, noise, damping)
    damped = jnp.sqrt(damping) * jnp.eye(here.z.size, here.z.size + 1)
    full = with_prior(arrow.data, here.z, here.known, damped)
    # Whitened by R, the maps' curvature is a change of the identity. Only where it is
    # positive: it may shorten the QR's step; longer ones were measured to go astray.
    R, c = full[:-1, :-1], full[:-1, -1]
    S = likelihood.curvature(here.z, here.by_z - here.z)
    left = solve_triangular(R, S, transposed=True)
    values, vectors = eigh(solve_triangular(R, left.T, transposed=True))
    c = vectors @ ((vectors.T @ c) / (1.0 + jnp.maximum(values, 0.0)))
    dz = -solve_triangular(R, c)
    de = -(arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz)
    promise = damping * (dz @ dz + jnp.sum(de**2))
    promise = 0.5 * (promise - here.by_z @ dz - jnp.sum(here.by_e * de))
    return dz, de, promise


def point(
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
    blocks: Blocks,
    known: Float[Array, "q p1"],
    noise: Noise,
) -> Point:
    """Cost and gradient under a noise, of a linearisation."""
    white, n = noise.scale(blocks), e.shape[1]
    r, apart = white[..., -1], known[:, -1]
    cost = 0.5 * (jnp.sum(r**2) + jnp.sum(e**2) + z @ z + apart @ apart)
    g = jnp.einsum("wckj,wck->wj", white[..., :-1], r)
    by_z = jnp.sum(g[:, n:], axis=0) + z + known[:, :-1].T @ apart
    return Point(z, e, blocks, known, cost, by_z, g[:, :n] + e)


def _verdict(best: Point, noise: Noise, steps: Int[Array, ""]) -> Fit:
    arrow = eliminate(best.blocks, best.e, noise)
    full = with_prior(arrow.data, best.z, best.known)
    left = _left(arrow, full)
    there = (best.gradient <= GRADIENT_TOLERANCE) | (left <= GRADIENT_TOLERANCE)
    flat, near = JOINT_TOLERANCE
    there |= (best.gradient <= flat) & (left <= near)
    status = jnp.where(there, CONVERGED, STALLED)
    finite = jnp.isfinite(best.cost) & jnp.all(jnp.isfinite(full))
    status = jnp.where(finite, status, NOT_FINITE)
    return Fit(best, arrow, full, left, status, steps)


def _left(arrow: Elimination, full: Factor) -> Scalar:
    """The largest entry of the undamped step, each in its own posterior sd."""
    dz = gauss_newton_step(full)  # R dz = -c
    de = arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz
    own = jnp.einsum("wij,wj->wi", arrow.R11, de)
    largest = (jnp.max(jnp.abs(x), initial=0.0) for x in (full[:-1, -1], own))
    return jnp.maximum(*largest)


def _select(yes: Bool[Array, ""], new: Point, old: Point) -> Point:
    chosen: Point = jax.tree.map(lambda a, b: jnp.where(yes, a, b), new, old)
    return chosen
