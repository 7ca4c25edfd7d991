"""SAC in tiny worlds whose values are known: each part that breaks fails its own."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jaxtyping import Array
from scipy.linalg import solve_discrete_are

from double_integrator import A, B, Q, R
from double_integrator import world as double_integrator
from sim2gp.data.transitions import Transitions
from sim2gp.planning import SAC, MarkovObjective, Observation, World, sac
from sim2gp.planning.networks import LOG_SD, MLP, squashed, values
from sim2gp.types import Box

KEY = jax.random.key(0)
SMALL = SAC(
    hidden=(32,), num_envs=16, steps=60, updates=20, batch=64, rate=3e-3, tau=0.02
)
NOTHING = Transitions.empty(1, 1, 1)


class Scaled(eqx.Module):
    """``s' = c s``: a new ``c`` is a new draw."""

    c: Array

    def __call__(self, s: Array, a: Array) -> Array:
        del a
        return self.c * s


STAY, TURN = Scaled(jnp.asarray(1.0)), Scaled(jnp.asarray(-1.0))


class Polynomial(eqx.Module):
    """A reward ``one + s s + a a + sa s a + ss s^2 + aa a^2``."""

    weights: Array

    def __call__(self, s: Array, a: Array, s2: Array) -> Array:
        del s2
        s, a = s[0], a[0]
        return self.weights @ jnp.stack([jnp.ones(()), s, a, s * a, s**2, a**2])


def reward(one=0.0, s=0.0, a=0.0, sa=0.0, ss=0.0, aa=0.0) -> Polynomial:
    return Polynomial(jnp.asarray([one, s, a, sa, ss, aa]))


def anywhere(key: Array) -> Array:
    return jax.random.uniform(key, (1,), minval=-1.0)


def world(dynamics, reward, *, horizon=1) -> World:
    """A state and an action of one number each; episodes of one step."""
    box = Box(-jnp.ones(1), jnp.ones(1))
    return World(dynamics, MarkovObjective(reward), anywhere, box, horizon)


def discounted(discount: float, scale: float = 1.0) -> SAC:
    """The small planner; its numbers are data, so the probe worlds are one program."""
    discount, scale = jnp.asarray(discount), jnp.asarray(scale)
    return dataclasses.replace(SMALL, discount=discount, scale=scale)


def trained(planner: SAC, here: World, data=NOTHING, times=1):
    learner = planner.init(here, key=KEY)
    for i in range(times):
        key = jax.random.fold_in(KEY, i)
        learner = planner.prepare(learner, here, data, key=key)
    return learner


def worth(learner, s, u):
    found = values(learner.critics, jnp.asarray([s]), jnp.asarray([u]))
    return np.asarray(found)


# ------------------------------------------------------------------ probe worlds
@pytest.mark.nightly
def test_critics_learn_a_reward_of_state_and_action() -> None:
    """Without a future a value is the reward itself."""
    here = world(STAY, reward(s=1.0, sa=0.5))
    learner = trained(discounted(0.0), here, times=3)
    for s in (-0.8, 0.0, 0.6):
        for u in (-0.5, 0.0, 0.5):
            expected = s + 0.5 * s * u
            assert worth(learner, s, u) == pytest.approx(expected, abs=0.08)


def test_values_are_discounted_one_step_at_a_time() -> None:
    """A side that turns: ``r = (1 + s)/2, V = 1/(2 (1 - g)) + s/(2 (1 + g))``.

    No action matters: the temperature has nothing to buy, and entropy no price.
    """
    learner = trained(discounted(0.5), world(TURN, reward(one=0.5, s=0.5)), times=3)
    assert float(jnp.exp(learner.log_temperature)) < 0.02
    for s in (-0.8, 0.0, 0.8):
        assert worth(learner, s, 0.0) == pytest.approx(1.0 + s / 3.0, abs=0.07)


def test_time_that_is_up_is_no_end() -> None:
    """Episodes of one step, a reward of 1: the value is that of going on for ever."""
    learner = trained(discounted(0.8), world(STAY, reward(one=1.0)))
    assert worth(learner, 0.3, 0.2) == pytest.approx(5.0, rel=0.05)


def test_the_actor_finds_what_the_reward_asks_of_each_state() -> None:
    """``-(a - s/2)^2``."""
    planner = discounted(0.0, scale=10.0)
    here = world(STAY, reward(aa=-1.0, sa=1.0, ss=-0.25))
    policy = trained(planner, here).policy
    for s in (-0.8, 0.0, 0.8):
        assert float(policy(jnp.asarray([s]))[0]) == pytest.approx(0.5 * s, abs=0.1)


