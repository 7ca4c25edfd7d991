"""Adam (Kingma & Ba 2015, arXiv 1412.6980): one step, and a scan of them.

Of any pytree, in the precision of its numbers. A gradient that is not finite changes
nothing: one bad batch does not end a training.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from sim2gp.types import Key, Scalar

WEIGHT_DECAY = 1e-4
#: ``(parameters, t, key) -> gradient`` of what is minimised.
Gradient = Callable[[Any, Array, Key], Any]
#: First and second moment of the gradients so far.
Moments = tuple[Any, Any]


def adam(parameters: Any) -> Moments:
    """The optimiser before its first step."""
    zeros = jax.tree.map(jnp.zeros_like, parameters)
    return zeros, zeros


def adam_step(
    parameters: Any,
    state: Moments,
    grads: Any,
    rates: Any,
    *,
    t: Int[Array, ""],
    decay: float = 0.0,
) -> tuple[Any, Moments]:
    """Step ``t``, from 0, with a rate for each leaf.

    Weights decay apart from the moments, by ``decay`` times the rate.
    """
    first, second = state
    finite = [jnp.all(jnp.isfinite(g)) for g in jax.tree.leaves(grads)]
    new = (
        jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, grads),
        jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, second, grads),
    )
    done = (t + 1).astype(jnp.float32)
    unbiased = jnp.sqrt(1.0 - 0.999**done) / (1.0 - 0.9**done)

    def move(p: Array, m: Array, v: Array, rate: Any) -> Array:
        towards = unbiased.astype(p.dtype) * m / (jnp.sqrt(v) + 1e-8)
        return p - rate * (towards + decay * p)

    moved = jax.tree.map(move, parameters, *new, rates)
    return chosen(jnp.all(jnp.stack(finite)), (moved, new), (parameters, state))


def descend(
    gradient: Gradient,
    parameters: Any,
    state: Moments,
    rates: Any,
    *,
    steps: int,
    start: Int[Array, ""],
    total: Int[Array, ""],
    key: Key,
) -> tuple[Any, Moments]:
    """``steps`` of Adam from step ``start`` of ``total``; one scan.

    The rate falls along a half cosine to a tenth.
    """

    def step(carry: tuple[Any, Moments], i: Array) -> tuple[tuple, None]:
        parameters, state = carry
        t = start + i
        grads = gradient(parameters, t, jax.random.fold_in(key, t))
        share = jnp.minimum(t / jnp.maximum(total, 1), 1.0).astype(jnp.float32)
        fall = 0.55 + 0.45 * jnp.cos(jnp.pi * share)

        def falling(p: Array, rate: Any) -> Array:
            return rate * fall.astype(p.dtype)

        now = jax.tree.map(falling, parameters, rates)
        decay = WEIGHT_DECAY
        return adam_step(parameters, state, grads, now, t=t, decay=decay), None

    (parameters, state), _ = jax.lax.scan(step, (parameters, state), jnp.arange(steps))
    return parameters, state


def chosen(condition: Scalar | Array, new: Any, old: Any) -> Any:
    """``new`` where the condition holds, leaf by leaf."""
    return jax.tree.map(lambda n, o: jnp.where(condition, n, o), new, old)
