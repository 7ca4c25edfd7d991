"""Levenberg-Marquardt: the MAP of least squares whose data have nuisance unknowns.

Windows ``w`` of data share the whitened unknowns ``z`` (p), each has its own ``e_w``
(n, possibly none), and each channel ``c`` its noise:

    L(z, e) = 1/2 sum_w [ w_w sum_c ||r_wc(z, e_w)||^2 / sig_c^2 + ||e_w||^2 ]
              + 1/2 ||r_prior(z)||^2

(``r_prior``: ``z`` itself, and what was measured of the parameters, in sd.)

Levenberg-Marquardt adds ``sqrt(mu) I`` to both parts of the eliminated system
(`sim2gp.inference.arrowhead`), so its step is the damped step of the whole problem;
memory and time are linear in the data. One copy of the likelihood is compiled, in the
one loop that descends.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.inference.arrowhead import Blocks, Noise, eliminate
from sim2gp.inference.least_squares import stack
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import eigh, library, solve_triangular
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import AnyArray, AnyScalar, Scalar

#: Of the gradient over ``1 + cost``, or of a Newton step in posterior sd: rounding
#: keeps the first one of data without noise above it.
GRADIENT_TOLERANCE = 1e-8
#: Of the first and the second at once, which also make a MAP: a descent on differences
#: of a simulator on the host comes no nearer.
JOINT_TOLERANCE = 1e-6, 1e-4
#: Steps of the last descent. Under misfit, and where a bound saturates (measured: by
#: 0.9 a step), Gauss-Newton converges linearly, not in two.
MAX_STEPS = 300
FIRST_DAMPING = 1.0  # the prior's own precision: trust one prior standard deviation
AGAIN_DAMPING = 1e-2  # of a descent that follows another
LEAST_DAMPING = 1e-5  # below this the step is undamped
MOST_DAMPING = 1e14


class Point(eqx.Module):
    """One linearisation, and how good it is under some noise."""

    z: Float[AnyArray, " p"]
    e: Float[AnyArray, "W n"]
    blocks: Blocks
    prior: Float[AnyArray, "q p1"]  # rows of the prior
    cost: AnyScalar
    by_z: Float[AnyArray, " p"]  # gradient of the cost
    by_e: Float[AnyArray, "W n"]
    scores: Float[AnyArray, "W p"]  # what each window's data add to ``by_z``

    @property
    def gradient(self) -> AnyScalar:
        """``||g||_inf / (1 + cost)``; zero for a problem without unknowns."""
        xp = library(self.by_z)
        largest = xp.maximum(
            xp.max(xp.abs(self.by_z), initial=0.0),
            xp.max(xp.abs(self.by_e), initial=0.0),
        )
        return largest / (1.0 + self.cost)


class Descent(NamedTuple):
    """Where descents ended: the best point, the noise there, and the cost of each."""

    at: Point
    noise: Noise
    steps: Int[Array, ""]
    costs: Float[Array, " starts"]


def multi_start(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    e: Float[Array, "W n"],
    noise: Noise,
    update: Callable[[Point, Noise], Noise],
    *,
    rounds: int,
    needed: Int[Array, ""] | None = None,
    tolerance: float = 1e-4,
) -> Descent:
    """The best of several descents; then ``rounds`` of noise update and descent.

    A descent ends where a step improves the cost by less than ``tolerance`` relative;
    one more turn, the last, goes on to a zero gradient. Every descent is a turn of the
    same scan, so that the likelihood is compiled once; a start that is no number, and
    rounds beyond those ``needed``, are compiled and not taken.
    """
    p, W = starts.shape[1], len(e)
    first = prior.gaussian.at(starts[0])
    blank = jax.eval_shape(likelihood.blocks, first, e, prior.gaussian.scale)
    infinite = jnp.asarray(jnp.inf, starts.dtype)
    # No number: where nothing finite is ever found, nothing must look like a fit.
    unknown = jnp.full(blank.shape, jnp.nan, blank.dtype)
    zero, rows = jnp.zeros(p), jax.eval_shape(prior.rows, starts[0])
    rows = jnp.full(rows.shape, jnp.nan, rows.dtype)
    none = jnp.zeros_like(e), jnp.zeros((W, p))
    nowhere = Point(zero, e, unknown, rows, infinite, zero, *none)
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
        settled = update(best, noise)
        stay = searching | last | idle
        noise = jax.tree.map(lambda new, old: jnp.where(stay, old, new), settled, noise)
        again = point(best.z, best.e, best.blocks, best.prior, noise)
        here = _select(searching, nowhere, again)
        kind = searching, last, idle
        terms = likelihood, prior
        found, more = _descend(terms, here, (start, e), kind, noise, tolerance)
        # A cost that is not finite never wins; a comparison with NaN is false.
        better = jnp.where(searching, found.cost < best.cost, True)
        best = _select(better, found, best)
        return (best, noise, jnp.where(last, more, steps + more)), found.cost

    carry = (nowhere, noise, jnp.zeros((), int))
    (best, noise, steps), costs = jax.lax.scan(turn, carry, (schedule, turns))
    return Descent(best, noise, steps, costs[:count])


def _descend(
    terms: tuple[AbstractLikelihood, AbstractPrior],
    here: Point,
    start: tuple[Float[Array, " p"], Float[Array, "W n"]],
    kind: tuple[Bool[Array, ""], ...],
    noise: Noise,
    tolerance: float,
) -> tuple[Point, Int[Array, ""]]:
    """Levenberg-Marquardt from ``start`` where that is fresh, else from ``here``.

    A turn's ``kind``: fresh, to a zero gradient, none at all. The damping follows the
    ratio of the actual to the predicted reduction of the cost (Nielsen 1999).
    """

    fresh, exact, idle = kind

    def improve(carry: tuple) -> tuple:
        here, damping, count, _ = carry
        dz, de, predicted_reduction = step(terms[1], here, noise, damping)
        first = fresh & (count == 0)
        z = jnp.where(first, start[0], here.z + dz)
        e = jnp.where(first, start[1], here.e + de)
        there = evaluate(*terms, z, e, noise)
        keep, next_damping = judged(here, there, predicted_reduction, damping)
        gain = here.cost - there.cost
        settled = keep & (gain <= tolerance * (1.0 + there.cost))
        # Differences of a simulator on the host hide what such a step would gain.
        flat, short = JOINT_TOLERANCE
        vain = predicted_reduction <= 0.5 * short**2
        vain = ~keep & (damping < LEAST_DAMPING) & vain
        settled = jnp.where(exact, vain & (here.gradient <= flat), settled)
        # A start has nothing to be compared with.
        damping = jnp.where(first, damping, next_damping)
        return _select(keep, there, here), damping, count + 1, settled

    def unfinished(carry: tuple) -> Array:
        here, damping, count, settled = carry
        finite = jnp.isfinite(here.cost)
        small = finite & (here.gradient <= 0.1 * GRADIENT_TOLERANCE)
        hopeless = ~finite | ~(damping < MOST_DAMPING) | (count > MAX_STEPS)
        hopeless = (count > 0) & hopeless
        # Two steps at least: a gradient may be small next to a large cost.
        done = settled | jnp.where(exact, small & (count >= 2), small)
        return ~done & ~hopeless & ~idle

    damping = jnp.where(exact, 0.0, jnp.where(fresh, FIRST_DAMPING, AGAIN_DAMPING))
    carry = (here, damping, jnp.zeros((), int), jnp.zeros((), bool))
    here, _, count, _ = jax.lax.while_loop(unfinished, improve, carry)
    return here, count


def judged(
    here: Point, there: Point, predicted_reduction: AnyScalar, damping: Scalar
) -> tuple[Bool[Array, ""], Scalar]:
    """Whether a step is kept, and the damping of the next one (Nielsen 1999)."""
    actual_reduction = here.cost - there.cost
    # Rounding in the cost must not refuse the last, gradient-only digits.
    slack = 1e-12 * (1.0 + there.cost)
    flatter = there.gradient < here.gradient
    lost_in_rounding = (jnp.abs(actual_reduction) <= slack) & flatter
    keep = (actual_reduction > slack) | lost_in_rounding
    ratio = actual_reduction / predicted_reduction
    ratio = jnp.where(lost_in_rounding, 1.0, ratio)  # rounding has none
    return keep, next_damping(damping, keep, ratio)


def next_damping(
    damping: AnyScalar, keep: bool | Bool[Array, ""], ratio: AnyScalar
) -> Any:
    """The damping after a step that saved ``ratio`` times what it should."""
    xp = library(ratio)
    lowered = damping * xp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
    return xp.where(keep, lowered, 4.0 * xp.maximum(damping, LEAST_DAMPING))


def step(
    prior: AbstractPrior, here: Point, noise: Noise, damping: AnyScalar
) -> tuple[Float[AnyArray, " p"], Float[AnyArray, "W n"], AnyScalar]:
    """The damped step of the whole problem, and the cost that it should save."""
    xp = library(here.z)
    damping = xp.where(damping < LEAST_DAMPING, 0.0, damping)
    arrow = eliminate(here.blocks, here.e, noise, damping)
    damped = xp.sqrt(damping) * xp.eye(here.z.size, here.z.size + 1)
    full = stack(arrow.data, here.prior, damped)
    # Whitened by R, the maps' curvature is a change of the identity. Only where it is
    # positive: it may shorten the QR's step; longer ones were measured to go astray.
    R, c = full[:-1, :-1], full[:-1, -1]
    S = prior.curvature(here.z, here.by_z - here.z)
    half = solve_triangular(R, S, transposed=True)
    values, vectors = eigh(solve_triangular(R, half.T, transposed=True))
    c = vectors @ ((vectors.T @ c) / (1.0 + xp.maximum(values, 0.0)))
    dz = -solve_triangular(R, c)
    de = -(arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz)
    damped_squares = damping * (dz @ dz + xp.sum(de**2))
    slope = here.by_z @ dz + xp.sum(here.by_e * de)
    return dz, de, 0.5 * (damped_squares - slope)


def evaluate(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
) -> Point:
    """Data and prior linearised at ``(z, e)``."""
    about = prior.gaussian
    blocks = likelihood.blocks(about.at(z), e, about.scale)
    return point(z, e, blocks, prior.rows(z), noise)


def point(
    z: Float[AnyArray, " p"],
    e: Float[AnyArray, "W n"],
    blocks: Blocks,
    rows: Float[AnyArray, "q p1"],
    noise: Noise,
) -> Point:
    """Cost and gradient under a noise, of a linearisation."""
    xp, white, n = library(z), noise.scale(blocks), e.shape[1]
    r, offset = white[..., -1], rows[:, -1]
    cost = 0.5 * (xp.sum(r**2) + xp.sum(e**2) + offset @ offset)
    g = xp.einsum("wckj,wck->wj", white[..., :-1], r)
    by_z = xp.sum(g[:, n:], axis=0) + rows[:, :-1].T @ offset
    return Point(z, e, blocks, rows, cost, by_z, g[:, :n] + e, g[:, n:])


def _select(yes: Bool[Array, ""], new: Point, old: Point) -> Point:
    chosen: Point = jax.tree.map(lambda a, b: jnp.where(yes, a, b), new, old)
    return chosen
