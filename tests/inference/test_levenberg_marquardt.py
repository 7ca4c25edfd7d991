"""One step of a descent, against the dense problem of all unknowns."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from descents import Curves, some_noise, stacked, standard
from sim2gp.inference import levenberg_marquardt as lm

pytestmark = pytest.mark.usefixtures("float64")


def here(z):
    """The curves of `descents` linearised, all windows' own unknowns at .2 and -.1."""
    likelihood = Curves(jnp.full((3, 2), 4.0), jnp.asarray([0.01, 0.02]))
    e = jnp.tile(jnp.asarray([0.2, -0.1]), (3, 1))
    return lm.evaluate(likelihood, standard(2), jnp.asarray(z), e, some_noise())


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_a_step_is_that_of_the_whole_problem(damping):
    """``(J^T J + mu I) d = -J^T r`` and what the quadratic model saves by ``d``."""
    at = here([0.3, 0.2])
    x = jnp.concatenate([at.z, at.e.ravel()])
    r, J = np.asarray(stacked(x)), np.asarray(jax.jit(jax.jacfwd(stacked))(x))
    d = -np.linalg.solve(J.T @ J + damping * np.eye(len(x)), J.T @ r)
    saved = 0.5 * (r @ r - np.sum((r + J @ d) ** 2))
    take = eqx.filter_jit(lm.step)
    dz, de, predicted = take(standard(2), at, some_noise(), jnp.asarray(damping))
    np.testing.assert_allclose(dz, d[:2], rtol=1e-9)
    np.testing.assert_allclose(de.ravel(), d[2:], rtol=1e-9)
    assert float(predicted) == pytest.approx(saved, rel=1e-9)


def test_a_step_that_costs_more_is_refused():
    """It raises the damping, by more each time; the way back is kept and lowers it."""
    low, high = sorted((here([0.3, 0.2]), here([3.0, -2.0])), key=lambda at: at.cost)
    promised, one, none = high.cost - low.cost, jnp.ones(()), jnp.zeros(())
    keep, (once, refused) = lm.judged(low, high, promised, one, none)
    assert not keep
    assert (float(once), float(refused)) == (lm.RAISE, 1.0)
    keep, (twice, refused) = lm.judged(low, high, promised, once, refused)
    assert not keep
    assert (float(twice), float(refused)) == (lm.RAISE**3, 2.0)
    keep, (lowered, refused) = lm.judged(high, low, promised, one, refused)
    assert keep
    assert (float(lowered), float(refused)) == (pytest.approx(0.1), 0.0)
