"""Auto: let the data choose the model, by how well each predicted the newest episode.

    index = argmax_k  mean_n log p_k(s'_n | s_n, a_n),   n in the newest episode

with every ``p_k`` as it was *before* that episode (the prequential score; Dawid 1984).
It needs no evidence, so a network can be compared with physics. Models are given from
simple to complex, and the simplest one is kept unless another is better by more than
one standard error of the paired difference.
"""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.errors import error
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.types import Action, Dynamics, Key, Scalar, State, in_float64


class AutoDraw(eqx.Module):
    """The chosen model's draw; the others wait, so that a new choice is new data."""

    draws: tuple[Dynamics, ...]
    index: Int[Array, ""]

    def __call__(self, s: State, a: Action) -> State:
        branches = [lambda s, a, draw=draw: draw(s, a) for draw in self.draws]
        return jax.lax.switch(self.index, branches, s, a)


class AutoBelief(AbstractBelief):
    """All beliefs, and which one speaks.

    Its parameters are the chosen model's. It has none where the models' parameters
    differ, or some model has none: all rows that a run keeps have one size.

    scores: mean log score of each model on the episode of the last choice, nats per
        transition; zeros before any.
    seen: number of transitions that the beliefs have been fitted to.
    """

    beliefs: tuple[AbstractBelief, ...]
    index: Int[Array, ""]
    scores: Float[Array, " models"]
    seen: Int[Array, ""]

    @property
    @in_float64
    def noise(self) -> Float[Array, " d"]:
        return jnp.stack([b.noise for b in self.beliefs])[self.index]

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        each = [b.parameters() for b in self.beliefs]
        if len({mean.size for mean, _ in each}) > 1:
            return super().parameters()
        means, sds = (jnp.stack(x) for x in zip(*each, strict=True))
        return means[self.index], sds[self.index]

    def latent(self, s: State, a: Action) -> Gaussian:
        return self._spoken([b.latent(s, a) for b in self.beliefs])

    def predict(self, s: State, a: Action) -> Gaussian:
        return self._spoken([b.predict(s, a) for b in self.beliefs])

    def sample(self, key: Key) -> Dynamics:
        return self._draw(b.sample(key) for b in self.beliefs)

    def untempered(self) -> "AutoBelief":
        """That of each."""
        each = tuple(b.untempered() for b in self.beliefs)
        return eqx.tree_at(lambda b: b.beliefs, self, each)

    def point(self) -> Dynamics:
        return self._draw(b.point() for b in self.beliefs)

    def _draw(self, draws: Iterable[Dynamics]) -> "AutoDraw":
        """In 32 bits, as planning is, for a belief of any precision."""
        return AutoDraw(tuple(draws), self.index.astype(jnp.int32))

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        each = zip(*(b.sensitivity(s, a) for b in self.beliefs), strict=True)
        shared, own = (_padded(parts)[self.index] for parts in each)
        return shared, own

    @property
    def coordinates(self) -> tuple[int, int, int]:
        d, p, m = map(max, zip(*(b.coordinates for b in self.beliefs), strict=True))
        return d, p, m

    def _spoken(self, all_of_them: Sequence[Gaussian]) -> Gaussian:
        """The chosen one."""
        means = jnp.stack([g.mean for g in all_of_them])
        scales = _padded([g.scale for g in all_of_them])
        return Gaussian(means[self.index], scales[self.index])


def _padded(scales: Sequence[Float[Array, "d _"]]) -> Float[Array, "models d k"]:
    """One width for all, by columns of zeros."""
    width = max(x.shape[1] for x in scales)
    return jnp.stack([jnp.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in scales])


