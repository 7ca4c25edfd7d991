"""Worlds whose constants are drawn anew: what is drawn, kept, and not seen."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import Sim2GP
from sim2gp.planning import SAC, World
from sim2gp.planning.domain_randomisation import randomised_world
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.systems import Furuta
from sim2gp.types import single

KEY = jax.random.key(0)
TASK, SYSTEM = furuta_swingup(), Furuta()
PRIOR = single(Sim2GP(SYSTEM).prior)


def world(constants: Gaussian = PRIOR) -> World:
    return randomised_world(TASK, SYSTEM, constants)


def test_constants_are_drawn_at_each_reset_and_kept_by_every_step() -> None:
    here = world()
    X = jax.vmap(here.reset)(jax.random.split(KEY, 2000))
    tt = np.asarray(X[:, 4:])
    np.testing.assert_allclose(tt.mean(axis=0), PRIOR.mean, atol=0.12)
    sd = np.asarray(PRIOR.sd())
    np.testing.assert_allclose(tt.std(axis=0), sd, rtol=0.06)
    X2, usable = jax.vmap(lambda x: here.step(x, jnp.asarray([1.0])))(X)
    assert bool(usable.all())
    np.testing.assert_array_equal(X2[:, 4:], X[:, 4:])
    assert np.ptp(np.asarray(X2[:, 2])) > 0.1  # each its own machine


def test_a_step_is_that_of_the_simulator_with_these_constants() -> None:
    """Through the record of physical values, which the world never makes."""
    here = world()
    for i in range(5):
        x = here.reset(jax.random.fold_in(KEY, i)).at[:4].add(0.3)
        record = SYSTEM.record(SYSTEM.parameters.values(x[4:]))
        expected = SYSTEM.bind(record, TASK.dt)(x[:4], jnp.asarray([2.0]))
        got, _ = here.step(x, jnp.asarray([2.0]))
        np.testing.assert_allclose(got[:4], expected, rtol=1e-5, atol=1e-6)


def test_a_policy_sees_the_machine_and_not_its_constants() -> None:
    here = world()
    x = here.reset(KEY)
    other = x.at[4:].add(1.0)
    np.testing.assert_array_equal(here.observe(x), here.observe(other))
    planner = SAC(hidden=(8,), num_envs=4, steps=3, updates=1)
    learner = planner.init(here, key=KEY)
    policy = learner.policy
    np.testing.assert_array_equal(policy(x), policy(x[:4]))
    assert policy(x).shape == TASK.actions.low.shape


def test_known_constants_are_an_ordinary_world() -> None:
    known = Gaussian(PRIOR.mean, jnp.zeros_like(PRIOR.scale))
    here = world(known)
    x = here.reset(KEY)
    np.testing.assert_array_equal(x[4:], PRIOR.mean)
    assert here.horizon == TASK.horizon
    assert eqx.tree_equal(here.actions, TASK.actions)
