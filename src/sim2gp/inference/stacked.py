"""Several likelihoods of the same parameters as one, for one `estimate` of all.

Windows and channels of all are put one after the other. Where a window has no data in a
channel its factor and its count are zero:

    blocks = [ blocks_1     0     ]      counts = [ counts_1     0     ]
             [    0      blocks_2 ]               [    0      counts_2 ]

Each likelihood keeps its own noise, in its own channels. Nuisances are padded to the
largest number of any window; what is padded has the prior alone, and changes nothing.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from sim2gp.errors import error
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.types import in_float64


class Stacked(AbstractLikelihood):
    """``likelihoods`` of the same parameters, their errors independent of each other.

    Raises `InputError` E148 for none.
    """

    likelihoods: tuple[AbstractLikelihood, ...]
    counts: Float[Array, "W c"]
    floor: Float[Array, " c"]

    @in_float64
    def __init__(self, likelihoods: Sequence[AbstractLikelihood]) -> None:
        if not likelihoods:
            raise error("no_likelihoods", where="Stacked", got="none")
        self.likelihoods = tuple(likelihoods)
        self.counts = block_diag(*(each.counts for each in likelihoods))
        self.floor = jnp.concatenate([each.floor for each in likelihoods])

    @property
    def n_nuisances(self) -> int:
        return max(each.n_nuisances for each in self.likelihoods)

    @property
    def on_host(self) -> bool:
        return any(each.on_host for each in self.likelihoods)

    def first_noise(self) -> Noise:
        found = [each.first_noise() for each in self.likelihoods]
        return Noise(
            jnp.concatenate([noise.sd for noise in found]),
            jnp.concatenate([noise.weights for noise in found]),
        )

    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p p"],
    ) -> Blocks:
        (W, c), n = self.counts.shape, e.shape[1]
        k = n + scale.shape[1] + 1
        blocks, w = [], 0
        for each in self.likelihoods:
            own = e[w : w + len(each.counts), : each.n_nuisances]
            blocks.append(each.blocks(tt, own, scale))
            w += len(own)
        most = max(block.shape[2] for block in blocks)
        found, w, i = jnp.zeros((W, c, most, k), e.dtype), 0, 0
        for each, block in zip(self.likelihoods, blocks, strict=True):
            rows, columns, size, _ = block.shape
            windows, channels = w + np.arange(rows), i + np.arange(columns)
            place = np.concatenate([np.arange(each.n_nuisances), np.arange(n, k)])
            at = np.ix_(windows, channels, np.arange(size), place)
            found = found.at[at].set(block)
            w, i = w + rows, i + columns
        return found
