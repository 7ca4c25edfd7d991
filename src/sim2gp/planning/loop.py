"""The loop: believe, draw one world, act in it for an episode, learn, repeat.

Posterior sampling (Thompson 1933; Osband et al. 2013, arXiv 1306.0940): each episode
is planned in ONE draw from the belief, held fixed until the episode ends. With the
task's reward it is posterior-sampling reinforcement learning, with information gain
it is active learning. With ``update_every`` the belief is updated *within* the episode
as well, and the draw moves with it: same random numbers, newer posterior.
"""

from collections.abc import Callable
from typing import Any, TypedDict, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp import checks
from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.errors import of_callbacks
from sim2gp.planning.episode import Purpose, Trajectory, episode, key_for, world_of
from sim2gp.planning.exploration import InformationGain, Optimistic, Restrained
from sim2gp.planning.tasks import Task
from sim2gp.planning.world import (
    AbstractObjective,
    AbstractPlanner,
    MarkovObjective,
    World,
)
from sim2gp.types import Dynamics, Key, double, in_float64, single

#: Nats a step, of leaving the trusted box by as much again.
LIMIT_COST = 100.0


class Episode(eqx.Module):
    """What `posterior_sampling` reports after each episode; ``index`` counts from 1."""

    index: int
    trajectory: Trajectory
    belief: AbstractBelief


class History(eqx.Module):
    """A whole run, as numpy arrays: E episodes of T steps.

    ``parameter_mean`` and ``parameter_sd`` (virtual) have E + 1 rows, the prior first,
    and no columns for beliefs without parameters. ``belief`` has seen all episodes;
    ``planner`` is the planner's last state, in which SAC keeps its policy.
    """

    state: Float[np.ndarray, "E times n"]
    action: Float[np.ndarray, "E T m"]
    reward: Float[np.ndarray, "E T"]
    failed: Bool[np.ndarray, "E T"]
    parameter_mean: Float[np.ndarray, "rounds p"]
    parameter_sd: Float[np.ndarray, "rounds p"]
    belief: AbstractBelief
    data: Transitions
    planner: Any

    @property
    def returns(self) -> Float[np.ndarray, " E"]:
        """The sum of rewards of each episode."""
        return self.reward.sum(axis=1, dtype=np.float64)


def drawn(belief: AbstractBelief, key: Key) -> Dynamics:
    """Posterior sampling's world: a draw that is as wide as more data would settle."""
    return belief.untempered().sample(key)


def expected(belief: AbstractBelief, key: Key) -> Dynamics:
    """The mean world, for objectives that themselves look for the unknown."""
    del key
    return belief.point()


def _check_counts(episodes: int, history: int, update_every: int | None) -> None:
    """E148 for numbers that no run can have."""
    checks.count("a run", episodes=episodes, update_every=update_every)
    checks.whole("a run", history=history)


@of_callbacks()
def posterior_sampling(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    objective: Callable[[AbstractBelief], AbstractObjective],
    episodes: int,
    key: Key,
    history: int = 0,
    update_every: int | None = None,
    final_fit: bool = True,
    on_episode: Callable[[Episode], None] | None = None,
    world: Callable[[AbstractBelief, Key], Dynamics] = drawn,
) -> History:
    """``episodes`` rounds of: draw a world, act in it on ``task``, fit all data.

    ``objective`` makes what is maximised out of the belief at the episode's start,
    ``world`` what it is planned in. The first episode uses the prior. ``history`` is
    the number of past actions that the model's state carries. ``update_every`` is None
    or a number of steps after which the belief learns within the episode (`within`).
    Without a ``final_fit`` the last episode is run and not fitted, for users who need
    its return alone. ``on_episode`` is called after each fit. Raises what the fit
    raises, `NotFinite`, and E148 for an impossible count.
    """
    _check_counts(episodes, history, update_every)
    run = SamplingRun(task, model, planner, objective, episodes, key, history, world)
    for e in range(1, episodes + 1):
        trajectory = run.next(update_every)
        if final_fit or e < episodes:
            run.fit()
        if on_episode is not None:
            on_episode(Episode(e, trajectory, run.belief))
    return run.result()


