"""Tasks against their definitions: rewards by hand, noise by moments, scores."""

import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from sim2gp.errors import InputError
from sim2gp.planning import tasks
from sim2gp.planning.tasks import CartPoleReward, FurutaReward, Task
from sim2gp.systems import CartPole, Coulomb, Delay, Furuta

KEY = jax.random.key(0)
PRESETS = [tasks.furuta_swingup, tasks.cartpole_swingup]
ZERO, NONE = jnp.zeros(4), jnp.zeros(1)


def test_furuta_reward_by_hand() -> None:
    reward = FurutaReward()
    upright = jnp.asarray([0.0, math.pi, 0.0, 0.0])
    assert float(reward(ZERO, NONE, upright)) == pytest.approx(1.0)
    assert float(reward(ZERO, NONE, ZERO)) == pytest.approx(math.exp(-2.0))
    s2 = jnp.asarray([0.5, 2.0, -3.0, 4.0])
    cost = 1 + math.cos(2.0) + 0.1 * 0.25 + 5e-3 * 9 + 1e-3 * 16 + 3e-3 * 4
    got = reward(ZERO, jnp.asarray([2.0]), s2)
    assert float(got) == pytest.approx(math.exp(-cost), rel=1e-6)


def test_cartpole_reward_by_hand() -> None:
    reward = CartPoleReward()
    upright = jnp.asarray([0.0, math.pi, 0.0, 0.0])
    assert float(reward(ZERO, NONE, upright)) == pytest.approx(1.0)
    assert float(reward(ZERO, NONE, ZERO)) == 0.0
    s2 = jnp.asarray([-0.32, 2.0, 5.0, 4.0])
    expected = 0.5 * (1 - math.cos(2.0)) - 0.1 * 0.32**2 - 0.2 - 1.6e-3 - 4e-3
    assert float(reward(ZERO, jnp.asarray([6.0]), s2)) == pytest.approx(expected)


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_as_registered(preset: object) -> None:
    task = preset()
    assert (task.horizon, task.dt, task.seconds) == (250, 0.02, 5.0)
    furuta = preset is tasks.furuta_swingup
    system = Furuta() if furuta else CartPole()
    assert {k: pytest.approx(float(v)) for k, v in task.truth.items()} == (
        system.parameters.nominal()
    )
    plan = (task.planning_horizon, task.planning_iterations, task.noise_colour)
    assert plan == ((45, 4, 2.0) if furuta else (50, 3, 2.0))
    bound = [6.0, np.inf, 45.0, 75.0] if furuta else [1.05, np.inf, 4.5, 45.0]
    np.testing.assert_allclose(task.state_bound, bound, rtol=1e-6)
    assert float(task.actions.high[0]) == -float(task.actions.low[0])
    assert float(task.actions.high[0]) == (5.0 if furuta else 10.0)
    for leaf in jax.tree.leaves(task):
        assert leaf.dtype == jnp.float32


@pytest.mark.parametrize("preset", PRESETS)
def test_the_step_is_the_physics_plus_noise_on_the_increment(preset: object) -> None:
    task = preset()
    s, a = jnp.asarray([0.1, 2.0, -1.0, 3.0]), jnp.asarray([2.0])
    keys = jax.random.split(KEY, 20_000)
    s2 = jax.vmap(lambda key: task.step(s, a, key=key))(keys)
    noise = np.asarray(s2, float) - np.asarray(task.dynamics(s, a), float)
    n = len(keys)
    z = noise / np.asarray(task.noise)
    assert np.all(np.abs(z.mean(axis=0)) < 4.5 / np.sqrt(n))
    assert np.all(np.abs((z**2).mean(axis=0) - 1.0) < 4.5 * np.sqrt(2.0 / n))
    assert np.all(np.abs(np.corrcoef(z.T) - np.eye(4)) < 4.5 / np.sqrt(n))


def test_the_machine_gets_the_limited_action() -> None:
    task = tasks.furuta_swingup()
    same = [task.step(ZERO, jnp.asarray([u]), key=KEY) for u in (5.0, 7.0, 1e9)]
    np.testing.assert_array_equal(same[0], same[1])
    np.testing.assert_array_equal(same[0], same[2])
    assert np.isnan(task.limit(jnp.asarray([jnp.nan]))).all()  # never laundered


@pytest.mark.parametrize("preset", PRESETS)
def test_reset_is_near_rest(preset: object) -> None:
    task = preset()
    s = np.asarray(jax.vmap(task.reset)(jax.random.split(KEY, 4000)), float)
    sd = np.asarray(task.start_sd, float)
    np.testing.assert_allclose(s.std(axis=0), sd, rtol=0.06)
    assert np.all(np.abs(s.mean(axis=0)) <= 4.5 * sd / np.sqrt(4000))


def test_hanging_returns() -> None:
    furuta, cart = (tasks.hanging_return(preset()) for preset in PRESETS)
    assert furuta == pytest.approx(250 * math.exp(-2.0), rel=1e-5)
    assert cart == 0.0


