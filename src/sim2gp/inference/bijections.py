"""The maps between virtual values ``tt`` on the whole line and physical constants.

    bounded      theta = low + (high - low) sigmoid(tt)
    log_bounded  log theta = log low + (log high - log low) sigmoid(tt)
    softplus     theta = low + softplus(tt)
    log          theta = exp(tt)
    identity     theta = tt

(The paper prints ``theta_min + theta_max sigmoid``, which leaves the box.) All maps
are clamped to ``[low, high]``, so that rounding never leaves it either.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

MAPS = ("bounded", "log_bounded", "softplus", "log", "identity")
_EDGE = 1e-13  # closest approach to a bound when a physical value is mapped back


def constrain(kind: str, t: Array, low: Any, high: Any) -> Array:
    """Physical values of virtual ones under one kind of map, inside ``[low, high]``."""
    huge = np.asarray(np.finfo(t.dtype).max, t.dtype)
    if kind == "bounded":
        return jnp.clip(low + (high - low) * jax.nn.sigmoid(t), low, high)
    if kind == "log_bounded":
        span = np.log(high) - np.log(low)
        return jnp.clip(jnp.exp(np.log(low) + span * jax.nn.sigmoid(t)), low, high)
    if kind == "softplus":
        return jnp.minimum(low + jax.nn.softplus(t), huge)
    if kind == "log":
        limit = np.floor(np.log(huge))
        return jnp.exp(jnp.clip(t, -limit, limit))
    return jnp.clip(t, -huge, huge)


def unconstrain(kind: str, theta: Array, low: Any, high: Any) -> Array:
    """Virtual values of physical ones; a value on a bound maps just inside it."""
    if kind in ("bounded", "log_bounded"):
        if kind == "log_bounded":
            low, high, theta = np.log(low), np.log(high), jnp.log(theta)
        u = jnp.clip((theta - low) / (high - low), _EDGE, 1.0 - _EDGE)
        return jnp.log(u) - jnp.log1p(-u)
    if kind == "softplus":
        x = theta - low
        return x + jnp.log(-jnp.expm1(-x))
    return jnp.log(theta) if kind == "log" else theta


def scatter(parts: list[Array], groups: list[Any], like: Array) -> Array:
    """Put the groups' values back into the table's order."""
    if not parts:
        return like
    order = np.concatenate([index for _, index, _, _ in groups])
    return jnp.concatenate(parts)[np.argsort(order)]
