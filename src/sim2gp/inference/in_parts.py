"""The fit of more data than fit into memory: one part after the other, in passes.

A pass linearises every part at the parameters and nuisances that are known, and keeps
what is small: the factor of each part (they stack), and of each window what eliminates
its nuisances. Then comes Gauss and Newton's step of all parameters and nuisances, and a
step of EM for the noise. Steps are not damped: the first fit, of some of the data, ends
near. Where passes rest, the estimate is that of all data at once.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.inference.arrowhead import Elimination, Noise, eliminate
from sim2gp.inference.estimate import Estimate, about_point
from sim2gp.inference.laplace import Laplace, expected_noise
from sim2gp.inference.least_squares import Factor, gauss_newton_step, stack
from sim2gp.inference.levenberg_marquardt import Point, blocks_of, point
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.linalg import triangular
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import AnyArray, in_float64

#: Passes at most; Newton's step in posterior sd, and the noise's relative change, where
#: they end.
MOST, SHORT, STILL = 50, 1e-9, 1e-7

#: Windows by number, all parts as many (fewer in the last), and their likelihood.
Parts = Callable[[], Iterator[tuple[Int[np.ndarray, " w"], AbstractLikelihood]]]


class _Part(NamedTuple):
    """A part linearised; ``squares`` and ``spread`` are those of `Laplace.squares`."""

    at: Point
    arrow: Elimination
    squares: Float[AnyArray, "W c"]
    spread: Float[AnyArray, "W c"]


@in_float64
def estimate_in_parts(
    parts: Parts,
    counts: Float[np.ndarray, "W c"],
    floor: Float[np.ndarray, " c"],
    prior: AbstractPrior,
    first: Estimate,
    freedom: float,
) -> Estimate:
    """From ``first``, a fit of some of the data with nuisances and weights of all.

    Whether the passes rest is said by `Convergence`.
    """
    z, e, noise = first.z(), np.asarray(first.nuisances), first.noise
    noise = Noise(np.asarray(noise.sd), np.asarray(noise.weights))
    scales = first.posterior.scale, prior.gaussian.scale
    R = triangular(np.linalg.solve(*map(np.asarray, scales)))
    full, change, steps = np.pad(R, (0, 1)), np.inf, 0
    while steps < MOST:
        steps += 1
        at, arrow, squares, spread = _passed(parts, prior, z, e, noise, full)
        found = Laplace(at, arrow, stack(arrow.data, at.prior))
        if found.newton_step_sd() <= SHORT and change <= STILL:
            break
        learned = expected_noise(noise, squares, spread, counts, floor, freedom)
        change = np.max(np.abs(np.log(learned.sd / noise.sd)))
        dz = gauss_newton_step(found.full)
        e = e - (arrow.slope[..., -1] + arrow.slope[..., :-1] @ dz)
        z, noise, full = z + dz, learned, found.full
    ended: Estimate = jax.device_put(about_point(found, noise, prior, counts, steps))
    return ended


def _passed(
    parts: Parts,
    prior: AbstractPrior,
    z: Float[AnyArray, " p"],
    e: Float[np.ndarray, "W n"],
    noise: Noise,
    full: Factor,
) -> _Part:
    """All parts linearised, and put together with the prior."""
    each: list[_Part] = []
    for own, likelihood in parts():
        size = len(likelihood.counts)
        which = np.resize(own, size)
        here = Noise(noise.sd, noise.weights[which])
        found = _linearised(likelihood, prior, z, e[which], here, full)
        each.append(_of_windows(jax.device_get(found), len(own)))
    rows = np.asarray(prior.rows(z))
    offset = rows[:, -1]

    def joined(get: Callable[[_Part], AnyArray]) -> np.ndarray:
        return np.concatenate([get(x) for x in each])

    cost = sum(x.at.cost for x in each) + 0.5 * offset @ offset
    by_z = sum(x.at.by_z for x in each) + rows[:, :-1].T @ offset
    by_e, scores = joined(lambda x: x.at.by_e), joined(lambda x: x.at.scores)
    none = joined(lambda x: x.at.blocks)
    at = Point(np.asarray(z), e, none, rows, cost, by_z, by_e, scores)
    data = triangular(joined(lambda x: x.arrow.data))
    R11, slope = joined(lambda x: x.arrow.R11), joined(lambda x: x.arrow.slope)
    squares, spread = joined(lambda x: x.squares), joined(lambda x: x.spread)
    return _Part(at, Elimination(data, R11, slope), squares, spread)


@eqx.filter_jit
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
    at = eqx.tree_at(lambda at: at.blocks, at, at.blocks[:, :, :0])
    return _Part(at, arrow, *squares)


def _of_windows(part: _Part, count: int) -> _Part:
    """The first windows; the others fill up a part, and nothing is measured in them."""

    def cut(x: AnyArray) -> AnyArray:
        return x[:count]

    at, arrow = part.at, part.arrow
    own = lambda at: (at.e, at.blocks, at.by_e, at.scores)  # noqa: E731
    at = eqx.tree_at(own, at, tuple(map(cut, own(at))))
    arrow = Elimination(arrow.data, cut(arrow.R11), cut(arrow.slope))
    return _Part(at, arrow, cut(part.squares), cut(part.spread))
