"""What a sampling planner keeps between steps, and how an update rule improves it."""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from sim2gp.planning.world import World
from sim2gp.types import Key

#: Unit-box sequences ``(N, H, m)`` to their returns and validity ``(N,)``.
Evaluate = Callable[[Array], tuple[Array, Array]]


class Plan(eqx.Module):
    """What survives from one control step to the next; always finite."""

    mean: Float[Array, "H m"]
    elites: Float[Array, "K H m"]
    valid: Int[Array, ""]

    def shift(self) -> "Plan":
        """The same plan seen one step later; the last action is repeated."""
        mean = jnp.concatenate([self.mean[1:], self.mean[-1:]])
        elites = jnp.concatenate([self.elites[:, 1:], self.elites[:, -1:]], axis=1)
        return Plan(mean, elites, self.valid)


class AbstractUpdate(eqx.Module):
    """How sampled returns become a better plan."""

    @abstractmethod
    def init(self, horizon: int, size: int, dtype: jnp.dtype) -> Plan:
        """The plan that knows nothing: all actions in the middle of the box."""

    @abstractmethod
    def improve(
        self, plan: Plan, evaluate: Evaluate, world: World, *, key: Key
    ) -> tuple[Float[Array, "H m"], Plan]:
        """The sequence to execute and the better plan.

        With no valid rollout the plan is returned as it came, with ``valid`` 0.
        """
