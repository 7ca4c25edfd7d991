"""The descent to a MAP where each linearisation asks a simulator on the host.

The steps are those of `sim2gp.inference.levenberg_marquardt`, in NumPy, taken one at a
time by a loop of the host, for a linearisation is what costs. So there are as few as
can be: a step that does not lower the cost is simulated but not linearised, starts are
compared where they are roughly finished, the noise is updated after every step that is
kept (generalised EM: Dempster, Laird and Rubin 1977, section 3), and the descent ends
where Newton's step is a hundredth of a posterior sd and the noise rests.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import NEAR
from sim2gp.inference.laplace import Laplace, laplace
from sim2gp.inference.levenberg_marquardt import (
    AGAIN_DAMPING,
    FIRST_DAMPING,
    MOST_DAMPING,
    Point,
    next_damping,
    point,
    step,
)
from sim2gp.inference.likelihood import AbstractLikelihood, Trial
from sim2gp.inference.prior import AbstractPrior

Vector = Float[np.ndarray, " p"]
Starts = Float[np.ndarray, "W n"]

#: Of Newton's step, in posterior sd, and of the noise's relative change: a descent
#: rests. A start is compared with others already where its step is a rough one.
SMALL, ROUGH = 1e-2, 0.3
STILL = 1e-3
#: A step shorter than `NEAR` that gains no more (nats) is the last.
NOTHING = 1e-2
#: Steps that a descent may take; a start among others, fewer.
MOST_STEPS, FIRST_STEPS = 100, 30
NOISE_TURNS, NEARLY = 10, 0.05  # of EM at one point; of the first, in a last one

#: Noise that the residuals about a MAP are expected to have, given that until now.
Update = Callable[[Laplace, Noise], Noise]


class Progress(NamedTuple):
    """The state of a descent after a step that was kept.

    ``away`` is the largest entry of Newton's step, or of the shortest step that is
    known to gain nothing, in posterior sd: so far the MAP may be.
    """

    found: Laplace
    noise: Noise
    steps: int
    step_sd: float
    damping: float
    away: float

    @property
    def at(self) -> Point:
        return self.found.at


def descend(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    here: Laplace,
    noise: Noise,
    update: Update | None,
    *,
    until: float = SMALL,
    most: int | None = None,
    damping: float = FIRST_DAMPING,
) -> Iterator[Progress]:
    """Each step that is kept, from ``here`` to where the next is no longer ``until``.

    Without an ``update`` the noise stays. It ends where so short a step as `NEAR` gains
    nothing, too: a machine with dry friction or stops has kinks, and in one of them the
    linearisation goes on to promise more. It ends early at ``most`` steps, and at once
    where the start has no finite cost.
    """
    change = 0.0
    if update is not None:
        here, noise, change = _rested(update, prior, here, noise)
    sd, refused = float(here.newton_step_sd()), 0
    yield Progress(here, noise, 1, sd, damping, sd)
    for count in range(2, (most or MOST_STEPS) + 1):
        cost = float(here.at.cost)
        if not np.isfinite(cost) or damping >= MOST_DAMPING:
            return
        z, e, predicted, size = _proposed(prior, here, noise, damping)
        trial = _tried(likelihood, prior, z, e)
        gain = cost - _cost(prior, z, e, trial, noise)
        keep = gain > 1e-12 * (1.0 + cost)
        refused = 0 if keep else refused + 1
        # More than all is worth no more, and what is refused has no ratio: neither may
        # be divided by a step that promises nothing.
        ratio = gain / predicted if keep and gain < predicted else 1.0
        damping = float(next_damping(damping, float(refused), ratio))
        vain = size <= NEAR and gain <= NOTHING
        if keep:
            here = _linearised(prior, z, e, trial, noise)
        if keep or vain:
            if update is not None:
                here, noise, change = _rested(update, prior, here, noise)
            sd = float(here.newton_step_sd())
            # Of a noise that is another now, the step says nothing: the first is large.
            vain = vain and change <= STILL
            away = min(sd, size) if vain else sd
            yield Progress(here, noise, count, sd, damping, away)
        if vain or (sd <= until and change <= STILL):
            return


def begin_at(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Vector,
    e: Starts,
    noise: Noise,
) -> Laplace:
    """The data linearised where a descent begins."""
    return _linearised(prior, z, e, _tried(likelihood, prior, z, e), noise)


def _rested(
    update: Update, prior: AbstractPrior, here: Laplace, noise: Noise
) -> tuple[Laplace, Noise, float]:
    """The noise where it rests at a point, which asks nothing of the simulator."""
    first, at, enough = noise, here.at, 0.1 * STILL
    for turn in range(NOISE_TURNS):
        before = noise
        noise = update(here, noise)
        again = point(at.z, at.e, at.blocks, prior.rows(at.z), noise)
        here = laplace(again, noise)
        moved = _change(noise, before)
        if turn == 0:  # it follows the next step as well
            enough = max(enough, NEARLY * moved)
        if moved <= enough:
            break
    return here, noise, _change(noise, first)


def _change(new: Noise, old: Noise) -> float:
    return float(np.max(np.abs(np.log(new.sd / old.sd))))


def search(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[np.ndarray, "starts p"],
    e: Starts,
    noise: Noise,
    update: Update | None,
    until: float,
) -> Iterator[Progress]:
    """Each step that is kept on the way to the MAP; the last one yielded is there.

    The first start is followed to its end before the others are tried: its posterior is
    an answer already. Another is followed only where it begins better: where it is
    roughly finished, with the first noise, it is elsewhere and its cost is less.
    """

    def begun(z: Vector) -> Laplace:
        return begin_at(likelihood, prior, z, e, noise)

    def roughly(z: Vector) -> Iterator[Progress]:
        begin = begun(z), noise, None
        return descend(likelihood, prior, *begin, until=ROUGH, most=FIRST_STEPS)

    def finished(here: Laplace, damping: float = AGAIN_DAMPING) -> Iterator[Progress]:
        begin, damping = (here, noise, update), min(damping, AGAIN_DAMPING)
        return descend(likelihood, prior, *begin, until=until, damping=damping)

    first, *others = [z for z in starts if not np.isnan(z).any()]
    if not others:  # nothing to compare
        yield from finished(begun(first))
        return
    *_, best = roughly(first)
    followed = best
    yield from finished(best.found, best.damping)
    for z in others:
        for other in roughly(z):
            if _largest(best.found.R @ (other.at.z - best.at.z)) <= 2.0 * ROUGH:
                break  # it goes where the best one is
        else:
            cost = other.at.cost
            best = other if np.isfinite(cost) and not best.at.cost <= cost else best
    if best is not followed:
        yield from finished(best.found, best.damping)


def _tried(
    likelihood: AbstractLikelihood, prior: AbstractPrior, z: Vector, e: Starts
) -> Trial:
    about = prior.gaussian
    return likelihood.trial(about.at(z), e, about.scale)


def _cost(
    prior: AbstractPrior, z: Vector, e: Starts, trial: Trial, noise: Noise
) -> float:
    """The cost that `point` would find; NaN and infinity never win."""
    data = noise.weights @ trial.squares @ noise.sd**-2
    offset = prior.rows(z)[:, -1]
    return float(0.5 * (data + np.sum(e**2) + offset @ offset))


def _linearised(
    prior: AbstractPrior, z: Vector, e: Starts, trial: Trial, noise: Noise
) -> Laplace:
    return laplace(point(z, e, trial.blocks(), prior.rows(z), noise), noise)


def _proposed(
    prior: AbstractPrior, here: Laplace, noise: Noise, damping: float
) -> tuple[Vector, Starts, float, float]:
    """The damped step's end, what it should save, and its size in posterior sd."""
    dz, de, predicted = step(prior, here.at, noise, damping)
    slope = here.arrow.slope[..., :-1]
    own = np.einsum("wij,wj->wi", here.arrow.R11, de + slope @ dz)
    size = max(_largest(here.R @ dz), _largest(own))
    return here.at.z + dz, here.at.e + de, float(predicted), size


def _largest(x: np.ndarray) -> float:
    return float(np.max(np.abs(x), initial=0.0))
