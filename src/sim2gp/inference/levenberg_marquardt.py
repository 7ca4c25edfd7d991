"""Levenberg-Marquardt: the MAP of least squares whose data have nuisance unknowns.

Windows ``w`` of data share the whitened unknowns ``z`` (p), each has its own ``e_w``
(n, possibly none), and each channel ``c`` its noise:

    L(z, e) = 1/2 sum_w [ w_w sum_c ||r_wc(z, e_w)||^2 / sig_c^2 + ||e_w||^2 ]
              + 1/2 ||r_prior(z)||^2

(``r_prior``: ``z`` itself, and what was measured of the parameters, in sd.)

Levenberg-Marquardt adds ``sqrt(mu) I`` to both parts of the eliminated system
(`sim2gp.inference.arrowhead`), so its step is the damped step of the whole problem;
memory and time are linear in the data. `sim2gp.inference.descent` takes these steps as
one program, `sim2gp.inference.host_descent` where a simulator on the host is asked.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

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
FIRST_DAMPING = 1.0  # the prior's own precision: trust one prior standard deviation
AGAIN_DAMPING = 1e-2  # of a descent that follows another
#: Below this a step is undamped: all directions have the prior's precision at least.
LEAST_DAMPING = 1e-2
MOST_DAMPING = 1e14
RAISED_DAMPING = 0.1  # at least, where a step is refused
RAISE = 4.0  # of the damping, where a step is refused; twice in turn, by its square
STALE = 1e-2  # posterior sd, of what the linear parameters move without derivatives


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


def is_stale(found: Point, there: Point) -> Bool[Array, ""]:
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
    share: float | Scalar = 0.0,
) -> tuple[Bool[Array, ""], tuple[Scalar, Scalar]]:
    """Whether a step is kept, the next one's damping, and how many were refused.

    It is kept where it saves at least this ``share`` of what it should.
    """
    actual_reduction = here.cost - there.cost
    # Rounding in the cost must not refuse the last, gradient-only digits.
    slack = 1e-12 * (1.0 + there.cost)
    flatter = there.gradient < here.gradient
    lost_in_rounding = (jnp.abs(actual_reduction) <= slack) & flatter
    little = actual_reduction < share * predicted_reduction
    keep = ((actual_reduction > slack) & ~little) | lost_in_rounding
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
    raised = RAISE**refused * xp.maximum(damping, RAISED_DAMPING)
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
    return point(z, e, blocks_of(likelihood, prior, z, e), prior.rows(z), noise)


@eqx.filter_jit
def blocks_of(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
) -> Blocks:
    """The data's factors at whitened unknowns; a program of descents traces it once."""
    about = prior.gaussian
    found: Blocks = likelihood.blocks(about.at(z), e, about.scale)
    return found


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