class SamplingRun:
    """A run of posterior sampling between its episodes: what is known, and what next.

    Before an episode `begin` gives the world to plan in, after it `keep` takes what
    was seen, and `fit` learns from it. ``episode`` counts from 1, 0 before the first.
    """

    def __init__(
        self,
        task: Task,
        model: AbstractModel,
        planner: AbstractPlanner,
        objective: Callable[[AbstractBelief], AbstractObjective],
        episodes: int,
        key: Key,
        history: int = 0,
        world: Callable[[AbstractBelief, Key], Dynamics] = drawn,
    ) -> None:
        """Arguments as those of `posterior_sampling`."""
        self.task, self.model, self.planner, self.key = task, model, planner, key
        self.objective, self.history, self.world = objective, history, world
        m = task.actions.low.size
        self.data = Transitions.empty(
            episodes * task.horizon, task.size + history * m, m
        )
        self.episode, self.planner_state = 0, None
        self.belief = model.init(key_for(key, 0, Purpose.INIT))
        self.summaries: list[tuple[np.ndarray, np.ndarray]] = []
        self.trajectories: list[Trajectory] = []

    def key_for(self, purpose: Purpose) -> Key:
        """The key of one purpose in this episode."""
        return key_for(self.key, self.episode, purpose)

    def world_in(self, belief: AbstractBelief, shared: bool = False) -> World:
        """This episode's world, by a belief; ``shared`` as `AbstractModel.shared`."""
        dynamics = self.world(belief, self.key_for(Purpose.DRAW))
        if shared:
            dynamics = self.model.shared(dynamics)
        objective = self.objective(belief)
        return world_of(self.task, dynamics, objective, history=self.history)

    def begin(self, *, shared: bool = False) -> World:
        """The next episode's world; the planner is ready for it."""
        self.episode += 1
        self.summaries.append(_parameters(self.belief))
        start, planner = self.world_in(self.belief, shared), self.planner
        if self.planner_state is None:
            first = key_for(self.key, 0, Purpose.PREPARE)
            self.planner_state = planner.init(start, key=first)
        self.planner_state = planner.prepare(
            self.planner_state, start, self.data, key=self.key_for(Purpose.PREPARE)
        )
        return start

    def next(self, update_every: int | None = None) -> Trajectory:
        """One episode, which is kept and not yet fitted."""
        start = self.begin()
        world_at = within(
            self.model,
            self.belief,
            self.data,
            self.history,
            self.world_in,
            key=self.key_for(Purpose.FIT),
        )
        seen, planner_state = episode(
            self.task,
            self.planner,
            self.planner_state,
            start,
            key=self.key_for(Purpose.EPISODE),
            part=update_every,
            world_at=world_at,
        )
        self.keep(seen, planner_state)
        return seen

    def keep(self, seen: Trajectory, planner_state: Any) -> None:
        """What an episode was, and the planner after it."""
        self.planner_state = planner_state
        self.trajectories.append(seen)
        self.data = self.data.extend(*seen.transitions(self.history))

    def fit(self) -> None:
        """Learn from all episodes. Raises what a fit raises."""
        key = self.key_for(Purpose.FIT)
        self.belief = self.model.fit(self.belief, self.data, key=key)

    def result(self) -> History:
        """All episodes so far."""
        return _history(
            self.trajectories,
            [*self.summaries, _parameters(self.belief)],
            self.belief,
            self.data,
            self.planner_state,
        )


def within(
    model: AbstractModel,
    belief: AbstractBelief,
    data: Transitions,
    history: int,
    world_in: Callable[[AbstractBelief], World],
    *,
    key: Key,
) -> Callable[[Trajectory], World]:
    """The world to plan in within an episode, given its steps so far.

    Parameters and last layer are conditioned on each new transition in turn
    (`AbstractModel.update`), features and noise are kept. Before any fit there is no
    noise level to condition with: in a first episode the model is fitted instead. What
    is learned here lasts for this episode; the fit after it starts from ``belief``.
    """
    seen = 0

    def world_at(past: Trajectory) -> World:
        nonlocal belief, seen
        S, A, S2 = past.transitions(history)
        if data.count == 0:
            belief = model.fit(belief, data.extend(S, A, S2), key=key)
        else:
            belief = _conditioned(model, belief, S[seen:], A[seen:], S2[seen:])
        seen = len(S)
        return world_in(belief)

    return world_at


