"""The descent to a MAP as one program: several starts, then noise and scales with it.

The steps are those of `sim2gp.inference.levenberg_marquardt`. Starts are followed
roughly, under the first noise, and no further where they go where the best one is. From
the best the noise is updated after every step (generalised EM: Dempster, Laird and
Rubin 1977, section 3), until Newton's step and the noise rest.

In a curved valley a step of Gauss-Newton ends off the floor, where the cost is more,
and the next one leads back to it. So a step that is refused is followed by one more
before it is given up (the watchdog: Chamberlain et al. 1982, Mathematical Programming
Study 16). Both together must save a share of what the first one should have: where
friction changes sign, pairs that save next to nothing would follow each other for ever.

Scales of a prior are chosen on the linearised model, which is true nearby alone. A
choice is judged by the simulator: where the descent after it ends with less evidence,
it is undone, and the next one trusts the linear model less.
"""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.laplace import laplace
from sim2gp.inference.levenberg_marquardt import (
    FIRST_DAMPING,
    GRADIENT_TOLERANCE,
    JOINT_TOLERANCE,
    MOST_DAMPING,
    Point,
    blocks_of,
    evaluate,
    is_stale,
    judged,
    point,
    relaxed,
    step,
)
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import AbstractPrior
from sim2gp.types import Scalar

#: Of Newton's step, in posterior sd: a start is compared with others already; scales
#: are chosen.
ROUGH, CLOSE = 0.3, 1.0
#: Steps. Under misfit, and where a bound saturates (measured: by 0.9 a step),
#: Gauss-Newton converges linearly, not in two; a start among others takes fewer.
MOST_STEPS, FIRST_STEPS = 300, 30
#: Choices of scales, and steps until the next where the descent does not come close;
#: and the relative change of a scale that asks for another choice.
CHOICES, BETWEEN, SAME = 10, 10, 0.1
#: Of what a step should save, where it and the next one are kept together.
SUFFICIENT = 0.1
#: Precision that keeps parameters in place in the first choice, in that of their prior;
#: what it is multiplied by after one that is undone.
TRUST, LESS = 10.0, 10.0
SHORT = 1e-6  # posterior sd: a step that a flat gradient may leave
T = TypeVar("T")


class Scales(NamedTuple):
    """How a descent chooses the scales of its prior.

    choose: noise and prior at a point, given those until now and the precision that
        keeps parameters in place; and the largest change of a scale, relative.
    score: the evidence there, nats, which choices must not lower.
    """

    choose: Callable[
        [Point, Noise, AbstractPrior, Scalar], tuple[Noise, AbstractPrior, Scalar]
    ]
    score: Callable[[Point, Noise, AbstractPrior], Scalar]


class Learning(NamedTuple):
    """What a descent learns besides parameters, and where it ends.

    noise: that at a point, given the one until now.
    until: Newton's step at the end, in posterior sd.
    still: relative change of the noise there.
    """

    noise: Callable[[Point, Noise], Noise] | None = None
    scales: Scales | None = None
    until: float = 1e-9
    still: float = 1e-6


NOTHING = Learning()


class Descent(NamedTuple):
    """Where descents ended: the best point, its noise and prior, and all steps.

    costs: where each descent ended, under its own noise.
    """

    at: Point
    noise: Noise
    prior: AbstractPrior
    steps: Int[Array, ""]
    costs: Float[Array, " turns"]


class _Choice(NamedTuple):
    """The best until now, its ``score``, and how many choices are ``made``.

    The last was ``since`` so many steps, and changed the scales by ``other``.
    """

    at: Point
    noise: Noise
    prior: AbstractPrior
    score: Scalar
    trust: Scalar
    made: Int[Array, ""]
    since: Int[Array, ""]
    other: Scalar

    @property
    def rests(self) -> Bool[Array, ""]:
        return self.other <= SAME


class _State(NamedTuple):
    """A descent between two steps.

    The next step is from ``here``, which is ``away`` from the ``best`` point where the
    last step was refused for the first time; that step ``promised`` to save so much.
    ``newton`` is the undamped step that remains at the best, in posterior sd,
    ``change`` the noise's in the last step. Derivatives are ``stale`` where linear
    parameters have moved since, and the next step takes them ``again``. A step in
    ``vain`` is too short to gain anything.
    """

    here: Point
    best: Point
    noise: Noise
    prior: AbstractPrior
    damping: Scalar
    refused: Scalar
    taken: Int[Array, ""]
    newton: Scalar
    change: Scalar
    away: Bool[Array, ""]
    promised: Scalar
    stale: Bool[Array, ""]
    again: Bool[Array, ""]
    vain: Bool[Array, ""]
    choice: _Choice | None


