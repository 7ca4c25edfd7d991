"""What an experiment is for: all parameters, some of them, or a prediction.

Each goal counts nats: half the log of how much a variance (a volume, a mean square)
shrinks. So goals can be compared, and an experiment without information about the goal
is worth 0.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.inference.gaussian import log_det_factor
from sim2gp.inference.linalg import triangular
from sim2gp.types import Scalar

#: Square root of a covariance of the virtual parameters.
Scale = Float[Array, "p p"]


class AbstractGoal(eqx.Module):
    """What is to become more certain."""

    @abstractmethod
    def uncertainty(self, scale: Scale) -> Scalar:
        """In nats, up to a constant."""

    @abstractmethod
    def directions(self, scale: Scale) -> int:
        """How many variances its nats count: a volume counts all of its axes."""

    def nats(self, before: Scale, after: Scale) -> Scalar:
        """What going from one belief to the other is worth."""
        return self.uncertainty(before) - self.uncertainty(after)


class DOptimal(AbstractGoal):
    """All parameters alike: the volume of the whole belief (D-optimality)."""

    def uncertainty(self, scale: Scale) -> Scalar:
        return log_det_factor(triangular(scale.T))

    def directions(self, scale: Scale) -> int:
        return len(scale)


class SubsetDOptimal(AbstractGoal):
    """Some parameters, without regard to the others: their marginal's volume."""

    index: tuple[int, ...] = eqx.field(static=True)

    def uncertainty(self, scale: Scale) -> Scalar:
        rows = scale[jnp.asarray(self.index)]
        return log_det_factor(triangular(rows.T)[: len(self.index)])

    def directions(self, scale: Scale) -> int:
        return len(self.index)


class VOptimal(AbstractGoal):
    """What a prediction depends on: its mean variance, each row in its own unit."""

    rows: Float[Array, "k p"]

    def uncertainty(self, scale: Scale) -> Scalar:
        return jnp.log(self.deviation(scale))

    def deviation(self, scale: Scale) -> Scalar:
        """Root mean square of the predictions' sd."""
        return jnp.sqrt(jnp.mean(jnp.sum((self.rows @ scale) ** 2, axis=1)))

    def directions(self, scale: Scale) -> int:
        return 1
