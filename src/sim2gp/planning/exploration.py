"""What an explorer maximises: information, or reward with a bonus for the unknown.

Objectives for any planner, made of a belief. Planning is in float32, and so is what
they hold of the belief.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from sim2gp.belief import AbstractBelief
from sim2gp.inference.information import Seen, increments
from sim2gp.planning.world import AbstractObjective
from sim2gp.types import Action, Reward, Scalar, State


class InformationGain(AbstractObjective):
    """Nats that a trajectory is expected to give a belief.

    With ``together``, what a step repeats of those before it, planned or made, counts
    nothing; without, every step is judged as if it were the first one: Markov, as
    off-policy learners need it, and blind to redundancy.
    """

    belief: AbstractBelief
    together: bool = eqx.field(static=True, default=True)

    def init(self) -> Seen:
        return Seen.nothing(*self.belief.coordinates)

    def step(self, carry: Seen, s: State, a: Action, s2: State) -> tuple[Seen, Scalar]:
        shared, own = self.belief.sensitivity(s, a)
        left = carry.left(shared, own)
        gain = increments(*(x[None] for x in left))[0]
        return carry.after(shared, own) if self.together else carry, gain

    def along(
        self,
        carry: Seen,
        S: Float[Array, "T n"],
        A: Float[Array, "T m"],
        S2: Float[Array, "T n"],
    ) -> Float[Array, " T"]:
        left = carry.left(*jax.vmap(self.belief.sensitivity)(S, A))
        if self.together:
            return increments(*left)
        each = tuple(x[:, None] for x in left)
        return jax.vmap(lambda *one: increments(*one)[0])(*each)


class Optimistic(eqx.Module):
    """A step's reward, and ``weight`` for each noise sd of doubt about ``s'``.

    The bonus is the norm of the epistemic sd over all outputs, each in its noise's.
    """

    reward: Reward
    belief: AbstractBelief
    weight: Scalar

    def __call__(self, s: State, a: Action, s2: State) -> Scalar:
        variance = sum(jnp.sum(x**2) for x in self.belief.sensitivity(s, a))
        return self.reward(s, a, s2) + self.weight * jnp.sqrt(variance)


class Restrained(AbstractObjective):
    """An objective within limits: going beyond one by as much again costs ``weight``.

    ``bound`` is that of ``|s'|``, infinite where there is none.
    """

    objective: AbstractObjective
    bound: Float[Array, " n"]
    weight: Scalar

    def init(self) -> Any:
        return self.objective.init()

    def step(self, carry: Any, s: State, a: Action, s2: State) -> tuple[Any, Scalar]:
        carry, reward = self.objective.step(carry, s, a, s2)
        return carry, reward - self._cost(s2)

    def along(
        self,
        carry: Any,
        S: Float[Array, "T n"],
        A: Float[Array, "T m"],
        S2: Float[Array, "T n"],
    ) -> Float[Array, " T"]:
        return self.objective.along(carry, S, A, S2) - jax.vmap(self._cost)(S2)

    def _cost(self, s2: State) -> Scalar:
        beyond = jnp.abs(s2[: self.bound.size]) / self.bound - 1.0
        return self.weight * jnp.sum(jnp.maximum(beyond, 0.0))