def test_the_temperature_keeps_the_entropy_that_is_wanted() -> None:
    """Of an action that is punished for any size, minus one nat for each input."""
    learner = trained(discounted(0.0), world(STAY, reward(aa=-4.0)), times=3)
    keys = jax.random.split(KEY, 4000)
    draw = jax.vmap(lambda k: squashed(learner.actor, jnp.asarray([0.2]), k)[1])
    assert -float(jnp.mean(draw(keys))) == pytest.approx(-1.0, abs=0.15)


@pytest.mark.nightly
def test_a_policy_plans_ahead() -> None:
    """A double integrator: the cost is that of Riccati's, within a tenth."""
    reset = _anywhere_in_the_plane
    here = double_integrator(reset=reset)
    planner = dataclasses.replace(SMALL, hidden=(64, 64), steps=200, discount=0.98)
    data = Transitions.empty(1, 2, 1)
    learner = trained(planner, here, data, times=3)
    policy = learner.policy
    P = solve_discrete_are(A, B, Q, R)
    K = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    ratios = []
    for s in ([0.8, 0.0], [-0.5, 0.5], [0.3, -0.8]):
        best = _cost(lambda x: -K @ x, s)
        ratios.append(_cost(lambda x: np.asarray(policy(jnp.asarray(x, "f4"))), s))
        ratios[-1] /= best
    assert max(ratios) < 1.1


def _anywhere_in_the_plane(key: Array) -> Array:
    return jax.random.uniform(key, (2,), minval=-1.0)


def _cost(policy, s) -> float:
    s, total = np.asarray(s), 0.0
    for _ in range(60):
        a = policy(s)
        s = A @ s + B @ a
        total += float(s @ Q @ s + a @ R @ a)
    return total


# ------------------------------------------------------------------ parts
def test_a_squashed_density_is_that_of_its_draws() -> None:
    """Against the density of tanh of a normal, and where tanh rounds to one."""
    actor = MLP.random(KEY, (1, 8, 2))
    keys = jax.random.split(KEY, 200)
    u, log_pi = jax.vmap(lambda k: squashed(actor, jnp.asarray([0.7]), k))(keys)
    mean, raw = np.asarray(actor(jnp.asarray([0.7])), float)
    sd = np.exp(LOG_SD[0] + 0.5 * (LOG_SD[1] - LOG_SD[0]) * (np.tanh(raw) + 1.0))
    u = np.asarray(u, float)[:, 0]
    inside = np.abs(u) < 0.99
    x = np.arctanh(u[inside])
    expected = scipy.stats.norm(mean, sd).logpdf(x) - np.log1p(-(u[inside] ** 2))
    np.testing.assert_allclose(np.asarray(log_pi)[inside], expected, atol=2e-3)
    far = eqx.tree_at(lambda a: a.biases[-1], actor, jnp.asarray([30.0, 0.0]))
    u, log_pi = squashed(far, jnp.asarray([0.7]), KEY)
    assert float(u[0]) == 1.0
    assert np.isfinite(float(log_pi))


def test_what_was_tried_is_tried_again_in_a_new_world() -> None:
    """States and actions stay; what follows, and what it earns, is the new world's."""
    here = world(STAY, reward(s=1.0, a=1.0))
    planner = discounted(0.0)
    old = trained(planner, here).replay
    new = old.again(world(TURN, reward(sa=1.0)))
    np.testing.assert_array_equal(new.state, old.state)
    rows = int(old.count)
    assert int(new.count) == int(new.valid.sum()) == rows == 16 * 60
    S, A = np.asarray(old.state)[:rows], np.asarray(old.action)[:rows]
    np.testing.assert_array_equal(new.next_state[:rows], -S)
    np.testing.assert_allclose(new.reward[:rows], (S * A)[:, 0], rtol=1e-6)


def test_the_oldest_rows_are_overwritten() -> None:
    replay = sac.Replay.empty(6, 1, 1)
    for i in range(1, 5):
        x = jnp.full((2, 1), float(i))
        replay = replay.add((x, x, x, x[:, 0], x[:, 0] > 0.0))
    np.testing.assert_array_equal(replay.reward, [4.0, 4.0, 2.0, 2.0, 3.0, 3.0])
    assert int(replay.count) == 8


@pytest.mark.nightly
def test_nothing_is_learned_of_steps_that_the_world_cannot_follow() -> None:
    """Beyond half of the line the world is lost: rows there count for nothing."""

    def lost(s: Array, a: Array) -> Array:
        return jnp.where(jnp.abs(s) > 0.5, jnp.nan, s)

    here = world(lost, reward(one=1.0))
    learner = trained(discounted(0.0), here, times=2)
    replay = learner.replay
    held = int(replay.count)
    outside = np.abs(np.asarray(replay.state)[:held, 0]) > 0.5
    np.testing.assert_array_equal(np.asarray(replay.valid)[:held], ~outside)
    assert outside.mean() == pytest.approx(0.5, abs=0.05)
    assert np.isfinite(np.asarray(replay.next_state)).all()
    for s in (0.2, 0.9):  # what is outside is guessed from inside, not learned
        assert worth(learner, s, 0.1) == pytest.approx(1.0, abs=0.2)
    assert not bool(SMALL.failed(learner))
    never = world(Scaled(jnp.asarray(jnp.nan)), reward())
    assert bool(SMALL.failed(trained(discounted(0.0), never)))


