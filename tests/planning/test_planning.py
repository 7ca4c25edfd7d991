"""Planners against closed forms: Riccati, exact spectra, effective sample sizes."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.linalg import solve_discrete_are

from double_integrator import (
    KEY,
    S0,
    A,
    B,
    Linear,
    Q,
    R,
    act,
    box,
    world,
)
from sim2gp.planning import (
    ICEM,
    MPC,
    MPPI,
    AbstractObjective,
    MarkovObjective,
    Resumed,
    World,
)
from sim2gp.planning.coloured_noise import colour_factor, coloured_noise
from sim2gp.planning.mpc import Underway, from_unit, promising
from sim2gp.planning.mppi import softmax_of_size
from sim2gp.planning.world import DIVERGED, masked, rollout


# ---------------------------------------------------------------- coloured noise
@pytest.mark.parametrize("horizon", [1, 2, 25, 30, 50])
@pytest.mark.parametrize("colour", [0.0, 1.0, 2.0, 3.5])
def test_noise_is_stationary_with_unit_variance_and_exact_slope(
    horizon: int, colour: float
) -> None:
    C = colour_factor(horizon, colour)
    covariance = C @ C.T
    np.testing.assert_allclose(np.diag(covariance), 1.0, atol=1e-12)
    for t in range(horizon):  # circulant: the same at every step
        np.testing.assert_allclose(
            np.roll(covariance[t], -t), covariance[0], atol=1e-12
        )
    power = np.fft.rfft(covariance[0]).real
    f = np.maximum(np.arange(len(power)), 1) / horizon
    np.testing.assert_allclose(power / power[-1], (f / f[-1]) ** -colour, rtol=1e-9)


@pytest.mark.parametrize("colour", [0.0, 2.0])
def test_sampled_noise_has_that_spectrum(colour: float) -> None:
    eps = coloured_noise(KEY, 4000, jnp.zeros((32, 2), jnp.float32), colour)
    assert eps.shape == (4000, 32, 2)
    assert eps.dtype == jnp.float32
    x = np.asarray(eps, float)
    # 8000 sequences; the variance of a mean of squares is at most 2 / 8000.
    assert np.all(np.abs(np.mean(x**2, axis=(0, 2)) - 1.0) < 5 * np.sqrt(2 / 8000))
    assert abs(np.mean(x[..., 0] * x[..., 1])) < 5 / np.sqrt(4000)
    power = np.mean(np.abs(np.fft.rfft(x, axis=1)) ** 2, axis=(0, 2))[1:-1]
    slope = np.polyfit(np.log(np.arange(1, 16)), np.log(power), 1)[0]
    assert abs(slope + colour) < 0.03


# ---------------------------------------------------------------- LQR
def riccati_cost(s0: np.ndarray) -> float:
    # The reward is on s', so the first state costs nothing.
    P = solve_discrete_are(A, B, Q, R)
    return float(s0 @ P @ s0 - s0 @ Q @ s0)


@eqx.filter_jit
def closed_loop(planner: MPC, w: World, s0: Array, key: Array) -> Array:
    def step(carry: tuple[Array, Underway], key: Array) -> tuple[object, Array]:
        s, state = carry
        a, state = planner.act(state, w, s, key=key)
        s2 = w.dynamics(s, a)
        return (s2, state), -w.objective.reward(s, a, s2)

    start = (s0, planner.init(w, key=key))
    keys = jax.random.split(key, w.horizon)
    return jnp.sum(jax.lax.scan(step, start, keys)[1])


@pytest.mark.parametrize(
    "update",
    [
        ICEM(samples=256, iterations=5),
        pytest.param(
            ICEM(samples=256, iterations=5, elites=10, decay=1.25),
            marks=pytest.mark.nightly,
        ),
        MPPI(samples=512, iterations=4, effective=0.05),
    ],
    ids=["icem", "icem with decay", "mppi"],
)
def test_cost_is_within_a_few_percent_of_riccati(update: object) -> None:
    optimal = riccati_cost(np.asarray(S0, float))
    cost = float(closed_loop(MPC(update), world(), S0, KEY))
    assert 0.999 * optimal < cost < 1.05 * optimal


@pytest.mark.nightly
def test_more_samples_are_not_much_worse() -> None:
    few, many = (
        float(closed_loop(MPC(ICEM(samples=n)), world(), S0, KEY)) for n in (32, 256)
    )
    assert many < 1.02 * few


# ---------------------------------------------------------------- bad rollouts
class Trap(eqx.Module):
    """Pushing right pays more and more, but every step there is ``poison``."""

    poison: Array
    good: Array

    def __call__(self, s: Array, a: Array) -> Array:
        return jnp.where((a[0] > 0.0) | (self.good == 0.0), self.poison, s + 0.1 * a[0])


class Greedy(eqx.Module):
    """Pays for the action; ``fault`` is what it returns where it should not be."""

    fault: Array

    def __call__(self, s: Array, a: Array, s2: Array) -> Array:
        return jnp.where(a[0] > 0.0, a[0] + self.fault, a[0])


def trap(poison: float, good: float = 1.0, fault: float = 0.0) -> World:
    dynamics = Trap(jnp.asarray(poison), jnp.asarray(good))
    return world(dynamics, objective=MarkovObjective(Greedy(jnp.asarray(fault))))


PLANNERS = [MPC(ICEM(samples=64)), MPC(MPPI(samples=64))]


def flat_plan(planner: MPC, w: World, value: float) -> Underway:
    plan = planner.init(w, key=KEY)
    return jax.tree.map(lambda x: x + value if x.ndim > 1 else x, plan)


@pytest.mark.parametrize("planner", PLANNERS, ids=["icem", "mppi"])
@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf, 1.1 * DIVERGED])
def test_a_rollout_that_diverges_never_wins(planner: MPC, poison: float) -> None:
    w = trap(poison)
    # Start where a good share of sequences never pushes right.
    a, plan = act(planner, flat_plan(planner, w, -0.9), w, S0, key=KEY)
    assert float(a[0]) <= 0.0
    assert not planner.failed(plan)
    for leaf in jax.tree.leaves(plan):
        assert np.isfinite(np.asarray(leaf)).all()
    assert np.asarray(plan.plan.mean).max() <= 0.0


@pytest.mark.parametrize("planner", PLANNERS, ids=["icem", "mppi"])
@pytest.mark.parametrize("fault", [np.nan, np.inf])
def test_a_reward_that_is_not_finite_never_wins(planner: MPC, fault: float) -> None:
    w = trap(0.0, fault=fault)
    a, plan = act(planner, flat_plan(planner, w, -0.9), w, S0, key=KEY)
    assert float(a[0]) <= 0.0
    assert np.asarray(plan.plan.mean).max() <= 0.0


@pytest.mark.parametrize("planner", PLANNERS, ids=["icem", "mppi"])
def test_all_invalid_is_flagged_and_the_warm_start_survives(planner: MPC) -> None:
    good, dead = trap(0.0), trap(np.nan, good=0.0)
    start = planner.init(good, key=KEY)
    _, before = act(planner, start, good, S0, key=KEY)
    a, after = act(planner, before, dead, S0, key=KEY)
    assert planner.failed(after)
    assert not planner.failed(before)
    np.testing.assert_array_equal(after.plan.mean, before.plan.shift().mean)
    np.testing.assert_allclose(a, 3.0 * before.plan.mean[0], rtol=1e-6)
    # A state that is not finite is as bad as a draw that is not.
    _, lost = act(planner, before, good, S0 * jnp.nan, key=KEY)
    assert planner.failed(lost)
    np.testing.assert_array_equal(lost.plan.mean, before.plan.shift().mean)
    # One good world later everything is as if nothing had happened.
    _, again = act(planner, after, good, S0, key=KEY)
    assert not planner.failed(again)
    shifted = eqx.tree_at(lambda u: u.plan, before, before.plan.shift())
    direct = act(planner, shifted, good, S0, key=KEY)[1]
    if planner.update.__class__ is MPPI:  # no elites to lose
        np.testing.assert_array_equal(again.plan.mean, direct.plan.mean)
    assert np.isfinite(np.asarray(again.plan.mean)).all()


def test_masked_returns_are_finite_and_last() -> None:
    returns = jnp.asarray([1.0, jnp.nan, 3.0, jnp.inf, -jnp.inf])
    valid = jnp.isfinite(returns)
    assert np.isfinite(np.asarray(masked(returns, valid))).all()
    _, best = jax.lax.top_k(masked(returns, valid), 2)
    assert best.tolist() == [2, 0]


def test_the_guard_judges_before_it_clips() -> None:
    w = world(Trap(jnp.asarray(jnp.inf), jnp.asarray(1.0)), state_bound=jnp.ones(2))
    assert not w.step(S0, jnp.asarray([1.0]))[1]
    s, usable = w.step(10.0 * S0, jnp.asarray([-1.0]))
    assert usable
    np.testing.assert_allclose(s, [1.0, -0.1], rtol=1e-6)


# ---------------------------------------------------------------- MPPI
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("share", [0.05, 0.25, 0.9])
def test_the_effective_sample_size_is_the_target(scale: float, share: float) -> None:
    returns = scale * jax.random.normal(KEY, (128,)) + 7.0 * scale
    valid = jnp.arange(128) % 4 != 0
    weights = np.asarray(softmax_of_size(returns, valid, share), float)
    assert abs(weights.sum() - 1.0) < 1e-5
    assert 1.0 / np.sum(weights**2) == pytest.approx(share * 96, rel=1e-3)
    assert np.all(weights[::4] == 0.0)
    order = np.argsort(np.asarray(returns)[np.asarray(valid)])
    assert np.all(np.diff(weights[np.asarray(valid)][order]) >= 0.0)


def test_weights_of_ties_one_and_none() -> None:
    ones = jnp.ones(8, bool)
    np.testing.assert_allclose(softmax_of_size(jnp.ones(8), ones, 0.25), 0.125)
    nan = jnp.full(8, jnp.nan)
    np.testing.assert_array_equal(softmax_of_size(nan, ~ones, 0.25), 0.0)
    one = jnp.arange(8) == 3
    np.testing.assert_allclose(
        softmax_of_size(jnp.where(one, -2.0, jnp.nan), one, 0.25), one.astype(float)
    )


# ---------------------------------------------------------------- worlds
class Steps(AbstractObjective):
    """Pays the number of steps before this one: only a carry can know it."""

    def init(self) -> Array:
        return jnp.zeros(())

    def step(self, carry: Array, s: Array, a: Array, s2: Array) -> tuple[Array, Array]:
        return carry + 1.0, carry

    def along(self, carry: Array, S: Array, A: Array, S2: Array) -> Array:
        return carry + jnp.arange(len(A), dtype=carry.dtype)


def test_an_objective_may_carry_state() -> None:
    rewards, valid = rollout(world(objective=Steps()), S0, jnp.zeros((9, 1)))
    assert valid
    np.testing.assert_array_equal(rewards, np.arange(9.0))
    later = Resumed(Steps(), jnp.asarray(4.0))
    rewards, _ = rollout(world(objective=later), S0, jnp.zeros((9, 1)))
    np.testing.assert_array_equal(rewards, 4.0 + np.arange(9.0))


def test_a_rollout_has_the_rewards_of_the_simulated_states() -> None:
    U = jax.random.normal(KEY, (7, 1))
    w = world()
    s, expected = np.asarray(S0, float), []
    for a in np.asarray(U, float):
        s = A @ s + B @ a
        expected.append(-(s @ Q @ s + a @ R @ a))
    rewards, valid = rollout(w, S0, U)
    assert valid
    np.testing.assert_allclose(rewards, expected, rtol=1e-5)


def test_the_length_that_promises_most_per_step_is_ranked() -> None:
    """By hand: a valid sequence's best mean decides, all are ranked over its steps."""
    rewards = jnp.asarray([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 4.0, 0.0], [9.0] * 4])
    valid = jnp.asarray([True, True, False])
    short = promising(rewards, valid, [2, 4])
    assert short[:2].tolist() == [2.0, 0.0]  # 2/2 against 4/4: the shorter, on a tie
    long = promising(rewards.at[1, 3].set(0.1), valid, [2, 4])
    np.testing.assert_allclose(long[:2], [2.0, 4.1])
    middle = promising(rewards, valid, [2, 3, 4])
    assert middle[:2].tolist() == [2.0, 4.0]
    # One length is the plain return.
    np.testing.assert_array_equal(promising(rewards, valid, [4]), rewards.sum(axis=1))


