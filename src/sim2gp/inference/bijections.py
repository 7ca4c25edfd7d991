"""The maps between virtual values ``tt`` on the whole line and physical parameters.

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

from sim2gp.inference.linalg import library
from sim2gp.types import AnyArray

MAPS = ("bounded", "log_bounded", "softplus", "log", "identity")
SMALL_RATE = 0.3  # of a logarithm in a step: larger ones are not along powers
ROOM = 1e-3  # of a box, at its ends: there steps are straight
_EDGE = 1e-13  # closest approach to a bound when a physical value is mapped back


def constrain(kind: str, t: AnyArray, low: Any, high: Any) -> AnyArray:
    """Physical values of virtual ones under one kind of map, inside ``[low, high]``."""
    xp, huge = library(t), np.asarray(np.finfo(t.dtype).max, t.dtype)
    sigmoid = _sigmoid if xp is np else jax.nn.sigmoid
    if kind == "bounded":
        return xp.clip(low + (high - low) * sigmoid(t), low, high)
    if kind == "log_bounded":
        span = np.log(high) - np.log(low)
        return xp.clip(xp.exp(np.log(low) + span * sigmoid(t)), low, high)
    if kind == "softplus":
        return xp.minimum(low + xp.logaddexp(t, 0.0), huge)
    if kind == "log":
        limit = np.floor(np.log(huge))
        return xp.exp(xp.clip(t, -limit, limit))
    return xp.clip(t, -huge, huge)


def slopes(kind: str, t: AnyArray, low: Any, high: Any) -> tuple[AnyArray, AnyArray]:
    """First derivative of `constrain` in ``t``, and the second over the first."""
    xp = library(t)
    sigmoid = _sigmoid if xp is np else jax.nn.sigmoid
    up, down = sigmoid(t), sigmoid(-t)
    if kind == "bounded":
        return (high - low) * up * down, down - up
    if kind == "log_bounded":
        steep = (np.log(high) - np.log(low)) * up * down
        return constrain(kind, t, low, high) * steep, steep + down - up
    if kind == "softplus":
        return up, down
    if kind == "log":
        limit = np.floor(np.log(np.finfo(t.dtype).max))
        held = (xp.abs(t) < limit).astype(t.dtype)
        return held * constrain(kind, t, low, high), held
    return xp.ones_like(t), xp.zeros_like(t)


def _sigmoid(t: np.ndarray) -> np.ndarray:
    """To a few units in the last place, also where it is small."""
    return np.exp(-np.logaddexp(0.0, -t))


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


def along_powers(
    theta: AnyArray, change: AnyArray, low: np.ndarray, high: np.ndarray
) -> tuple[AnyArray, AnyArray]:
    """Positive values after a ``change`` to first order, and where they are inside.

    The logarithm keeps its rate: what data know of a mechanism are products of powers
    (a force over a mass), and such steps leave these as they are. A value that changes
    much is small next to others that it is added to (a damping next to a back-EMF):
    it keeps its own rate.
    """
    xp, positive = library(theta), low > 0.0
    rate = change / xp.where(positive, theta, 1.0)
    small = xp.abs(rate) < SMALL_RATE
    new = theta * xp.where(small, xp.exp(xp.where(small, rate, 0.0)), 1.0 + rate)
    room = ROOM * np.where(np.isfinite(high), high - low, 0.0)
    return new, positive & (new > low + room) & (new < high - room)


def scatter(parts: list[AnyArray], groups: list[Any], like: AnyArray) -> AnyArray:
    """Put the groups' values back into the table's order."""
    if not parts:
        return like
    order = np.concatenate([index for _, index, _, _ in groups])
    return library(like).concatenate(parts, axis=-1)[..., np.argsort(order)]
