"""SAC: an actor and its critics, trained inside one world, act on the real machine.

Soft actor-critic (Haarnoja et al. 2018, arXiv 1812.05905) with twin critics, a squashed
Gaussian and a learned temperature. With ``alpha`` the temperature, ``Q'`` the slow
copies of the critics ``Q`` and ``u2 ~ pi(s2)``,

    y = r + gamma (min Q'(s2, u2) - alpha log pi(u2 | s2)),    critics: (Q(s, u) - y)^2
    actor: alpha log pi - min Q,       temperature: -log alpha (log pi + target entropy)

An episode ends because its time is up, never because nothing more could be earned: the
last step is bootstrapped like any other. What was tried in older worlds is tried again
in the new one (`Replay.again`): states and actions are kept, what follows is not.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int

from sim2gp import checks
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.networks import (
    MLP,
    Critics,
    Policy,
    random_critics,
    squashed,
    values,
)
from sim2gp.planning.world import AbstractPlanner, Observation, World
from sim2gp.types import Action, Box, Key, Scalar, State


class Replay(eqx.Module):
    """Steps that were made, in the unit box's actions; rows beyond ``count`` are none.

    The oldest rows are overwritten. A row that the world could not follow is not valid.
    """

    state: Float[Array, "C n"]
    action: Float[Array, "C m"]
    next_state: Float[Array, "C n"]
    reward: Float[Array, " C"]
    valid: Bool[Array, " C"]
    count: Int[Array, ""]

    @classmethod
    def empty(cls, capacity: int, n: int, m: int) -> "Replay":
        """Room for so many steps."""
        S, A = jnp.zeros((capacity, n)), jnp.zeros((capacity, m))
        nothing = jnp.zeros(capacity)
        return cls(S, A, S, nothing, nothing > 0.0, jnp.zeros((), int))

    def add(self, rows: Any) -> "Replay":
        """A block of rows; the capacity is a multiple of its length."""
        columns = self.state, self.action, self.next_state, self.reward, self.valid
        at = self.count % len(self.valid)

        def put(old: Array, new: Array) -> Array:
            return jax.lax.dynamic_update_slice_in_dim(old, new, at, 0)

        state, action, after, reward, valid = jax.tree.map(put, columns, rows)
        count = self.count + len(rows[-1])
        return Replay(state, action, after, reward, valid, count)

    def again(self, world: World) -> "Replay":
        """The same actions in the same states of another world."""
        step = jax.vmap(lambda s, u: made(world, s, u))
        S2, r, valid = step(self.state, self.action)
        valid = valid & (jnp.arange(len(valid)) < self.count)
        return Replay(self.state, self.action, S2, r, valid, self.count)


def made(
    world: World, s: State, u: Float[Array, " m"]
) -> tuple[State, Scalar, Bool[Array, ""]]:
    """One step: what follows, its reward, and whether the world could say either.

    An objective that remembers is asked as at the start of a trajectory.
    """
    a = from_unit(u[None], world.actions)[0]
    s2, usable = world.step(s, a)
    _, r = world.objective.step(world.objective.init(), s, a, s2)
    usable = usable & jnp.isfinite(r)
    return jnp.where(usable, s2, s), jnp.where(usable, r, 0.0), usable


class Learner(eqx.Module):
    """All that is trained, and what it is trained on.

    ``taught`` says whether anything in the replay could be followed.
    """

    observe: Observation
    box: Box

    actor: MLP
    critics: Critics
    targets: Critics
    log_temperature: Scalar
    optimisers: tuple[optax.OptState, ...]  # of the three, in the order of updates
    updates: Int[Array, ""]
    taught: Bool[Array, ""]
    replay: Replay

    @property
    def policy(self) -> Policy:
        """What was trained, ready for a machine."""
        return Policy(self.actor, self.observe, self.box)


class Rollouts(eqx.Module):
    """Worlds side by side, each somewhere in an episode."""

    state: Float[Array, "W n"]
    steps: Int[Array, " W"]


class SAC(AbstractPlanner):
    """Off-policy learning in the sampled world; then one network evaluation per step.

    hidden: widths of the layers of actor and critics.
    num_envs: episodes side by side, ``steps`` of each are made per preparation.
    updates: gradient steps after each step of all episodes, on ``batch`` rows.
    capacity: of the replay, in preparations.
    replayed: share of the episodes that begin where the real machine has been.
    scattered: share of those that begin anywhere: a world, unlike a machine, can.
    discount, rate, tau: of rewards per step, of Adam, of the critics' slow copies.
    scale: of the rewards, against the entropy of the policy.

    Raises `InputError` E148 for a setting that cannot be.
    """

    hidden: tuple[int, ...] = eqx.field(static=True, default=(64, 64))
    num_envs: int = eqx.field(static=True, default=64)
    steps: int = eqx.field(static=True, default=400)
    updates: int = eqx.field(static=True, default=32)
    batch: int = eqx.field(static=True, default=256)
    capacity: int = eqx.field(static=True, default=4)
    replayed: float | Scalar = 0.3
    scattered: float | Scalar = 0.6
    discount: float | Scalar = 0.99
    rate: float | Scalar = 1e-3
    tau: float | Scalar = 0.02
    scale: float | Scalar = 1.0

    def __check_init__(self) -> None:
        sizes = {"num_envs": self.num_envs, "steps": self.steps}
        sizes |= {"updates": self.updates, "batch": self.batch}
        checks.count("SAC", **sizes, capacity=self.capacity)
        checks.count("SAC", hidden=self.hidden)
        shares = {"replayed": self.replayed, "scattered": self.scattered}
        checks.share("SAC", **shares, discount=self.discount, tau=self.tau)
        checks.not_negative("SAC", rate=self.rate, scale=self.scale)

    def optimiser(self) -> optax.GradientTransformation:
        """Adam; never so many bad gradients that one is let through."""
        adam = optax.adam(self.rate)
        return optax.apply_if_finite(adam, max_consecutive_errors=2**31 - 1)

    def init(self, world: World, *, key: Key) -> Learner:
        first, second, third = jax.random.split(key, 3)
        n, m = world.reset(third).size, world.actions.low.size
        observe = world.observe
        actor = MLP.random(first, (observe.size, *self.hidden, 2 * m))
        critics = random_critics(second, observe.size, m, self.hidden)
        log_temperature = jnp.zeros(())
        adam = self.optimiser()
        optimisers = tuple(map(adam.init, (critics, actor, log_temperature)))
        rows = self.capacity * self.num_envs * self.steps
        replay = Replay.empty(rows, n, m)
        none, taught = jnp.zeros((), int), jnp.asarray(False)
        return Learner(
            observe,
            world.actions,
            actor,
            critics,
            critics,
            log_temperature,
            optimisers,
            none,
            taught,
            replay,
        )

    def prepare(self, state: Learner, world: World, data: Any, *, key: Key) -> Learner:
        starts = jnp.asarray(data.state, state.replay.state.dtype)
        return _trained(self, state, world, starts, jnp.asarray(data.mask), key)

    def act(
        self, state: Learner, world: World, s: State, *, key: Key
    ) -> tuple[Action, Learner]:
        del world, key  # draws of the belief explore, not the policy
        return state.policy(s), state

    def failed(self, state: Learner) -> Bool[Array, ""]:
        return ~state.taught


@eqx.filter_jit
def _trained(
    sac: SAC,
    learner: Learner,
    world: World,
    starts: Float[Array, "N n"],
    mask: Bool[Array, " N"],
    key: Key,
) -> Learner:
    """A whole preparation: replay relabelled, then steps and updates in turns."""
    learner = eqx.tree_at(lambda l: l.replay, learner, learner.replay.again(world))

    def fresh(key: Key) -> State:
        where, which, how = jax.random.split(key, 3)
        start, count = world.reset(how), jnp.sum(mask)
        row = jax.random.randint(which, (), 0, jnp.maximum(count, 1))
        u = jax.random.uniform(where)
        replayed = (count > 0) & (u < sac.replayed)
        scattered = (world.seen is not None) & (u > 1.0 - sac.scattered)
        start = jnp.where(scattered, elsewhere(world, start, which), start)
        return jnp.where(replayed, starts[row], start)

    def turn(carry: Any, key: Key) -> tuple[Any, None]:
        learner, rollouts = carry
        acting, learning = jax.random.split(key)
        rollouts, rows = _stepped(sac, learner, world, rollouts, fresh, acting)
        learner = eqx.tree_at(lambda l: l.replay, learner, learner.replay.add(rows))

        def update(learner: Learner, key: Key) -> tuple[Learner, None]:
            return updated(sac, learner, world, key), None

        keys = jax.random.split(learning, sac.updates)
        learner, _ = jax.lax.scan(update, learner, keys)
        return (learner, rollouts), None

    begin, ages, going = jax.random.split(key, 3)
    S = jax.vmap(fresh)(jax.random.split(begin, sac.num_envs))
    # Episodes begin and end at different times, or the replay would breathe.
    t = jax.random.randint(ages, (sac.num_envs,), 0, world.horizon)
    keys = jax.random.split(going, sac.steps)
    (learner, _), _ = jax.lax.scan(turn, (learner, Rollouts(S, t)), keys)
    # A world that could never be followed has taught nothing.
    taught = jnp.any(learner.replay.valid)
    return eqx.tree_at(lambda l: l.taught, learner, taught)


def elsewhere(world: World, start: State, key: Key) -> State:
    """``start`` with what a policy sees of it drawn from the box that is trusted.

    As often from a small box as from a large one, an angle anywhere in its turn: there
    is little room to be caught in near rest, in a corner of speeds there is much.
    """
    how_far, where = jax.random.split(key)
    observe = world.observe
    half = observe.scale * jax.random.uniform(how_far, (), observe.scale.dtype)
    if observe.angle is not None:
        half = half.at[observe.angle].set(jnp.pi)
    x = half * jax.random.uniform(where, half.shape, half.dtype, -1.0)
    return jnp.concatenate([x, start[half.size :]])


def _stepped(
    sac: SAC, learner: Learner, world: World, rollouts: Rollouts, fresh: Any, key: Key
) -> tuple[Rollouts, Any]:
    """One step of every world, and its rows; an episode that is over starts again."""

    def one(s: State, t: Array, key: Key) -> Any:
        acting, beginning = jax.random.split(key)
        u, _ = squashed(learner.actor, world.observe(s), acting)
        s2, r, usable = made(world, s, u)
        over = (t + 1 >= world.horizon) | ~usable
        then = jnp.where(over, fresh(beginning), s2)
        return then, jnp.where(over, 0, t + 1), (s, u, s2, r, usable)

    keys = jax.random.split(key, sac.num_envs)
    S, t, rows = jax.vmap(one)(rollouts.state, rollouts.steps, keys)
    return Rollouts(S, t), rows


def updated(sac: SAC, learner: Learner, world: World, key: Key) -> Learner:
    """One gradient step of critics, actor and temperature, in this order."""
    which, first, second = jax.random.split(key, 3)
    replay = learner.replay
    held = jnp.minimum(replay.count, len(replay.valid))
    rows = jax.random.randint(which, (sac.batch,), 0, held)
    observe = jax.vmap(world.observe)
    O, O2 = observe(replay.state[rows]), observe(replay.next_state[rows])
    U, r, valid = replay.action[rows], replay.reward[rows], replay.valid[rows]
    weight = valid.astype(r.dtype)
    share = weight / jnp.maximum(jnp.sum(weight), 1.0)
    alpha = jnp.exp(learner.log_temperature)

    def drawn(actor: MLP, O: Array, key: Key) -> tuple[Array, Array]:
        keys = jax.random.split(key, sac.batch)
        return jax.vmap(lambda o, k: squashed(actor, o, k))(O, keys)

    U2, log_pi2 = drawn(learner.actor, O2, first)
    after = jnp.min(_values(learner.targets, O2, U2), axis=1) - alpha * log_pi2
    y = sac.scale * r + sac.discount * after

    def critic_loss(critics: Critics) -> Scalar:
        each = (_values(critics, O, U) - y[:, None]) ** 2
        return jnp.sum(share[:, None] * each)

    def actor_loss(actor: MLP) -> tuple[Scalar, Scalar]:
        U, log_pi = drawn(actor, O, second)
        worth = jnp.min(_values(critics, O, U), axis=1)
        return jnp.sum(share * (alpha * log_pi - worth)), jnp.sum(share * log_pi)

    adam = sac.optimiser()

    def step(parameters: Any, state: optax.OptState, grads: Any) -> Any:
        with jax.numpy_dtype_promotion("standard"):  # optax relies on it
            updates, state = adam.update(grads, state)
        return optax.apply_updates(parameters, updates), state

    of_critics, of_actor, of_temperature = learner.optimisers
    critics, of_critics = step(
        learner.critics, of_critics, jax.grad(critic_loss)(learner.critics)
    )
    slope, log_pi = jax.grad(actor_loss, has_aux=True)(learner.actor)
    actor, of_actor = step(learner.actor, of_actor, slope)
    wanted = -float(U.shape[1])
    log_temperature, of_temperature = step(
        learner.log_temperature, of_temperature, -(log_pi + wanted)
    )
    targets = jax.tree.map(
        lambda old, new: old + sac.tau * (new - old), learner.targets, critics
    )
    return replace(
        learner,
        actor=actor,
        critics=critics,
        targets=targets,
        log_temperature=log_temperature,
        optimisers=(of_critics, of_actor, of_temperature),
        updates=learner.updates + 1,
    )


def _values(critics: Critics, O: Array, U: Array) -> Float[Array, "B two"]:
    return jax.vmap(lambda o, u: values(critics, o, u))(O, U)