class _Turn(NamedTuple):
    """One descent: from where, and whether it is one of several starts.

    ``known`` is the best point of those before it, ``R`` the factor of its precision.
    """

    z: Float[Array, " p"]
    e: Float[Array, "W n"]
    known: Float[Array, " p"]
    R: Float[Array, "p p"]
    searching: Bool[Array, ""]
    idle: Bool[Array, ""]


def multi_start(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    starts: Float[Array, "starts p"],
    e: Float[Array, "W n"],
    noise: Noise,
    learning: Learning = NOTHING,
) -> Descent:
    """The best of several starts, and the descent from there that learns as well.

    A single start is followed to the end at once. One that is no number is compiled and
    not taken. Every descent is a turn of one scan: one copy of the likelihood.
    """
    nowhere = _nowhere(likelihood, prior, starts[0], e)
    searches = len(starts) if len(starts) > 1 else 0
    schedule = jnp.concatenate([starts, starts[:1]]) if searches else starts

    def turn(carry: tuple, x: tuple[Array, Array]) -> tuple[tuple, Array]:
        best, noise, prior, steps = carry
        start, index = x
        searching, given = index < searches, (index < searches) | (index == 0)
        z, own = _select(given, (start, e), (best.z, best.e))
        idle = jnp.where(given, jnp.isnan(start).any(), ~jnp.isfinite(best.cost))
        about = _Turn(z, own, best.z, laplace(best, noise).R, searching, idle)
        begun = _begun(nowhere, noise, prior, learning)
        found = _descend(likelihood, begun, about, learning)
        # A cost that is not finite never wins; a comparison with NaN is false.
        better = jnp.where(searching, found.best.cost < best.cost, ~idle)
        new = found.best, found.noise, found.prior
        best, noise, prior = _select(better, new, (best, noise, prior))
        return (best, noise, prior, steps + found.taken), found.best.cost

    known = noise, jax.tree.map(jnp.asarray, prior), jnp.zeros((), int)
    turns = jnp.arange(len(schedule))
    carry, costs = jax.lax.scan(turn, (nowhere, *known), (schedule, turns))
    return Descent(*carry, costs)


def _nowhere(
    likelihood: AbstractLikelihood,
    prior: AbstractPrior,
    z: Float[Array, " p"],
    e: Float[Array, "W n"],
) -> Point:
    """No number: where nothing finite is ever found, nothing must look like a fit."""
    blocks = eqx.filter_eval_shape(blocks_of, likelihood, prior, z, e)
    rows, zero = jax.eval_shape(prior.rows, z), jnp.zeros_like(z)
    blocks, rows = (jnp.full(x.shape, jnp.nan, x.dtype) for x in (blocks, rows))
    cost, scores = jnp.asarray(jnp.inf, z.dtype), jnp.zeros((len(e), z.size))
    return Point(zero, e, blocks, rows, cost, zero, jnp.zeros_like(e), scores)


def _begun(
    nowhere: Point, noise: Noise, prior: AbstractPrior, learning: Learning
) -> _State:
    none, no, zero = jnp.zeros(()), jnp.zeros((), bool), jnp.zeros((), int)
    far, choice = jnp.full((), jnp.inf), None
    if learning.scales is not None:
        trust = jnp.full((), TRUST)
        choice = _Choice(nowhere, noise, prior, -far, trust, zero, zero, far)
    about = nowhere, nowhere, noise, prior, jnp.full((), FIRST_DAMPING), none, zero
    return _State(*about, far, far, no, none, no, no, no, choice)


def _descend(
    likelihood: AbstractLikelihood, begun: _State, turn: _Turn, learning: Learning
) -> _State:
    """From a turn's start to its end."""

    def improve(s: _State) -> _State:
        return _stepped(likelihood, s, turn, learning)

    def unfinished(s: _State) -> Array:
        finite = jnp.isfinite(s.best.cost)
        most = jnp.where(turn.searching, FIRST_STEPS, MOST_STEPS)
        hopeless = ~finite | ~(s.damping < MOST_DAMPING) | (s.taken > most)
        hopeless = (s.taken > 0) & hopeless  # a start has no cost yet
        near = jnp.max(jnp.abs(turn.R @ (s.best.z - turn.known)), initial=0.0)
        # A gradient may be small next to a large cost alone.
        flat = s.best.gradient <= 0.1 * GRADIENT_TOLERANCE
        flat = flat & (s.newton <= SHORT)
        there = (s.newton <= learning.until) | flat | s.vain
        there = there & (s.change <= learning.still)
        there = there if s.choice is None else there & s.choice.rests
        rough = (s.newton <= ROUGH) | flat | (near <= 2.0 * ROUGH)
        done = jnp.where(turn.searching, rough, there)
        return ~(done & ~s.again) & ~hopeless & ~turn.idle

    return jax.lax.while_loop(unfinished, improve, begun)


