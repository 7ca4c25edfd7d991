r"""Coloured noise of exact unit variance for action sequences.

A sequence of length ``H`` has independent Fourier coefficients of power ``f^-beta`` at
the frequencies ``f_j = j/H`` (``f_0 := 1/H``), so its spectrum has slope ``-beta`` in
log-log axes: 0 is white, 1 pink, 2 red. Written as ``eps = C z`` with white ``z`` the
factor ``C (H, H)`` has rows of norm one: the variance is 1 at every step by
construction, not by a sample estimate. (Timmer and Koenig 1995, A&A 300; used for
actions by Pinneri et al. 2020, arXiv 2008.06389.) A product with ``C`` replaces the
FFT: the same map, faster at these lengths.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.types import Key


def colour_factor(horizon: int, colour: float) -> np.ndarray:
    """``C (H, H)`` with ``C C^T`` the correlation of noise of slope ``-colour``."""
    t = np.arange(horizon)
    columns = []
    for j in range(horizon // 2 + 1):
        amplitude = (max(j, 1) / horizon) ** (-colour / 2)
        phase = 2 * np.pi * j * t / horizon
        if j == 0 or 2 * j == horizon:  # real coefficients: one column, half the power
            columns.append(amplitude * np.sqrt(0.5) * np.cos(phase))
        else:
            columns += [amplitude * np.cos(phase), amplitude * np.sin(phase)]
    factor = np.stack(columns, axis=1)
    return factor / np.sqrt(np.sum(factor**2, axis=1, keepdims=True))


def coloured_noise(
    key: Key, samples: int, like: Float[Array, "H m"], colour: float
) -> Float[Array, "N H m"]:
    """Independent sequences of unit variance and spectrum slope ``-colour``."""
    horizon, size = like.shape
    white = jax.random.normal(key, (samples, size, horizon), like.dtype)
    factor = jnp.asarray(colour_factor(horizon, colour), like.dtype)
    return jnp.einsum("th,nmh->ntm", factor, white)
