"""Beliefs of one function alone: the MAP, and the prior mean that never learns.

References for posterior sampling: the point estimate (certainty equivalence), and the
simulator as delivered.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity
from sim2gp.types import Action, Dynamics, Key, State, in_float64


class DeterministicBelief(AbstractBelief):
    """A belief whose draws all are one function.

    Its noise and parameters are those of ``belief``; the function is its best one.
    """

    belief: AbstractBelief

    @property
    def noise(self) -> Float[Array, " d"]:
        return self.belief.noise

    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        return self.belief.parameters()

    @in_float64
    def latent(self, s: State, a: Action) -> Gaussian:
        s, a = (jnp.asarray(x, jnp.float32) for x in (s, a))  # a draw's precision
        mean = self.point()(s, a).astype(self.noise.dtype)
        return Gaussian(mean, jnp.zeros((mean.size, 1), mean.dtype))

    def predict(self, s: State, a: Action) -> Gaussian:
        return self.belief.predict(s, a)

    def sample(self, key: Key) -> Dynamics:
        del key
        return self.belief.point()

    def point(self) -> Dynamics:
        return self.belief.point()

    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        nothing = jnp.zeros((self.coordinates[0], 0))
        return nothing, nothing

    @property
    def coordinates(self) -> tuple[int, int, int]:
        return self.belief.coordinates[0], 0, 0


class PointEstimate(AbstractModel):
    """Certainty equivalence: fit like ``model``, then act as if the MAP were true."""

    model: AbstractModel

    @property
    def history(self) -> int:
        return self.model.history

    def init(self, key: Key) -> DeterministicBelief:
        return DeterministicBelief(self.model.init(key))

    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> DeterministicBelief:
        assert isinstance(belief, DeterministicBelief)
        return DeterministicBelief(self.model.fit(belief.belief, data, key=key))

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> DeterministicBelief:
        assert isinstance(belief, DeterministicBelief)
        return DeterministicBelief(self.model.update(belief.belief, s, a, s2))


class PriorMean(AbstractModel):
    """The simulator as delivered: acts on the prior mean and never learns."""

    model: AbstractModel

    @property
    def history(self) -> int:
        return self.model.history

    def init(self, key: Key) -> DeterministicBelief:
        return DeterministicBelief(self.model.init(key))

    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> AbstractBelief:
        del data, key
        return belief

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> AbstractBelief:
        del s, a, s2
        return belief
