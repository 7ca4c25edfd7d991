"""Sine and cosine of single precision: against NumPy in double, and in rollouts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.models import MissingForces, Sim2GP
from sim2gp.planning.tasks import CartPoleReward, FurutaReward
from sim2gp.systems import CartPole, Furuta, UniformRodArm
from sim2gp.systems.trigonometry import cosine, sine

BOTH = [(sine, np.sin, np.cos), (cosine, np.cos, lambda x: -np.sin(x))]
FAR = 1e4  # rad


def values() -> np.ndarray:
    """Of all sizes, and next to where the count of half turns changes."""
    rng = np.random.default_rng(0)
    near = rng.uniform(-4.0, 4.0, 40_000)
    quarters = 0.5 * np.pi * np.arange(-6000, 6000) + rng.normal(0.0, 1e-4, 12_000)
    found = [near, rng.uniform(-FAR, FAR, 40_000), quarters, [0.0, 1e-30, -1e-6]]
    return np.concatenate(found).astype(np.float32)


@pytest.mark.parametrize(("ours", "value", "slope"), BOTH)
def test_values_and_slopes_are_those_of_double_precision(ours, value, slope):
    x = values()
    there = x.astype(float)
    found, pushed = jax.jvp(ours, (jnp.asarray(x),), (jnp.ones(x.size, jnp.float32),))
    assert found.dtype == pushed.dtype == jnp.float32
    np.testing.assert_allclose(found, value(there), rtol=0.0, atol=2e-7)
    np.testing.assert_allclose(pushed, slope(there), rtol=0.0, atol=2e-7)
    second = jax.vmap(jax.grad(jax.grad(ours)))(jnp.asarray(x[:100]))
    np.testing.assert_allclose(second, -value(there[:100]), rtol=0.0, atol=2e-7)


def test_what_is_small_is_exact_in_its_own_size():
    x = np.float32([1e-30, -1e-6, 1e-3])
    np.testing.assert_allclose(sine(jnp.asarray(x)), np.sin(x.astype(float)), rtol=2e-7)


@pytest.mark.parametrize("x", [np.inf, -np.inf, np.nan])
def test_no_number_has_none(x):
    assert np.isnan(float(sine(jnp.asarray(x, jnp.float32))))
    assert np.isnan(float(cosine(jnp.asarray(x, jnp.float32))))


@pytest.mark.usefixtures("float64")
@pytest.mark.parametrize(("ours", "value", "_"), BOTH)
def test_double_precision_is_the_librarys(ours, value, _):
    x = values().astype(float)
    assert isinstance(ours(x), np.ndarray)
    np.testing.assert_array_equal(ours(x), value(x))
    theirs = {np.sin: jnp.sin, np.cos: jnp.cos}[value]
    np.testing.assert_array_equal(ours(jnp.asarray(x)), theirs(jnp.asarray(x)))


@pytest.mark.parametrize(
    ("plant", "reward"),
    [
        (Furuta(), FurutaReward()),
        (CartPole(), CartPoleReward()),
        (UniformRodArm(), None),
    ],
)
def test_no_sine_is_taken_alone_in_a_rollout(plant, reward):
    """With all missing forces, and of a draw: each would be most of a step's time."""
    model = MissingForces(Sim2GP(plant))
    prior = model.sim.prior
    belief = model.sim.init(jax.random.key(0))
    draw = belief.sample(jax.random.key(1))
    n, m = len(plant.states), len(plant.actions)
    s, a = jnp.zeros(n, jnp.float32), jnp.zeros(m, jnp.float32)

    def step(s, a):
        then = draw(s, a)
        return then if reward is None else (then, reward(s, a, then))

    text = jax.jit(step).lower(s, a).as_text()
    assert prior.mean.size > len(plant.parameters)
    assert "divide" in text
    assert "sine" not in text
