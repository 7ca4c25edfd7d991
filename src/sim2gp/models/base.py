"""What a model is: a recipe that turns data into a belief, and a belief gives draws.

``init -> fit -> sample`` is all that a loop needs. Beside posterior sampling always
stand the point estimate (certainty equivalence) and the unlearned prior mean.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.gaussian import Gaussian
from sim2gp.models.information import Sensitivity, joint
from sim2gp.transitions import Transitions
from sim2gp.types import Action, Dynamics, Key, Scalar, State, double, in_float64


class AbstractBelief(eqx.Module):
    """A distribution over dynamics: what is believed after some data.

    ``noise`` is the sd of one step of each physical state, state units.
    """

    if TYPE_CHECKING:  # a field or a property; to mypy an abstract field is the first

        @property
        def noise(self) -> Float[Array, " d"]: ...

    else:
        noise: AbstractVar[Float[Array, " d"]]

    @abstractmethod
    def latent(self, s: State, a: Action) -> Gaussian:
        """Epistemic distribution of ``s'``, without noise."""

    @abstractmethod
    def predict(self, s: State, a: Action) -> Gaussian:
        """Predictive distribution of ``s'``, with noise."""

    @abstractmethod
    def sample(self, key: Key) -> Dynamics:
        """One function: every query sees the same draw. A pytree of float32."""

    @abstractmethod
    def point(self) -> Dynamics:
        """The best single function, of the same type as a draw."""

    def learnable(self) -> "AbstractBelief":
        """What posterior sampling draws from: only as wide as more data would settle.

        The belief itself, unless it is wider because its simulator is wrong: acting to
        find out about that finds out nothing.
        """
        return self

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Virtual mean and sd of a simulator's constants; empty where there are none.

        As many at every call: a run keeps them side by side.
        """
        nothing = jnp.zeros(0, self.noise.dtype)
        return nothing, nothing

    @abstractmethod
    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        """How ``s'`` moves with the belief's standard normal coordinates, in noise sd.

        Along those that all outputs share, and along each output's own
        (`models.information`), in the precision of the belief's numbers.
        """

    @property
    @abstractmethod
    def coordinates(self) -> tuple[int, int, int]:
        """``(d, p, m)``: outputs, shared coordinates, coordinates of each output."""

    @in_float64
    def information_gain(self, s: State, a: Action) -> Scalar:
        """Nats that one more transition from here is expected to give."""
        s, a = double(s, a)
        return self.trajectory_information_gain(s[None], a[None])

    @in_float64
    def trajectory_information_gain(
        self, S: Float[Array, "T n"], A: Float[Array, "T m"]
    ) -> Scalar:
        """Nats that a whole trajectory is expected to give, redundancy removed."""
        return _joint_along(self, *double(S, A))


@eqx.filter_jit
def _joint_along(
    belief: AbstractBelief, S: Float[Array, "T n"], A: Float[Array, "T m"]
) -> Scalar:
    return joint(*jax.vmap(belief.sensitivity)(S, A))


class AbstractModel(eqx.Module):
    """A recipe; it keeps the prior, and has no data."""

    @abstractmethod
    def init(self, key: Key) -> AbstractBelief:
        """The belief before any data."""

    @abstractmethod
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> AbstractBelief:
        """The posterior given *all* of the data; ``belief`` only warm-starts."""

    @abstractmethod
    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> AbstractBelief:
        """One more transition: pure and shape-stable, for use inside scans."""


class DeterministicBelief(AbstractBelief):
    """A belief whose draws all are one function.

    Its noise and constants are those of ``belief``, whose best function that is.
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
