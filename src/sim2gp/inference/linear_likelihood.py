"""A likelihood linearised once: the same fit, without a simulator.

    r(z, e) = r0 + J_e e + J_z (z - z0)

From the factors of ``[J_e J_z r0]`` at one point, as any likelihood gives them
(`sim2gp.inference.likelihood`), follow those at any other. `estimate` of it is exact
linear regression with unknown noise: what one linearisation of the data says.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.likelihood import AbstractLikelihood, Trial


class LinearLikelihood(AbstractLikelihood):
    """``at`` are the factors at virtual parameters ``tt`` and nuisances of zero.

    ``scale`` are the directions of their ``J_z``, a square matrix; ``noise`` is the
    first one of a fit.
    """

    counts: Float[Array, "W c"]
    floor: Float[Array, " c"]
    at: Float[np.ndarray, "W c k k"]
    tt: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, "p p"]
    noise: Noise

    @property
    def n_nuisances(self) -> int:
        return int(self.at.shape[-1] - len(self.tt) - 1)

    @property
    def on_host(self) -> bool:
        return True  # NumPy: there is nothing to compile

    def first_noise(self) -> Noise:
        return self.noise

    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p p"],
    ) -> Blocks:
        trial = self.trial(*map(np.asarray, (tt, e, scale)))
        return jnp.asarray(trial.blocks())

    def trial(
        self,
        tt: Float[np.ndarray, " p"],
        e: Float[np.ndarray, "W n"],
        scale: Float[np.ndarray, "p p"],
    ) -> Trial:
        n = self.n_nuisances
        own, shared = self.at[..., :n], self.at[..., n:-1]
        moved = shared @ np.linalg.solve(self.scale, tt - self.tt)
        r = self.at[..., -1] + moved + np.einsum("wcij,wj->wci", own, e)

        def blocks() -> Float[np.ndarray, "W c k k"]:
            turned = shared @ np.linalg.solve(self.scale, scale)
            return np.concatenate([own, turned, r[..., None]], axis=-1)

        return Trial(np.sum(r**2, axis=-1), blocks)