@in_float64
def _conditioned(
    model: AbstractModel,
    belief: AbstractBelief,
    S: Float[np.ndarray, "T n"],
    A: Float[np.ndarray, "T m"],
    S2: Float[np.ndarray, "T n"],
) -> AbstractBelief:
    return _condition(model, belief, *double(S, A, S2))


@eqx.filter_jit
def _condition(
    model: AbstractModel, belief: AbstractBelief, S: Array, A: Array, S2: Array
) -> AbstractBelief:
    """Condition on rows one after the other, as one scan."""
    arrays, rest = eqx.partition(belief, eqx.is_array)

    def step(arrays: Any, row: Any) -> tuple[Any, None]:
        updated = model.update(eqx.combine(arrays, rest), *row)
        return eqx.filter(updated, eqx.is_array), None

    return eqx.combine(jax.lax.scan(step, arrays, (S, A, S2))[0], rest)


class Options(TypedDict, total=False):
    """Options of `posterior_sampling`, for any objective."""

    history: int
    update_every: int | None
    final_fit: bool
    on_episode: Callable[[Episode], None] | None
    world: Callable[[AbstractBelief, Key], Dynamics]


def psrl(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    episodes: int,
    key: Key,
    **options: Unpack[Options],
) -> History:
    """Posterior sampling with the task's own reward."""
    return posterior_sampling(
        task,
        model,
        planner,
        objective=lambda belief: MarkovObjective(task.reward),
        episodes=episodes,
        key=key,
        **options,
    )


def psal(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    episodes: int,
    key: Key,
    together: bool = True,
    limit_cost: float = LIMIT_COST,
    **options: Unpack[Options],
) -> History:
    """Posterior sampling with information gain for a reward: learn the machine itself.

    ``together`` is `InformationGain`'s. The states stay within the box that models are
    trusted in; going beyond it by as much again costs ``limit_cost`` nats a step.
    """
    checks.not_negative("psal", limit_cost=limit_cost)
    bound, cost = task.trusted, jnp.asarray(limit_cost, jnp.float32)

    def objective(belief: AbstractBelief) -> AbstractObjective:
        gain = InformationGain(single(belief.untempered()), together)
        return Restrained(gain, bound, cost)

    return posterior_sampling(
        task,
        model,
        planner,
        objective=objective,
        episodes=episodes,
        key=key,
        **options,
    )


def optimism(
    task: Task,
    model: AbstractModel,
    planner: AbstractPlanner,
    *,
    episodes: int,
    key: Key,
    weight: float,
    **options: Unpack[Options],
) -> History:
    """Instead of draws, the mean world, its reward raised where it is uncertain.

    ``weight`` is that of one noise sd of doubt about the next state (`Optimistic`).
    """
    checks.not_negative("optimism", weight=weight)
    each = jnp.asarray(weight, jnp.float32)

    def objective(belief: AbstractBelief) -> AbstractObjective:
        believed = single(belief.untempered())
        return MarkovObjective(Optimistic(task.reward, believed, each))

    return posterior_sampling(
        task,
        model,
        planner,
        objective=objective,
        episodes=episodes,
        key=key,
        **(Options(world=expected) | options),
    )


def _parameters(belief: AbstractBelief) -> tuple[np.ndarray, np.ndarray]:
    """Virtual mean and sd of the parameters, as they are now."""
    mean, sd = belief.parameters()
    return np.asarray(mean), np.asarray(sd)


def _history(
    trajectories: list[Trajectory],
    summaries: list[tuple[np.ndarray, np.ndarray]],
    belief: AbstractBelief,
    data: Transitions,
    planner: Any,
) -> History:
    whole = jax.tree.map(lambda *leaves: np.stack(leaves), *trajectories)
    return History(
        whole.state,
        whole.action,
        whole.reward,
        whole.failed,
        np.stack([mean for mean, _ in summaries]),
        np.stack([sd for _, sd in summaries]),
        belief,
        data,
        planner,
    )
