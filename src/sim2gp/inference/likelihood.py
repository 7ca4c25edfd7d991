"""What an estimate asks of data: factors of their rows, how many there are, a floor.

One-step data (`sim2gp.data.one_step`) and windows of logs
(`sim2gp.data.windows_likelihood`) are likelihoods, and so are several together
(`sim2gp.inference.stacked`); nothing here knows of simulators.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Blocks, Noise


class Trial(NamedTuple):
    """Data at a point that a descent on the host tries: what decides, and the rest.

    ``squares`` sum the squared residuals of each window and channel; ``blocks`` asks
    for the derivatives.
    """

    squares: Float[np.ndarray, "W c"]
    blocks: Callable[[], Float[np.ndarray, "W c b k"]]


class AbstractLikelihood(eqx.Module):
    """Windows ``w`` of data in channels ``c``, as least squares.

    ``counts`` are the samples of each window and channel, ``floor`` the least noise sd
    that a channel can have: its resolution.
    """

    counts: AbstractVar[Float[Array, "W c"]]
    floor: AbstractVar[Float[Array, " c"]]

    @property
    @abstractmethod
    def n_nuisances(self) -> int:
        """Number of unknowns that each window has of its own, ``n``."""

    @property
    def on_host(self) -> bool:
        """Whether `blocks` asks a simulator on the host, outside compiled programs."""
        return False

    def thinned(self, count: int) -> "AbstractLikelihood":
        """That of about so many rows, for a first look; where rows are few, itself."""
        del count
        return self

    @abstractmethod
    def first_noise(self) -> Noise:
        """The noise that a new fit begins with: a large one traps no first MAP."""

    @abstractmethod
    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p q"],
    ) -> Blocks:
        """Factors of ``[J_e J_z r]``, of residuals in the channels' own units.

        At virtual parameters ``tt`` and whitened nuisances ``e``; ``J_z`` is the
        derivative along each column of ``scale``.
        """

    def trial(
        self,
        tt: Float[np.ndarray, " p"],
        e: Float[np.ndarray, "W n"],
        scale: Float[np.ndarray, "p p"],
    ) -> Trial:
        """The same in NumPy, with `blocks` asked for later. Call it in float64."""
        found = np.asarray(self.blocks(*map(jnp.asarray, (tt, e, scale))))
        return Trial(np.sum(found[..., -1] ** 2, axis=-1), lambda: found)