@pytest.mark.parametrize("planner", PLANNERS, ids=["icem", "mppi"])
def test_one_length_is_a_plain_planner(planner: MPC) -> None:
    """Three equal lengths rank as one does: the same actions."""
    one, same = (
        dataclasses.replace(planner, lengths=x) for x in ((1.0,), (1.0, 1.0, 1.0))
    )
    w = world()
    first, second = (act(p, p.init(w, key=KEY), w, S0, key=KEY)[0] for p in (one, same))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("planner", PLANNERS, ids=["icem", "mppi"])
def test_actions_stay_in_a_lopsided_box(planner: MPC) -> None:
    w = world(actions=box(-0.1, 0.7))
    for value in (-5.0, 5.0):
        plan = flat_plan(planner, w, value / 5.0)
        s = jnp.asarray([value, value])
        for i in range(3):
            a, plan = act(planner, plan, w, s, key=jax.random.fold_in(KEY, i))
            assert a.dtype == jnp.float32
            assert w.actions.low[0] <= a[0] <= w.actions.high[0]
    np.testing.assert_array_equal(
        from_unit(jnp.asarray([[-1.0], [1.0]]), w.actions)[:, 0],
        jnp.concatenate([w.actions.low, w.actions.high]),
    )


def test_the_world_knows_the_planning_defaults() -> None:
    w = world(planning_horizon=11)
    assert MPC().init(w, key=KEY).plan.mean.shape == (11, 1)
    assert MPC(horizon=4).init(w, key=KEY).plan.mean.shape == (4, 1)
    stale = flat_plan(MPC(), w, 0.5)
    fresh = MPC().prepare(stale, w, None, key=KEY)
    np.testing.assert_array_equal(fresh.plan.mean, 0.0)  # another world's is forgotten


def test_a_plan_may_be_followed_for_some_steps() -> None:
    """The actions of one plan, then those of the next, made where they led."""
    w, planner = world(), MPC(ICEM(samples=32), every=3)
    state, s, actions = planner.init(w, key=KEY), S0, []
    for i in range(4):
        a, state = act(planner, state, w, s, key=jax.random.fold_in(KEY, i))
        actions.append(np.asarray(a))
        s = w.dynamics(s, a)
        if i == 0:
            first = np.asarray(from_unit(state.sequence, w.actions))
    np.testing.assert_allclose(np.concatenate(actions[1:3]), first[:2, 0], rtol=1e-6)
    assert abs(float(actions[3][0]) - first[2, 0]) > 1e-4


def test_a_new_draw_is_data() -> None:
    traces = 0

    @eqx.filter_jit
    def plan(w: World, key: Array) -> Array:
        nonlocal traces
        traces += 1
        planner = MPC(ICEM(samples=32))
        return planner.act(planner.init(w, key=key), w, S0, key=key)[0]

    for i in range(4):
        drawn = Linear(jnp.asarray(A * (1 + i), jnp.float32), jnp.asarray(B, "float32"))
        plan(world(drawn), jax.random.key(i))
    assert traces == 1
