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
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
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
RAISE = 4.0  # of the damping, where a step is refused; twice in turn, by its square
STALE = 1e-2  # posterior sd, of what the linear parameters move without derivatives
T = TypeVar("T")


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


#: Noise and prior at a point, given those until now and the damping of the last step.
Update = Callable[[Point, Noise, AbstractPrior, Scalar], tuple[Noise, AbstractPrior]]


class Ends(NamedTuple):
    """Where descents end: at a step that improves the cost by less, relative.

    Between two updates after at most so many steps; and the last, which goes on to a
    zero gradient, where Newton's step is shorter than ``until`` posterior sd.
    """

    tolerance: float = 1e-4
    most: int = MAX_STEPS
    until: float = 0.0


EXACT = Ends()


class Descent(NamedTuple):
    """Where descents ended: the best point, noise and prior, and the cost of each."""

    at: Point
    noise: Noise
    prior: AbstractPrior
    steps: Int[Array, ""]
    costs: Float[Array, " starts"]


def multi_start(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    e: Float[Array, "W n"],
    noise: Noise,
    update: Update,
    *,
    rounds: int,
    needed: Int[Array, ""] | None = None,
    ends: Ends = EXACT,
) -> Descent:
    """The best of several descents; then ``rounds`` of ``update`` and descent.

    An update is that of the noise, and of what else data choose: a prior's scales. One
    more turn, the last, goes on to a zero gradient. Every descent is a turn of the same
    scan, so that the likelihood is compiled once; a start that is no number, and rounds
    beyond those ``needed``, are compiled and not taken.
    """
    nowhere = _nowhere(likelihood, prior, starts[0], e)
    count = len(starts)
    turns = jnp.arange(count + rounds + 1)
    schedule = jnp.concatenate([starts, jnp.zeros((rounds + 1, starts.shape[1]))])

    def turn(carry: tuple, x: tuple[Array, ...]) -> tuple[tuple, Array]:
        best, noise, prior, damping, steps = carry
        start, index = x
        searching, last = index < count, index == count + rounds
        taken = count + (rounds if needed is None else needed)
        idle = jnp.where(searching, jnp.isnan(start).any(), ~last & (index >= taken))
        # The last turn only finishes the one before it.
        stay = searching | last | idle
        updated = update(best, noise, prior, damping)
        noise, prior = _select(stay, (noise, prior), updated)
        again = point(best.z, best.e, best.blocks, prior.rows(best.z), noise)
        again = relaxed(prior, again, noise)
        here = _select(searching, nowhere, again)
        kind = searching, last, idle
        terms = likelihood, prior
        found, last_damping, more = _descend(terms, here, (start, e), kind, noise, ends)
        # A cost that is not finite never wins; a comparison with NaN is false.
        better = jnp.where(searching, found.cost < best.cost, True)
        best = _select(better, found, best)
        damping = jnp.where(better & ~idle, last_damping, damping)
        steps = jnp.where(last, more, steps + more)
        return (best, noise, prior, damping, steps), found.cost

    known = noise, jax.tree.map(jnp.asarray, prior), jnp.zeros(())
    carry = (nowhere, *known, jnp.zeros((), int))
    carry, costs = jax.lax.scan(turn, carry, (schedule, turns))
    best, noise, prior, _, steps = carry
    return Descent(best, noise, prior, steps, costs[:count])


def _nowhere(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
) -> Point:
    """No number: where nothing finite is ever found, nothing must look like a fit."""
    args = prior.gaussian.at(z), e, prior.gaussian.scale
    blocks = jax.eval_shape(likelihood.blocks, *args)
    rows, zero = jax.eval_shape(prior.rows, z), jnp.zeros_like(z)
    blocks, rows = (jnp.full(x.shape, jnp.nan, x.dtype) for x in (blocks, rows))
    cost, scores = jnp.asarray(jnp.inf, z.dtype), jnp.zeros((len(e), z.size))
    return Point(zero, e, blocks, rows, cost, zero, jnp.zeros_like(e), scores)


def _descend(
    terms: tuple[AbstractLikelihood, AbstractPrior],
    here: Point,
    start: tuple[Float[Array, " p"], Float[Array, "W n"]],
    kind: tuple[Bool[Array, ""], ...],
    noise: Noise,
    ends: Ends,
) -> tuple[Point, Scalar, Int[Array, ""]]:
    """Levenberg-Marquardt from ``start`` where that is fresh, else from ``here``.

    Its damping at the end comes back, and its steps. A turn's ``kind``: fresh, to a
    zero gradient, none at all. The damping follows the ratio of the actual to the
    predicted reduction of the cost (Nielsen 1999).
    """

    fresh, exact, idle = kind

    def improve(carry: tuple) -> tuple:
        here, tried, count, _, stale, again = carry
        damping, _ = tried
        dz, de, predicted = step(terms[1], here, noise, damping)
        first = fresh & (count == 0)
        z = jnp.where(again, here.z, terms[1].moved(here.z, dz))
        z, e = jnp.where(first, start[0], z), jnp.where(again, here.e, here.e + de)
        found = evaluate(*terms, z, jnp.where(first, start[1], e), noise)
        there = relaxed(terms[1], found, noise)
        keep, next_damping = judged(here, there, predicted, *tried)
        gained = here.cost - there.cost > ends.tolerance * (1.0 + there.cost)
        last = _is_last(here, keep, predicted, damping, ends)
        settled = jnp.where(exact, last, keep & ~gained)
        # A start has nothing to be compared with, nor has a place that is seen again.
        tried = _select(first | again, tried, next_damping)
        keep = keep | again
        stale = jnp.where(keep, _is_stale(found, there), stale)
        here = _select(keep, there, here)
        return here, tried, count + 1, settled & ~again, stale, stale & ~keep

    def unfinished(carry: tuple) -> Array:
        here, (damping, _), count, settled, _, again = carry
        finite = jnp.isfinite(here.cost)
        small = finite & (here.gradient <= 0.1 * GRADIENT_TOLERANCE)
        many = count > jnp.where(fresh | exact, MAX_STEPS, ends.most)
        hopeless = ~finite | ~(damping < MOST_DAMPING) | many
        hopeless = (~fresh | (count > 0)) & hopeless  # a fresh start has no cost yet
        # Two steps at least: a gradient may be small next to a large cost.
        done = settled | jnp.where(exact, small & (count >= 2), small)
        return ~(done & ~again) & ~hopeless & ~idle

    damping = jnp.where(exact, 0.0, jnp.where(fresh, FIRST_DAMPING, AGAIN_DAMPING))
    stale = ~fresh & bool(terms[1].linear)  # another prior has moved what is linear
    no = jnp.zeros((), bool)
    tried = damping, jnp.zeros(())  # no step is refused yet
    carry = (here, tried, jnp.zeros((), int), no, stale, no)
    here, (damping, _), count, *_ = jax.lax.while_loop(unfinished, improve, carry)
    return here, damping, count