class Auto(AbstractModel):
    """Choose among ``models``, given from simple to complex, episode by episode.

    Every fit after the first takes the rows that are new to it as the newest episode.
    Raises `InputError` E148 for fewer than two models.
    """

    models: tuple[AbstractModel, ...]

    def __init__(self, models: Sequence[AbstractModel]) -> None:
        if len(models) < 2:
            got = f"{len(models)} to choose from"
            raise error("too_few_models", where="Auto", got=got)
        self.models = tuple(models)

    @property
    def history(self) -> int:
        return max(model.history for model in self.models)

    @in_float64
    def init(self, key: Key) -> AutoBelief:
        """All priors; the simplest model speaks."""
        keys = jax.random.split(key, len(self.models))
        beliefs = (m.init(k) for m, k in zip(self.models, keys, strict=True))
        count = len(self.models)
        nothing = jnp.zeros((), int)
        return AutoBelief(tuple(beliefs), nothing, jnp.zeros(count), nothing)

    @in_float64
    def fit(self, belief: AbstractBelief, data: Transitions, *, key: Key) -> AutoBelief:
        """Score on what is new, choose, then fit every model. Raises what a fit raises.

        ``data`` extends what was given before; the first fit chooses among the priors.
        """
        assert isinstance(belief, AutoBelief)
        new = jnp.asarray(data.mask) & (jnp.arange(len(data.mask)) >= belief.seen)
        index, scores = belief.index, belief.scores
        if bool(jnp.any(new)):
            each = jnp.stack([log_scores(b, data) for b in belief.beliefs])
            index, scores = choose(each, new)
        keys = jax.random.split(key, len(self.models))
        fitted = tuple(
            m.fit(b, data, key=k)
            for m, b, k in zip(self.models, belief.beliefs, keys, strict=True)
        )
        return AutoBelief(fitted, index, scores, jnp.asarray(data.count))

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> AutoBelief:
        """One more transition for every model; the choice waits for the next fit."""
        assert isinstance(belief, AutoBelief)
        updated = tuple(
            m.update(b, s, a, s2)
            for m, b in zip(self.models, belief.beliefs, strict=True)
        )
        return eqx.tree_at(lambda b: b.beliefs, belief, updated)


@in_float64
def log_scores(belief: AbstractBelief, data: Transitions) -> Float[Array, " capacity"]:
    """Log density of each ``s'`` under the predictive, nats; 0 where masked.

    Of the physical states alone: past actions in a state are known exactly.
    """
    return _log_scores(belief, jax.tree.map(jnp.asarray, data))


@eqx.filter_jit
def _log_scores(belief: AbstractBelief, data: Transitions) -> Float[Array, " capacity"]:
    def one(s: Array, a: Array, s2: Array) -> Scalar:
        predictive = belief.predict(s, a)
        d = belief.noise.size
        return Gaussian(predictive.mean[:d], predictive.scale[:d]).log_prob(s2[:d])

    each = jax.vmap(one)(data.state, data.action, data.next_state)
    return jnp.where(data.mask, each, 0.0)


def choose(
    each: Float[Array, "models N"], new: Bool[Array, " N"]
) -> tuple[Int[Array, ""], Float[Array, " models"]]:
    """The first model that the best beats by no more than a standard error; all means.

    A score that is not finite loses to every finite one.
    """
    count = jnp.sum(new, dtype=each.dtype)
    each = jnp.where(new[None], each, 0.0)
    means = jnp.sum(each, axis=1) / count
    ranked = jnp.where(jnp.isfinite(means), means, -jnp.inf)
    best = jnp.argmax(ranked)
    gap = jnp.where(new[None], each[best][None] - each, 0.0)
    lost = jnp.sum(gap, axis=1) / count
    spread = jnp.sum(jnp.where(new[None], (gap - lost[:, None]) ** 2, 0.0), axis=1)
    error = jnp.sqrt(spread / jnp.maximum(count - 1.0, 1.0) / count)
    tied = (lost <= error) & jnp.isfinite(ranked)
    # `best` ties with itself, so that argmax finds one wherever a score is finite.
    return jnp.argmax(tied | (jnp.arange(len(means)) == best)), means
