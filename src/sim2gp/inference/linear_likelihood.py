"""A likelihood linearised once: the same fit, without a simulator.

    r(tt, e) = r0 + J_e (e - e0) + J_tt (tt - tt0)

From the factors of ``[J_e J_tt r0]`` at one point, as any likelihood gives them
(`sim2gp.inference.likelihood`), follow those at any other. `estimate` of it is exact
linear regression with unknown noise: what one linearisation of the data says.
"""

import numpy as np
from jaxtyping import Float

from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.likelihood import AbstractLikelihood, Trial
from sim2gp.inference.linalg import library
from sim2gp.types import AnyArray


class LinearLikelihood(AbstractLikelihood):
    """``base`` are the factors at virtual parameters ``tt0`` and nuisances ``e0``.

    Its derivatives are those in ``tt`` itself; ``noise`` is the first one of a fit. Of
    NumPy's arrays the fit is one of the host: there is nothing to compile.
    """

    counts: Float[AnyArray, "W c"]
    floor: Float[AnyArray, " c"]
    base: Blocks
    tt0: Float[AnyArray, " p"]
    e0: Float[AnyArray, "W n"]
    noise: Noise

    @property
    def n_nuisances(self) -> int:
        return int(self.e0.shape[1])

    @property
    def on_host(self) -> bool:
        return library(self.base) is np

    def first_noise(self) -> Noise:
        return self.noise

    def blocks(
        self,
        tt: Float[AnyArray, " p"],
        e: Float[AnyArray, "W n"],
        scale: Float[AnyArray, "p p"],
    ) -> Blocks:
        xp, n = library(self.base, tt, e), self.n_nuisances
        away = xp.broadcast_to(tt - self.tt0, (len(e), tt.size))
        step = xp.concatenate([e - self.e0, away], axis=1)
        moved = xp.einsum("wckj,wj->wck", self.base[..., :-1], step)
        own, shared, r = self.base[..., :n], self.base[..., n:-1], self.base[..., -1]
        rows = [own, shared @ scale, (r + moved)[..., None]]
        return xp.concatenate(rows, axis=-1)

    def trial(
        self,
        tt: Float[np.ndarray, " p"],
        e: Float[np.ndarray, "W n"],
        scale: Float[np.ndarray, "p p"],
    ) -> Trial:
        found = np.asarray(self.blocks(tt, e, scale))
        return Trial(np.sum(found[..., -1] ** 2, axis=-1), lambda: found)
