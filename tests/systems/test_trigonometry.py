"""Sine and cosine: against NumPy in higher precision, and where they are used."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.models import MissingForces, Sim2GP
from sim2gp.planning.tasks import CartPoleReward, FurutaReward
from sim2gp.systems import CartPole, Furuta, UniformRodArm
from sim2gp.systems.trigonometry import cosine, sine

pytestmark = pytest.mark.usefixtures("float64")
BOTH = [(sine, np.sin, np.cos), (cosine, np.cos, lambda x: -np.sin(x))]
KINDS = [np.float32, np.float64]
FAR = 1e4  # rad


def values(kind: type) -> np.ndarray:
    """Of all sizes, and next to where the count of half turns changes."""
    rng = np.random.default_rng(0)
    near = rng.uniform(-4.0, 4.0, 40_000)
    quarters = 0.5 * np.pi * np.arange(-6000, 6000) + rng.normal(0.0, 1e-4, 12_000)
    found = [near, rng.uniform(-FAR, FAR, 40_000), quarters, [0.0, 1e-30, -1e-6]]
    return np.concatenate(found).astype(kind)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("ours", "value", "slope"), BOTH)
def test_values_and_slopes_are_those_of_higher_precision(ours, value, slope, kind):
    x, close = values(kind), {"rtol": 0.0, "atol": 3.0 * np.finfo(kind).eps}
    there = x.astype(np.longdouble)
    found, pushed = jax.jvp(ours, (jnp.asarray(x),), (jnp.ones(x.size, kind),))
    assert found.dtype == pushed.dtype == kind
    np.testing.assert_allclose(found, value(there), **close)
    np.testing.assert_allclose(pushed, slope(there), **close)
    second = jax.vmap(jax.grad(jax.grad(ours)))(jnp.asarray(x[:100]))
    np.testing.assert_allclose(second, -value(there[:100]), **close)


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_small_is_exact_in_its_own_size(kind):
    x = np.asarray([1e-30, -1e-6, 1e-3], kind)
    close = {"rtol": 3.0 * np.finfo(kind).eps, "atol": 0.0}
    np.testing.assert_allclose(sine(jnp.asarray(x)), np.sin(x.astype(float)), **close)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("x", [np.inf, -np.inf, np.nan])
def test_no_number_has_none(x, kind):
    assert np.isnan(float(sine(jnp.asarray(x, kind))))
    assert np.isnan(float(cosine(jnp.asarray(x, kind))))


@pytest.mark.parametrize(("ours", "value", "_"), BOTH)
def test_numpy_keeps_its_own(ours, value, _):
    x = values(np.float64)
    found = ours(x)
    assert isinstance(found, np.ndarray)
    np.testing.assert_array_equal(found, value(x))


@pytest.mark.parametrize(
    ("plant", "reward"),
    [
        (Furuta(), FurutaReward()),
        (CartPole(), CartPoleReward()),
        (UniformRodArm(), None),
    ],
)
def test_no_sine_is_taken_alone_in_a_step(plant, reward):
    """Of a draw with all missing forces, or of a fit: it would be half of the time."""
    sim = MissingForces(Sim2GP(plant)).sim
    draw = sim.init(jax.random.key(0)).sample(jax.random.key(1))

    def planned(s, a):
        then = draw(s, a)
        return then if reward is None else (then, reward(s, a, then))

    def fitted(s, a):
        f = lambda tt: sim.system.transition(tt, s, a, sim.dt)  # noqa: E731
        return jax.jvp(f, (sim.prior.mean,), (sim.prior.mean,))

    for step, kind in ((planned, np.float32), (fitted, np.float64)):
        s, a = (jnp.zeros(len(x), kind) for x in (plant.states, plant.actions))
        text = jax.jit(step).lower(s, a).as_text()
        assert "divide" in text
        assert "sine" not in text
