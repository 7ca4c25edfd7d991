"""The descent to a MAP where each linearisation asks a simulator on the host.

The steps are those of `sim2gp.inference.levenberg_marquardt`, taken one at a time by a
loop of the host, for a linearisation is what costs. So there are as few as can be:
starts are compared where they are roughly finished, the noise is updated after every
step that is kept (generalised EM: Dempster, Laird and Rubin 1977, section 3), and the
descent ends where Newton's step is a hundredth of a posterior sd and the noise rests.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Blocks, Noise, eliminate
from sim2gp.inference.convergence import NEAR
from sim2gp.inference.least_squares import stack
from sim2gp.inference.levenberg_marquardt import (
    FIRST_DAMPING,
    MOST_DAMPING,
    Point,
    judged,
    point,
    step,
)
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import Scalar

#: Of Newton's step, in posterior sd, and of the noise's relative change: a descent
#: rests. A start is compared with others already where its step is a rough one.
SMALL, ROUGH = 1e-2, 0.3
STILL = 1e-3
#: A step shorter than `NEAR` that gains no more (nats) is the last.
NOTHING = 1e-3
#: Steps that a descent may take; a start among others, fewer.
MOST_STEPS, FIRST_STEPS = 100, 30
NOISE_TURNS = 10  # of EM at one point

#: Noise that a point's residuals are expected to have, given the noise until now.
Update = Callable[[Point, Noise], Noise]
#: Newton's step from a point under a noise, its largest entry in posterior sd.
StepSd = Callable[[Point, Noise], Scalar]


class Progress(NamedTuple):
    """Where a descent stands after a step that was kept.

    ``step_sd`` is the largest entry of Newton's step, ``away`` of the shortest step
    that is known to gain nothing, in posterior sd: so far the MAP may be.
    """

    at: Point
    noise: Noise
    steps: int
    step_sd: float
    damping: float
    away: float


def descend(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    start: tuple[Float[Array, " p"], Float[Array, "W n"]],
    noise: Noise,
    step_sd: StepSd,
    update: Update | None,
    *,
    until: float = SMALL,
    most: int | None = None,
    damping: float = FIRST_DAMPING,
) -> Iterator[Progress]:
    """Each step that is kept, from ``start`` to where the next is no longer ``until``.

    Without an ``update`` the noise stays. It ends where so short a step as `NEAR` gains
    nothing, too: a machine with dry friction or stops has kinks, and in one of them the
    linearisation goes on to promise more. It ends early at ``most`` steps, and at once
    where the start has no finite cost.
    """
    here = _linearised(likelihood, prior, *start, noise)
    kept, change = jnp.asarray(damping), np.inf if update else 0.0
    sd, refused = float(step_sd(here, noise)), 0
    yield Progress(here, noise, 1, sd, damping, sd)
    for count in range(2, (most or MOST_STEPS) + 1):
        if not np.isfinite(float(here.cost)) or float(kept) >= MOST_DAMPING:
            return
        z, e, predicted, size = _proposed(prior, here, noise, kept)
        there = _linearised(likelihood, prior, z, e, noise)
        keep, kept = _judged(here, there, predicted, kept)
        refused = 0 if bool(keep) else refused + 1
        kept = kept * 4.0 ** max(0, refused - 1)  # each refusal raises it by more
        vain = float(size) <= NEAR and float(here.cost - there.cost) <= NOTHING
        if bool(keep):
            here = there
            if update is not None:
                noise, change = _rested(update, here, noise)
                here = _again(here, noise)
            sd = float(step_sd(here, noise))
        small = sd <= until and change <= STILL
        if bool(keep) or vain:
            away = min(sd, float(size)) if vain else sd
            yield Progress(here, noise, count, sd, float(kept), away)
        if small or vain:
            return


def _rested(update: Update, here: Point, noise: Noise) -> tuple[Noise, float]:
    """The noise where it rests at a point, which asks nothing of the simulator."""
    first = noise
    for _ in range(NOISE_TURNS):
        noise, before = update(here, noise), noise
        if _change(noise, before) <= 0.1 * STILL:
            break
    return noise, _change(noise, first)


def _change(new: Noise, old: Noise) -> float:
    return float(np.max(np.abs(np.log(np.asarray(new.sd) / np.asarray(old.sd)))))


def best_start(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    e: Float[Array, "W n"],
    noise: Noise,
    step_sd: StepSd,
) -> Progress:
    """Of roughly finished descents from each start, the one of least cost."""
    found: list[Progress] = []
    for z in starts:
        if bool(jnp.isnan(z).any()):
            continue
        args = (z, e), noise, step_sd, None
        limits = {"until": ROUGH, "most": FIRST_STEPS}
        *_, last = descend(likelihood, prior, *args, **limits)  # type: ignore[arg-type]
        found.append(last)
    finite = [x for x in found if np.isfinite(float(x.at.cost))]
    return min(finite or found, key=lambda x: float(x.at.cost))


def _linearised(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
    noise: Noise,
) -> Point:
    about = prior.gaussian
    blocks = likelihood.blocks(about.at(z), e, about.scale)
    return _pointed(prior, z, e, blocks, noise)


@eqx.filter_jit
def _pointed(
    prior: AbstractPrior, z: Array, e: Array, blocks: Blocks, noise: Noise
) -> Point:
    return point(z, e, blocks, prior.rows(z), noise)


@eqx.filter_jit
def _again(here: Point, noise: Noise) -> Point:
    """The same linearisation under another noise."""
    return point(here.z, here.e, here.blocks, here.prior, noise)


@eqx.filter_jit
def _proposed(
    prior: AbstractPrior, here: Point, noise: Noise, damping: Scalar
) -> tuple[Array, Array, Scalar, Scalar]:
    """The damped step's end, what it should save, and its size in posterior sd."""
    dz, de, predicted = step(prior, here, noise, damping)
    arrow = eliminate(here.blocks, here.e, noise)
    full = stack(arrow.data, here.prior)[:-1, :-1]
    own = jnp.einsum("wij,wj->wi", arrow.R11, de + arrow.slope[..., :-1] @ dz)
    size = jnp.maximum(_largest(full @ dz), _largest(own))
    return here.z + dz, here.e + de, predicted, size


def _largest(x: Array) -> Scalar:
    return jnp.max(jnp.abs(x), initial=0.0)


_judged = jax.jit(judged)