def test_scores() -> None:
    assert tasks.score(30.0, 30.0, 200.0) == 0.0
    assert tasks.score(200.0, 30.0, 200.0) == 1.0
    returns = [30.0, 191.4, 191.6, 100.0]  # 0.95 stands at 191.5
    assert tasks.episodes_to_95(returns, 30.0, 200.0) == 3
    assert tasks.episodes_to_95([191.5], 30.0, 200.0) == 1
    assert tasks.episodes_to_95(returns[:2], 30.0, 200.0) is None
    assert tasks.episodes_to_95([], 30.0, 200.0) is None
    with pytest.raises(InputError, match=r"^E148 oracle .*more than the 30"):
        tasks.score(10.0, 30.0, 30.0)


def test_swung_up_means_the_whole_last_second() -> None:
    task = tasks.furuta_swingup()
    states = jnp.zeros((251, 4)).at[201:, 1].set(3 * math.pi)  # any turn of the pole
    assert task.reached(states)
    assert task.reached(states.at[:201, 1].set(1.0))
    for k in (201, 220, 250):
        assert not task.reached(states.at[k, 1].set(math.acos(-0.89)))
        assert task.reached(states.at[k, 1].set(math.acos(-0.91)))
    assert not task.reached(jnp.zeros((251, 4)))


@pytest.mark.parametrize("system", [Furuta(), CartPole()])
def test_truths_come_from_the_prior(system: object) -> None:
    drawn = [tasks.draw_truth(system, jax.random.fold_in(KEY, i)) for i in range(80)]
    table = system.parameters
    for p in table.free:
        values = np.asarray([float(getattr(truth, p.name)) for truth in drawn])
        assert getattr(drawn[0], p.name).dtype == jnp.float32
        slack = 1e-6 * p.high
        assert values.min() >= p.low - slack
        assert values.max() <= p.high + slack
        z = [(p.unconstrain(v) - p.mean) / p.sd for v in values]
        assert scipy.stats.kstest(z, "norm").pvalue > 1e-4


@pytest.mark.parametrize("preset", PRESETS)
def test_a_new_truth_is_data(preset: object) -> None:
    system = Furuta() if preset is tasks.furuta_swingup else CartPole()
    one, two = (
        preset(tasks.draw_truth(system, jax.random.fold_in(KEY, i))) for i in (1, 2)
    )
    assert jax.tree.structure(one) == jax.tree.structure(two)
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), t) for t in (one, two)]
    assert eqx.tree_equal(*shapes)
    a = jnp.asarray([3.0])
    assert not np.allclose(one.dynamics(ZERO, a), two.dynamics(ZERO, a))


def test_effects_change_the_truth_and_nothing_else() -> None:
    bare = tasks.furuta_swingup()
    rough = tasks.furuta_swingup(effects=[Coulomb("theta", 4e-3)])
    assert float(rough.truth["theta.coulomb"]) == pytest.approx(4e-3)
    assert set(rough.truth) - set(bare.truth) == {"theta.coulomb"}
    s = jnp.asarray([0.0, 0.0, 2.0, 0.0])
    assert float(rough.dynamics(s, NONE)[2]) < float(bare.dynamics(s, NONE)[2])
    np.testing.assert_array_equal(rough.noise, bare.noise)


def test_an_input_delay_carries_past_actions() -> None:
    task = tasks.furuta_swingup(effects=[Delay("voltage", 0.02)])
    assert task.history == 1
    assert task.size == 4
    s = task.reset(KEY)
    assert s.shape == (5,)
    assert s[4] == 0.0
    later = task.dynamics(s, jnp.asarray([4.0]))
    assert later[4] == 4.0
    # One whole period late: nothing but the past action acts now.
    idle = tasks.furuta_swingup().dynamics(s[:4], NONE)
    np.testing.assert_allclose(later[:4], idle, atol=1e-6)


def test_a_truth_of_another_machine_is_refused() -> None:
    with pytest.raises(InputError, match="E145 truth of Furuta"):
        tasks.furuta_swingup(CartPole().nominal())
    values = Furuta().parameters.nominal()
    assert isinstance(tasks.furuta_swingup(values), Task)
    values.pop("arm_mass")
    with pytest.raises(InputError, match="E145"):
        tasks.furuta_swingup(values)


@pytest.mark.parametrize("system", [Furuta(), CartPole()])
@pytest.mark.parametrize(("word", "away"), [("2sd", 2.0), ("3sd", 3.0)])
def test_displaced_truths_are_as_far_as_they_say(system, word, away):
    table = system.parameters
    record = tasks.draw_truth(system, KEY, word)
    with jax.enable_x64(True):
        theta = jnp.asarray([float(getattr(record, n)) for n in table.names])
        z = (table.unconstrain(theta) - table.prior().mean) / table.prior().sd()
    np.testing.assert_allclose(np.abs(z), away, rtol=1e-4)
    assert len(set(np.sign(z))) == 2  # not one corner for all constants


@pytest.mark.parametrize("system", [Furuta(), CartPole()])
def test_truths_outside_lie_beyond_their_bounds(system):
    record = tasks.draw_truth(system, KEY, "outside")
    for p in system.parameters.free:
        value = float(getattr(record, p.name))
        beyond = max(value / p.high, p.low / value)
        assert beyond == pytest.approx(1.2, rel=1e-6), p.name
