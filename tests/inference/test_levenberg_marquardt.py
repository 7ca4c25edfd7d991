"""One step of a descent, against the dense problem of all unknowns."""

from dataclasses import replace

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


@pytest.mark.parametrize(("saved", "kept"), [(0.09, False), (0.11, True)])
def test_a_step_may_have_to_save_a_share_of_what_it_should(saved, kept):
    low, high = sorted((here([0.3, 0.2]), here([3.0, -2.0])), key=lambda at: at.cost)
    promised, one, none = (high.cost - low.cost) / saved, jnp.ones(()), jnp.zeros(())
    keep, (damping, refused) = lm.judged(high, low, promised, one, none, 0.1)
    assert bool(keep) == kept
    assert float(refused) == (0.0 if kept else 1.0)
    assert float(damping) == pytest.approx(
        1.0 - (2.0 * saved - 1.0) ** 3 if kept else lm.RAISE
    )
    assert lm.judged(high, low, promised, one, none)[0]
    # A start has nothing to be compared with.
    nothing = replace(here([0.3, 0.2]), cost=jnp.asarray(jnp.inf))
    assert lm.judged(nothing, low, jnp.asarray(jnp.nan), one, none)[0]
