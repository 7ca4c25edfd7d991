"""Training by AdamW (Loshchilov & Hutter 2019, arXiv 1711.05101), as one scan.

Of any pytree, in the precision of its numbers, with a rate for each leaf that falls
along a half cosine to a tenth. A gradient that is not finite changes nothing: one bad
batch does not end a training.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Int

from sim2gp.types import Key, Scalar

#: ``(parameters, t, key) -> gradient`` of what is minimised.
Gradient = Callable[[Any, Array, Key], Any]


def adamw(epsilon: float | Array = 1e-8) -> optax.GradientTransformation:
    """A step before its rate; never so many bad gradients that one is let through."""
    step = optax.chain(
        optax.scale_by_adam(eps=epsilon), optax.add_decayed_weights(1e-4)
    )
    return optax.apply_if_finite(step, max_consecutive_errors=2**31 - 1)


def descend(
    gradient: Gradient,
    parameters: Any,
    state: optax.OptState,
    rates: Any,
    *,
    steps: int,
    start: Int[Array, ""],
    total: Int[Array, ""],
    key: Key,
) -> tuple[Any, optax.OptState]:
    """``steps`` of `adamw` from step ``start`` of ``total``."""

    def step(carry: tuple[Any, optax.OptState], i: Array) -> tuple[tuple, None]:
        parameters, state = carry
        t = start + i
        grads = gradient(parameters, t, jax.random.fold_in(key, t))
        # Adam's second form (arXiv 1412.6980, section 2): 1e-8 is added to the moment
        # that is still biased. The smallest gradients wait for the others.
        unbiased = jnp.sqrt(1.0 - 0.999 ** (t + 1).astype(jnp.float32))
        with jax.numpy_dtype_promotion("standard"):  # optax relies on it
            updates, state = adamw(1e-8 / unbiased).update(grads, state, parameters)
        # optax's cosine wants to know ``total`` while it is compiled.
        share = jnp.minimum(t / jnp.maximum(total, 1), 1.0).astype(jnp.float32)
        fall = 0.55 + 0.45 * jnp.cos(jnp.pi * share)

        def move(p: Array, update: Array, rate: Any) -> Array:
            return p - rate * fall.astype(p.dtype) * update

        return (jax.tree.map(move, parameters, updates, rates), state), None

    (parameters, state), _ = jax.lax.scan(step, (parameters, state), jnp.arange(steps))
    return parameters, state


def chosen(condition: Scalar | Array, new: Any, old: Any) -> Any:
    """``new`` where the condition holds, leaf by leaf."""
    return jax.tree.map(lambda n, o: jnp.where(condition, n, o), new, old)
