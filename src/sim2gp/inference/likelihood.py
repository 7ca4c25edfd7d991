"""What an estimate asks of data: factors of their rows, how many there are, a floor.

One-step data (`sim2gp.data.one_step`) and windows of logs
(`sim2gp.data.windows_likelihood`) are likelihoods, and so are several together
(`sim2gp.inference.stacked`); nothing here knows of simulators.
"""

from abc import abstractmethod

import equinox as eqx
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.inference.arrowhead import Blocks, Noise


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

    @abstractmethod
    def first_noise(self) -> Noise:
        """The noise that a new fit begins with: a large one traps no first MAP."""

    @abstractmethod
    def blocks(
        self,
        tt: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p p"],
    ) -> Blocks:
        """Factors of ``[J_e J_z r]``, of residuals in the channels' own units.

        At virtual parameters ``tt`` and whitened nuisances ``e``; ``J_z`` is the
        derivative along each column of ``scale``.
        """
