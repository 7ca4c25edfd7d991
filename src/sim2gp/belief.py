"""What a model is: a recipe that turns data into a belief, and a belief gives draws.

``init -> fit -> sample`` is all that a loop needs. Two alternatives to posterior
sampling are always there: the point estimate (certainty equivalence) and the prior
mean, which never learns.
"""

from abc import abstractmethod
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.information import Sensitivity, joint
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
        """The best single function: plain physics where there is any; float32."""

    def untempered(self) -> "AbstractBelief":
        """What posterior sampling draws from: only as wide as more data would settle.

        The belief itself, unless it is wider because its simulator is wrong: acting to
        find out about that finds out nothing.
        """
        return self

    @in_float64
    def parameters(self) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
        """Virtual mean and sd of a simulator's parameters; empty where there are none.

        As many at every call: a run keeps them side by side.
        """
        nothing = jnp.zeros(0, self.noise.dtype)
        return nothing, nothing

    @abstractmethod
    def sensitivity(self, s: State, a: Action) -> Sensitivity:
        """How ``s'`` moves with the belief's standard normal coordinates, in noise sd.

        Along those that all outputs share, and along each output's own
        (`inference.information`), in the precision of the belief's numbers.
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

    @property
    def history(self) -> int:
        """Number of past actions that its states carry: of a machine of late inputs."""
        return 0

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

    def shared(self, draw: Dynamics) -> Dynamics:
        """The same draw, in a form that the draws of all beliefs of this model have.

        Runs that are planned in one program ask for it.
        """
        return draw
