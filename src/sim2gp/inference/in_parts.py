"""The fit of more data than fit into memory: one part after the other, in passes.

A pass linearises every part at the parameters and nuisances that are known, and keeps
what is small: the factor of each part (they stack), and of each window what eliminates
its nuisances. Then comes Gauss and Newton's step of all parameters and nuisances, and a
step of EM for the noise. Steps are not damped: the first fit, of some of the data, ends
near. Where passes rest, the estimate is that of all data at once.
"""

from collections.abc import Iterator
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.compilation import compile_async
from sim2gp.inference.arrowhead import Blocks, Elimination, Noise, eliminate
from sim2gp.inference.estimate import Estimate, about_point
from sim2gp.inference.laplace import Laplace, expected_noise
from sim2gp.inference.least_squares import Factor, gauss_newton_step, stack
from sim2gp.inference.levenberg_marquardt import Point, blocks_of, point
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import triangular
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import AnyArray, AnyScalar, in_float64

#: Passes at most; Newton's step in posterior sd, and the noise's relative change, where
#: they end.
MOST, SHORT, STILL = 50, 1e-9, 1e-7


@runtime_checkable
class DataInParts(Protocol):
    """Data of `AbstractLikelihood`, as likelihoods of some windows after the other."""

    counts: Float[np.ndarray, "W c"]
    floor: Float[np.ndarray, " c"]

    def parts(self) -> Iterator[tuple[Int[np.ndarray, " w"], AbstractLikelihood]]:
        """Numbers of windows, and their likelihood; the last is filled up."""


class _OfWindows(NamedTuple):
    """What is kept of each window: of `Point`, `Elimination` and `Laplace.squares`."""

    blocks: Blocks
    by_e: Float[AnyArray, "W n"]
    scores: Float[AnyArray, "W p"]
    R11: Float[AnyArray, "W n n"]
    slope: Float[AnyArray, "W n p1"]
    squares: Float[AnyArray, "W c"]
    spread: Float[AnyArray, "W c"]


class _Part(NamedTuple):
    """A part linearised, without the prior."""

    cost: AnyScalar
    by_z: Float[AnyArray, " p"]
    data: Factor
    windows: _OfWindows


@in_float64
def estimate_in_parts(
    data: DataInParts, prior: AbstractPrior, first: Estimate, freedom: float
) -> Estimate:
    """From ``first``, a fit of some of the data with nuisances and weights of all.

    Whether the passes rest is said by `Convergence`.
    """
    z, e, noise = first.z(), np.asarray(first.nuisances), first.noise
    noise = Noise(np.asarray(noise.sd), np.asarray(noise.weights))
    scales = first.posterior.scale, prior.gaussian.scale
    R = triangular(np.linalg.solve(*map(np.asarray, scales)))
    full, change = np.pad(R, (0, 1)), np.inf
    for steps in range(1, MOST + 1):
        found, squares = _passed(data, prior, z, e, noise, full)
        rests = found.newton_step_sd() <= SHORT and change <= STILL
        if rests or steps == MOST:
            break
        learned = expected_noise(noise, *squares, data.counts, data.floor, freedom)
        change = np.max(np.abs(np.log(learned.sd / noise.sd)))
        dz = gauss_newton_step(found.full)
        slope = found.arrow.slope
        e = e - (slope[..., -1] + slope[..., :-1] @ dz)
        z, noise, full = z + dz, learned, found.full
        del found, squares, slope  # of all windows, as what the next pass makes
    ended = about_point(found, noise, prior, data.counts, steps)
    known: Estimate = jax.device_put(ended)
    return known


def _passed(
    data: DataInParts,
    prior: AbstractPrior,
    z: Float[AnyArray, " p"],
    e: Float[np.ndarray, "W n"],
    noise: Noise,
    full: Factor,
) -> tuple[Laplace, tuple[Float[np.ndarray, "W c"], Float[np.ndarray, "W c"]]]:
    """All parts linearised and put together with the prior; `Laplace.squares`."""
    z, rows = np.asarray(z), np.asarray(prior.rows(z))
    offset = rows[:, -1]
    cost, by_z = 0.5 * offset @ offset, rows[:, :-1].T @ offset
    factors, each = [], None
    for own, likelihood in data.parts():
        which = np.resize(own, len(likelihood.counts))
        here = Noise(noise.sd, noise.weights[which])
        part = jax.device_get(_linearised(likelihood, prior, z, e[which], here, full))
        cost, by_z = cost + part.cost, by_z + part.by_z
        factors.append(part.data)
        each = each or _for_all(part.windows, len(e))
        for whole, some in zip(each, part.windows, strict=True):
            whole[own] = some[: len(own)]
    assert each is not None
    at = Point(z, e, each.blocks, rows, cost, by_z, each.by_e, each.scores)
    R = stack(*factors)
    found = Laplace(at, Elimination(R, each.R11, each.slope), stack(R, rows))
    return found, (each.squares, each.spread)


def _for_all(some: _OfWindows, count: int) -> _OfWindows:
    """Room for so many windows: to join parts at the end takes twice the memory."""
    return _OfWindows(*(np.empty((count, *x.shape[1:]), x.dtype) for x in some))


@compile_async
def _linearised(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[AnyArray, " p"],
    e: Float[AnyArray, "W n"],
    noise: Noise,
    full: Factor,
) -> _Part:
    """Of one part, without the prior; ``full`` is the posterior's factor as known."""
    none = jnp.zeros((0, z.size + 1))
    at = point(z, e, blocks_of(likelihood, prior, z, e), none, noise)
    arrow = eliminate(at.blocks, e, noise)
    squares = Laplace(at, arrow, full).squares()
    # The factors of all windows are what does not fit into memory.
    none = at.blocks[:, :, :0]
    own = _OfWindows(none, at.by_e, at.scores, arrow.R11, arrow.slope, *squares)
    return _Part(at.cost, at.by_z, arrow.data, own)