@pytest.mark.nightly
def test_episodes_begin_where_the_machine_has_been() -> None:
    """Some of them, as soon as there is anywhere."""
    seen = np.full((20, 1), 5.0)
    data = Transitions.of(seen, seen, seen)
    for some, share in ((data, 0.3), (Transitions.empty(20, 1, 1), 0.0)):
        replay = trained(discounted(0.0), world(STAY, reward()), some).replay
        held = np.asarray(replay.state)[: int(replay.count), 0]
        assert np.mean(held == 5.0) == pytest.approx(share, abs=0.04)


@pytest.mark.nightly
def test_episodes_begin_where_no_machine_has_been() -> None:
    """As far as a policy sees, a turn for an angle; what it does not see stays.

    Of a half-width uniform in (0, h), a draw is beyond x with probability
    ``1 - (x / h) (1 + log(h / x))``.
    """
    here = world(STAY, reward())
    here = dataclasses.replace(here, seen=Observation(jnp.asarray([10.0])))
    beyond = 1.0 - 0.1 * (1.0 + np.log(10.0))
    for some, share in ((0.3, 0.3), (0.0, 0.0)):
        planner = dataclasses.replace(discounted(0.0), scattered=jnp.asarray(some))
        held = np.asarray(trained(planner, here).replay.state)[: 16 * 60, 0]
        assert np.mean(np.abs(held) > 1.0) == pytest.approx(beyond * share, abs=0.04)
        assert np.abs(held).max() <= 10.0
    seen = Observation(jnp.asarray([2.0, jnp.inf]), angle=1)
    here = double_integrator(seen=seen)
    start = jnp.asarray([0.1, 0.2, 0.3])
    keys = jax.random.split(KEY, 4000)
    X = np.asarray(jax.vmap(lambda k: sac.elsewhere(here, start, k))(keys))
    x = np.abs(X[:, 0]) / 2.0
    found = scipy.stats.kstest(x, lambda x: x * (1.0 - np.log(x)))
    assert found.pvalue > 0.01
    assert np.mean(X[:, 0] > 0.0) == pytest.approx(0.5, abs=0.03)
    found = scipy.stats.kstest(X[:, 1], "uniform", (-np.pi, 2.0 * np.pi))
    assert found.pvalue > 0.01
    np.testing.assert_array_equal(X[:, 2], np.float32(0.3))


@pytest.mark.nightly
def test_a_new_draw_is_new_data() -> None:
    """One program prepares for every world of a run."""
    count = 0

    def counted(s: Array, a: Array, s2: Array) -> Array:
        nonlocal count
        count += 1
        return s2[0]

    planner = dataclasses.replace(SMALL, steps=5, updates=2)
    here = world(STAY, counted, horizon=20)
    learner = planner.init(here, key=KEY)
    for c in (1.0, 0.5, -1.0):
        now = eqx.tree_at(lambda w: w.dynamics.c, here, jnp.asarray(c))
        learner = planner.prepare(learner, now, NOTHING, key=KEY)
        if c == 1.0:
            first = count
    assert count == first
    assert int(learner.updates) == 3 * 5 * 2


@pytest.mark.nightly
def test_seeds_side_by_side_are_seeds_one_by_one() -> None:
    """A preparation is pure: several learners train as one batch, in their worlds."""
    planner = dataclasses.replace(discounted(0.5), steps=4, updates=2)
    draws = Scaled(jnp.asarray([1.0, -1.0]))

    def train(dynamics: Scaled, key: Array) -> sac.Learner:
        here = world(dynamics, reward(sa=1.0), horizon=3)
        learner = planner.init(here, key=key)
        return planner.prepare(learner, here, NOTHING, key=key)

    def of(learner: sac.Learner) -> list[Array]:
        return jax.tree.leaves(
            eqx.filter((learner.actor, learner.replay), eqx.is_array)
        )

    keys = jax.random.split(KEY, 2)
    both = of(eqx.filter_jit(eqx.filter_vmap(train))(draws, keys))
    for i in range(2):
        alone = of(train(Scaled(draws.c[i]), keys[i]))
        for batch, one in zip(both, alone, strict=True):
            np.testing.assert_allclose(batch[i], one, atol=1e-5)