def _stepped(
    likelihood: AbstractLikelihood, s: _State, turn: _Turn, learning: Learning
) -> _State:
    """The state after one evaluation of the likelihood: of the start, the first time.

    A start has nothing to be compared with, nor has a place that is seen again.
    """
    first, seen = s.taken == 0, s.again
    dz, de, predicted = step(s.prior, s.here, s.noise, s.damping)
    z, e = s.prior.moved(s.here.z, dz), s.here.e + de
    z, e = _select(seen, (s.best.z, s.best.e), (z, e))
    z, e = _select(first, (turn.z, turn.e), (z, e))
    found = evaluate(likelihood, s.prior, z, e, s.noise)
    there = relaxed(s.prior, found, s.noise)
    promised = jnp.where(s.away, s.promised, predicted)
    share = jnp.where(s.away, SUFFICIENT, 0.0)
    keep, tried = judged(s.best, there, promised, s.damping, s.refused, share)
    refused = ~keep & ~seen
    again = refused & s.stale
    away = refused & ~again & ~s.away & ~first & jnp.isfinite(there.cost)
    held = first | seen | again | away | (keep & s.away)
    damping, in_turn = _select(held, (s.damping, s.refused), tried)
    # Differences of a simulator on the host hide what such a step would gain.
    flat, short = JOINT_TOLERANCE
    vain = refused & (s.newton <= short) & (s.best.gradient <= flat)
    stale = jnp.where(refused, s.stale, is_stale(found, there))
    best = _select(refused, s.best, there)
    here = _select(away, there, best)
    now = s._replace(here=here, best=best, damping=damping, refused=in_turn)
    now = now._replace(taken=s.taken + 1, away=away, promised=promised)
    now = now._replace(stale=stale, again=again, vain=vain)
    learned = lambda: _learned(learning, now)  # noqa: E731
    now = jax.lax.cond(turn.searching | away, lambda: now, learned)
    return now._replace(newton=laplace(now.best, now.noise).newton_step_sd())


def _learned(learning: Learning, s: _State) -> _State:
    """The best point under the noise that it suggests, and the scales."""
    before = s.noise
    if learning.noise is not None:
        # The last steps go to the MAP of one noise.
        rests = (s.change <= learning.still) & (s.newton <= JOINT_TOLERANCE[1])
        noise = _select(rests, before, learning.noise(s.best, before))
        s = s._replace(noise=noise)
    if learning.scales is not None and s.choice is not None:
        scales, since = learning.scales, s.choice.since
        due = ((s.newton <= CLOSE) | (since >= BETWEEN)) & ~s.choice.rests
        due = due & (s.taken > 1)
        later = s._replace(choice=s.choice._replace(since=since + 1))
        s = jax.lax.cond(due, lambda: _chosen(scales, s), lambda: later)
    z, e, blocks = s.best.z, s.best.e, s.best.blocks
    again = point(z, e, blocks, s.prior.rows(z), s.noise)
    there = relaxed(s.prior, again, s.noise)
    change = jnp.max(jnp.abs(jnp.log(s.noise.sd / before.sd)))
    stale = s.stale | is_stale(again, there)
    return s._replace(here=there, best=there, change=change, stale=stale)


def _chosen(scales: Scales, s: _State) -> _State:
    """New scales at the best point, or at the one before that had more evidence."""
    last = s.choice
    assert last is not None  # it is there where scales are chosen
    score = scales.score(s.best, s.noise, s.prior)
    good = score >= last.score
    old = last.at, last.noise, last.prior, last.score, last.trust * LESS
    now = _select(good, (s.best, s.noise, s.prior, score, last.trust), old)
    at, noise, prior, _, trust = now
    new_noise, new_prior, other = scales.choose(at, noise, prior, trust)
    ended = last.made >= CHOICES
    kept = noise, prior, jnp.zeros_like(other)
    noise, prior, other = _select(ended, kept, (new_noise, new_prior, other))
    made = last.made + 1
    choice = _Choice(*now, made, jnp.zeros_like(made), other)
    return s._replace(best=at, noise=noise, prior=prior, choice=choice)


def _select(yes: Bool[Array, ""], new: T, old: T) -> T:
    chosen: T = jax.tree.map(lambda a, b: jnp.where(yes, a, b), new, old)
    return chosen