def _is_last(
    here: Point,
    keep: Bool[Array, ""],
    predicted: Scalar,
    damping: Scalar,
    ends: Ends,
) -> Bool[Array, ""]:
    """Whether a step ends a descent to a zero gradient."""
    flat, short = JOINT_TOLERANCE
    undamped = damping < LEAST_DAMPING
    near = keep & (predicted < 0.5 * ends.until**2)
    # Differences of a simulator on the host hide what such a step would gain.
    vain = ~keep & (predicted <= 0.5 * short**2) & (here.gradient <= flat)
    return undamped & (near | vain)


def _is_stale(found: Point, there: Point) -> Bool[Array, ""]:
    """Whether derivatives at one point are no longer those where linear ones moved to.

    They are taken again where a step along them is refused.
    """
    return found.cost - there.cost > 0.5 * STALE**2


def judged(
    here: Point,
    there: Point,
    predicted_reduction: AnyScalar,
    damping: Scalar,
    refused: Scalar,
) -> tuple[Bool[Array, ""], tuple[Scalar, Scalar]]:
    """Whether a step is kept, the next one's damping, and how many were refused."""
    actual_reduction = here.cost - there.cost
    # Rounding in the cost must not refuse the last, gradient-only digits.
    slack = 1e-12 * (1.0 + there.cost)
    flatter = there.gradient < here.gradient
    lost_in_rounding = (jnp.abs(actual_reduction) <= slack) & flatter
    keep = (actual_reduction > slack) | lost_in_rounding
    ratio = actual_reduction / predicted_reduction
    ratio = jnp.where(lost_in_rounding, 1.0, ratio)  # rounding has none
    refused = jnp.where(keep, 0.0, refused + 1.0)
    return keep, (next_damping(damping, refused, ratio), refused)


def next_damping(damping: AnyScalar, refused: AnyScalar, ratio: AnyScalar) -> Any:
    """The damping after a step that saved ``ratio`` times what it should.

    Each step that is refused in turn, ``refused`` until now, raises it by more (Nielsen
    1999).
    """
    xp = library(ratio)
    lowered = damping * xp.clip(1.0 - (2.0 * ratio - 1.0) ** 3, 0.1, 2.0)
    raised = RAISE**refused * xp.maximum(damping, LEAST_DAMPING)
    return xp.where(refused == 0, lowered, raised)


def step(
    prior: AbstractPrior, here: Point, noise: Noise, damping: AnyScalar
) -> tuple[Float[AnyArray, " p"], Float[AnyArray, "W n"], AnyScalar]:
    """The damped step of the whole problem, and the cost that it should save."""
    xp = library(here.z)
    damping = xp.where(damping < LEAST_DAMPING, 0.0, damping)
    arrow = eliminate(here.blocks, here.e, noise, damping)
    # What the model is linear in needs no damping, and follows the others.
    curved = np.delete(np.arange(here.z.size), np.asarray(prior.linear, int))
    damped = xp.sqrt(damping) * xp.eye(here.z.size, here.z.size + 1)[curved]
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


def relaxed(prior: AbstractPrior, here: Point, noise: Noise) -> Point:
    """The same with the parameters that the model is linear in at their best.

    Variable projection (Golub and Pereyra 1973; Kaufman 1975): a valley that is curved
    only because these follow the others is none then. It asks for no linearisation; the
    derivatives by the others are those of the point before.
    """
    if not prior.linear:
        return here
    w = np.asarray(prior.linear)
    white, own = noise.scale(here.blocks), here.e.shape[1] + w
    data = white[..., np.append(own, -1)].reshape(-1, len(w) + 1)
    full = stack(data, here.prior[:, np.append(w, -1)])
    dw = -solve_triangular(full[:-1, :-1], full[:-1, -1])
    z = here.z.at[w].add(dw)
    r = here.blocks[..., -1] + here.blocks[..., own] @ dw
    blocks = here.blocks.at[..., -1].set(r)
    rows = here.prior.at[:, -1].add(here.prior[:, w] @ dw)
    return point(z, here.e, blocks, rows, noise)


def _select(yes: Bool[Array, ""], new: T, old: T) -> T:
    chosen: T = jax.tree.map(lambda a, b: jnp.where(yes, a, b), new, old)
    return chosen
