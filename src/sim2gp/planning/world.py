"""What planners see: a world made of one dynamics and one objective.

Posterior sampling draws worlds. A `World` is one draw ``s' = f(s, a)``, one objective
and the limits of the machine; a planner turns it into actions and knows nothing of
beliefs or data. Rollouts are guarded: a state that is not finite or beyond 1e10 makes
the whole rollout invalid, a finite one is clipped to ``|s| <= state_bound`` so that a
draw that is wrong far away cannot run off.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp import checks
from sim2gp.systems.trigonometry import cosine, sine
from sim2gp.types import Action, Box, Dynamics, Key, Reward, Scalar, State, check_reward

#: A rollout beyond this magnitude has diverged, in any units.
DIVERGED = 1e10


class AbstractObjective(eqx.Module):
    """What is maximised along a trajectory; it may carry state from step to step."""

    @abstractmethod
    def init(self) -> Any:
        """The carry at the start of a rollout; ``()`` where nothing is carried."""

    @abstractmethod
    def step(self, carry: Any, s: State, a: Action, s2: State) -> tuple[Any, Scalar]:
        """The next carry and the reward of one step."""

    @abstractmethod
    def along(
        self,
        carry: Any,
        S: Float[Array, "H n"],
        A: Float[Array, "H m"],
        S2: Float[Array, "H n"],
    ) -> Float[Array, " H"]:
        """The rewards of a whole trajectory: what `step` gives, one after the other."""


class MarkovObjective(AbstractObjective):
    """The sum of a reward ``r(s, a, s')`` that remembers nothing."""

    reward: Reward

    def init(self) -> tuple[()]:
        return ()

    def step(self, carry: Any, s: State, a: Action, s2: State) -> tuple[Any, Scalar]:
        return carry, self.reward(s, a, s2)

    def along(
        self,
        carry: Any,
        S: Float[Array, "H n"],
        A: Float[Array, "H m"],
        S2: Float[Array, "H n"],
    ) -> Float[Array, " H"]:
        return jax.vmap(self.reward)(S, A, S2)


class Resumed(AbstractObjective):
    """An objective in the middle of a trajectory: what came before is in ``carry``."""

    objective: AbstractObjective
    carry: Any

    def init(self) -> Any:
        return self.carry

    def step(self, carry: Any, s: State, a: Action, s2: State) -> tuple[Any, Scalar]:
        return self.objective.step(carry, s, a, s2)

    def along(
        self,
        carry: Any,
        S: Float[Array, "H n"],
        A: Float[Array, "H m"],
        S2: Float[Array, "H n"],
    ) -> Float[Array, " H"]:
        return self.objective.along(carry, S, A, S2)


class Observation(eqx.Module):
    """A state as a network sees it: turns of an angle are one, the rest of order one.

    angle: the state whose turns do not count, as (sin, cos), or None.
    scale: of every state; what a world's state carries beyond these is not seen.

    Raises `InputError` E148 for a scale that is not positive, or an angle that is none
    of the states.
    """

    scale: Float[Array, " n"]
    angle: int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        checks.positive_or_infinite("Observation", scale=self.scale)
        checks.index("Observation", np.shape(self.scale)[0], angle=self.angle)

    def __call__(self, s: State) -> Float[Array, " o"]:
        scaled = s[: self.scale.size] / self.scale
        if self.angle is None:
            return scaled
        turn = jnp.stack([sine(s[self.angle]), cosine(s[self.angle])])
        rest = jnp.concatenate([scaled[: self.angle], scaled[self.angle + 1 :]])
        return jnp.concatenate([rest, turn])

    @property
    def size(self) -> int:
        """Number of observed numbers."""
        return self.scale.size + (self.angle is not None)


def _paid(objective: AbstractObjective, *step: Any) -> Any:
    """The reward of one step, without the carry."""
    return objective.step(*step)[1]


class World(eqx.Module):
    """One draw of everything a planner needs; a pytree, so a new draw is new data.

    ``horizon`` is the episode's length in steps, ``history`` the number of past actions
    (newest first) at the end of the state, for delayed inputs. The planning defaults
    travel with the machine: a fast pendulum wants a short plan and restless noise, a
    slow one the opposite, and a planner built without arguments is right on both.
    So does what a policy sees of a state; None is the state as it is.

    Raises `InputError` E148 for a number that cannot be; E140, E123 and E173 for a
    function of another shape, of no real numbers, or that raises.
    """

    dynamics: Dynamics
    objective: AbstractObjective
    reset: Callable[[Key], Array]
    actions: Box
    horizon: int = eqx.field(static=True)
    state_bound: Float[Array, " n"] | None = None
    history: int = eqx.field(static=True, default=0)
    planning_horizon: int = eqx.field(static=True, default=30)
    planning_iterations: int = eqx.field(static=True, default=4)
    noise_colour: float = eqx.field(static=True, default=1.0)
    seen: Observation | None = None

    def __check_init__(self) -> None:
        lengths = {"horizon": self.horizon, "planning_horizon": self.planning_horizon}
        checks.count("World", **lengths, planning_iterations=self.planning_iterations)
        checks.whole("World", history=self.history)
        checks.finite("World", noise_colour=self.noise_colour)
        checks.positive_or_infinite("World", state_bound=self.state_bound)
        self._check_functions()

    def _check_functions(self) -> None:
        """That the dynamics move a start, and the objective pays for it."""
        s = checks.shapes(self.reset, jax.random.key(0))
        shape = getattr(s, "shape", ())
        if len(shape) != 1:
            name, whose = checks.name_of(self.reset), "a number for each state"
            got = shape if shape else f"a {type(s).__name__}"
            raise checks.another_shape("a start", name, got, (1,), whose)
        checks.same_shape("World", shape, state_bound=self.state_bound)
        low, objective = self.actions.low, self.objective
        a = jax.ShapeDtypeStruct(np.shape(low), jnp.result_type(low))
        whose = "the state's"
        checks.returns("a next state", self.dynamics, (s, a), shape, meaning=whose)
        if isinstance(objective, MarkovObjective):
            check_reward(objective.reward, s, a)
            return
        name = type(objective).__name__
        carry = checks.shapes(objective.init, name=f"{name}.init")
        paid = jax.tree_util.Partial(_paid, objective)
        checks.returns("a reward", paid, (carry, s, a, s), (), name=f"{name}.step")
        S, A = (jax.ShapeDtypeStruct((2, *x.shape), x.dtype) for x in (s, a))
        many, name = (carry, S, A, S), f"{name}.along"
        checks.returns("rewards", objective.along, many, (2,), name=name)

    @property
    def observe(self) -> Observation:
        """What a policy sees of a state."""
        if self.seen is not None:
            return self.seen
        start = jax.eval_shape(self.reset, jax.random.key(0))
        return Observation(jnp.ones(start.shape, start.dtype))

    def step(self, s: State, a: Action) -> tuple[State, Bool[Array, ""]]:
        """The guarded next state, and whether the dynamics gave a usable one."""
        s2 = self.dynamics(s, a)
        # Judge before clipping: clip would turn inf into a respectable number.
        usable = jnp.all(jnp.abs(s2) < DIVERGED)
        if self.state_bound is not None:
            s2 = jnp.clip(s2, -self.state_bound, self.state_bound)
        return s2, usable


class AbstractPlanner(eqx.Module):
    """Turns worlds into actions; all state is explicit, all methods are pure."""

    @abstractmethod
    def init(self, world: World, *, key: Key) -> Any:
        """The state before anything is known."""

    @abstractmethod
    def prepare(self, state: Any, world: World, data: Any, *, key: Key) -> Any:
        """Get ready for an episode in a new world; ``data`` are past transitions."""

    @abstractmethod
    def act(
        self, state: Any, world: World, s: State, *, key: Key
    ) -> tuple[Action, Any]:
        """The action at ``s``, inside the world's box, and the next state."""

    @abstractmethod
    def failed(self, state: Any) -> Bool[Array, ""]:
        """Whether the last action rests on no valid prediction at all."""


def rollout(
    world: World, s: State, actions: Float[Array, "H m"]
) -> tuple[Float[Array, " H"], Bool[Array, ""]]:
    """The rewards of one action sequence from ``s``, and whether it is valid."""

    def step(carry: Any, a: Action) -> tuple[Any, State]:
        s, valid = carry
        s2, usable = world.step(s, a)
        return (s2, valid & usable), s2

    start = (s, jnp.all(jnp.isfinite(s)))
    (_, valid), S2 = jax.lax.scan(step, start, actions)
    S = jnp.concatenate([s[None], S2[:-1]])
    objective = world.objective
    rewards = objective.along(objective.init(), S, actions, S2)
    return rewards, valid & jnp.isfinite(jnp.sum(rewards))


def masked(returns: Float[Array, " N"], valid: Bool[Array, " N"]) -> Float[Array, " N"]:
    """Returns that can be ranked: every invalid one is the smallest finite number.

    Before any ranking, because ``top_k`` puts NaN first.
    """
    return jnp.where(valid, returns, jnp.finfo(returns.dtype).min)
