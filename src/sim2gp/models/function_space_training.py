"""Training a last layer's posterior by the loss of `function_space_loss`.

First it agrees with the target alone, then with four fifths of the data as well. The
noise is fitted to the fifth that was held out, and training ends on all data.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import lower_factor
from sim2gp.inference.linear_regression import LastLayer
from sim2gp.models import features, nlm
from sim2gp.models.function_space_loss import (
    Objective,
    Targets,
    Variational,
    expected_log_likelihood,
    mean_divergence,
)
from sim2gp.models.hybrid import HybridBelief
from sim2gp.models.sim2gp import Sim2GPBelief
from sim2gp.models.training import adamw, chosen, descend
from sim2gp.types import Key, Scalar

BLOCK = 100
BATCH = 256


class Schedule(eqx.Module):
    """Steps: agreement alone; with four fifths of the data; with all, noise kept.

    rate: of the optimiser. initial: sd of the layer's posterior before the first step.
    """

    alone: Int[Array, ""]
    most: Int[Array, ""]
    all: Int[Array, ""]
    rate: float = eqx.field(static=True)
    initial: float = eqx.field(static=True)

    @classmethod
    def of(cls, alone: int, steps: int, rate: float, initial: float) -> "Schedule":
        """The last third of ``steps`` is on all data, rounded down to whole blocks."""
        last = steps // 3 // BLOCK * BLOCK
        first, most, everything = map(jnp.asarray, (alone, steps - last, last))
        return cls(first, most, everything, rate, initial)


def learned(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    c: Float[Array, " d"],
    rows: tuple[Float[Array, "N e"], Float[Array, "N d"], Bool[Array, " N"]],
    target: Targets,
    objective: Objective,
    schedule: Schedule,
    key: Key,
) -> tuple[nlm.Head, Float[Array, " d"]]:
    """The trained network with its layer, and the noise in state units.

    ``rows`` are encoded inputs, changes in state units and a mask.
    """
    X, y, mask = rows
    begin = starting_point(belief, sim, c, schedule.initial)
    q, noise = train(begin, X, y / c[None], mask, target, objective, schedule, key)
    return head_of(belief, q, noise, c), noise * c


def starting_point(
    belief: HybridBelief, sim: Sim2GPBelief, c: Float[Array, " d"], initial: float
) -> Variational:
    """Where training begins: at nothing, or at the last posterior in the new units."""
    head, first = belief.head, belief.count == 0
    ratio = jnp.where(first, 0.0, head.output_scale / c)
    # Updates leave scales that are no longer triangular.
    kept = jax.vmap(lower_factor)(head.layer.scale) * ratio[:, None, None]
    eye = initial * jnp.eye(kept.shape[1])
    factor = jnp.where(first, eye[None], kept)
    noise = jnp.where(first, sim.noise, belief.noise) / c
    mean = head.layer.mean * ratio[:, None]
    return Variational(
        head.trained.network,
        mean.astype(jnp.float32),
        factor.astype(jnp.float32),
        jnp.log(noise),
    )


def head_of(
    belief: HybridBelief,
    q: Variational,
    noise: Float[Array, " d"],
    c: Float[Array, " d"],
) -> nlm.Head:
    """The trained posterior, in float64, as a layer that shares nothing with ``tt``."""
    old = belief.head
    trained = nlm.Trained(q.network, old.trained.log_alpha, jnp.log(noise))
    mean, factor = q.mean.astype(noise.dtype), jnp.tril(q.factor).astype(noise.dtype)
    layer = LastLayer(mean, jnp.zeros_like(old.layer.shared), factor)
    return nlm.Head(trained, layer, c, old.encoding)


def train(
    q: Variational,
    X: Float[Array, "N e"],
    Y: Float[Array, "N d"],
    mask: Bool[Array, " N"],
    target: Targets,
    objective: Objective,
    schedule: Schedule,
    key: Key,
) -> tuple[Variational, Float[Array, " d"]]:
    """The trained posterior and its recalibrated noise, one loop over three phases."""
    out = features.held_out_rows(mask)
    X32, N = X.astype(jnp.float32), jnp.sum(mask, dtype=Y.dtype)
    first, second = schedule.alone // BLOCK, (schedule.alone + schedule.most) // BLOCK
    last = second + schedule.all // BLOCK
    rates = jax.tree.map(lambda _: schedule.rate, q)
    rates = eqx.tree_at(lambda q: q.log_noise, rates, 5.0 * schedule.rate)

    def block(i: Array, carry: tuple) -> tuple:
        q, moments, noise = carry
        rows = jnp.where(i < second, mask & ~out, mask)
        batches = features.Minibatches.shuffled(jax.random.fold_in(key, i), rows)
        begin = jnp.where(i < first, 0, jnp.where(i < second, first, second))
        end = jnp.where(i < first, first, jnp.where(i < second, second, last))
        moments = chosen(i == begin, adamw().init(q), moments)
        gradient = _gradient(X32, Y, batches, target, objective, N, i < first)

        def masked(q: Variational, t: Array, key: Key) -> Variational:
            grads = gradient(q, t, key)
            learns = (i >= first) & (i < second)
            slope = jnp.where(learns, grads.log_noise, 0.0)
            return eqx.tree_at(lambda g: g.log_noise, grads, slope)

        q, moments = descend(
            masked,
            q,
            moments,
            rates,
            steps=BLOCK,
            start=(i - begin) * BLOCK,
            total=(end - begin) * BLOCK,
            key=jax.random.fold_in(key, i),
        )
        noise = jax.lax.cond(
            i + 1 == second, lambda: held_out_noise(q, X, Y, out), lambda: noise
        )
        settled = jnp.log(noise)
        log_noise = jnp.where(i + 1 >= second, settled, q.log_noise)
        return eqx.tree_at(lambda q: q.log_noise, q, log_noise), moments, noise

    start = (q, adamw().init(q), q.noise)
    q, _, noise = jax.lax.fori_loop(0, last, block, start)
    return q, noise


def held_out_noise(
    q: Variational,
    X: Float[Array, "N e"],
    Y: Float[Array, "N d"],
    out: Bool[Array, " N"],
) -> Float[Array, " d"]:
    """The noise that best predicts the held-out rows; the trained one without any."""
    Phi = jax.vmap(q.network)(X)
    mean = Phi @ q.mean.T.astype(X.dtype)
    factor = jnp.tril(q.factor).astype(X.dtype)
    variance = jnp.sum(jnp.einsum("nm,dmj->ndj", Phi, factor) ** 2, axis=2)
    noise, losses = last_layer.recalibrated(variance, Y - mean, out, q.noise)
    return jnp.where(jnp.isfinite(losses) & jnp.any(out), noise, q.noise)


def _gradient(
    X: Float[Array, "N e"],
    Y: Float[Array, "N d"],
    batches: features.Minibatches,
    target: Targets,
    objective: Objective,
    N: Scalar,
    alone: Bool[Array, ""],
) -> Callable[[Variational, Array, Key], Any]:
    """The gradient of the loss; of the divergence alone while pre-training."""

    def agree(q: Variational, key: Key) -> Scalar:
        return mean_divergence(q, target, objective, key)

    def fit(q: Variational, t: Array, key: Key) -> Scalar:
        index, valid = batches.batch(t, BATCH)
        likelihood = expected_log_likelihood(q, X[index], Y[index], valid)
        return objective.weight / N * agree(q, key) - likelihood

    def gradient(q: Variational, t: Array, key: Key) -> Any:
        return jax.lax.cond(
            alone,
            lambda: jax.grad(agree)(q, key),
            lambda: jax.grad(fit)(q, t, key),
        )

    return gradient
