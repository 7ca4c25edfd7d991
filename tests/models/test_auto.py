"""Auto: the data choose, before they are learned from, and ties go to the simpler."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from linear_system import linear, transitions
from sim2gp.models import Auto, Residual, Sim2GP
from sim2gp.models.auto import choose, log_scores

P, D = 3, 2
KEY = jax.random.key(0)


pytestmark = pytest.mark.usefixtures("float64")


def rows(N, bent, seed):
    """A linear machine; ``bent`` adds what no constant of it explains."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(-1.0, 1.0, (N, D, P))
    y = J @ np.array([0.7, -0.4, 1.1]) + 0.1 * rng.standard_normal((N, D))
    y[:, 1] += bent * np.cos(3.0 * J[:, 0, 0])
    return transitions(J, y)


def extended(data, more):
    return data.extend(more.state, more.action, more.next_state)


def empty():
    some = rows(1, 0.0, 0)
    return type(some).empty(300, D, some.action.shape[1])


def auto():
    sim = Sim2GP(linear(P, D), dt=1.0)
    return Auto([sim, Residual(sim, hidden=(12, 10), steps=900, refit_steps=300)])


def test_scores_are_the_predictive_density():
    sim = Sim2GP(linear(P, D), dt=1.0)
    data = extended(empty(), rows(40, 0.0, 1))
    belief = sim.fit(sim.init(KEY), data, key=KEY)
    found = np.asarray(log_scores(belief, data))
    assert np.all(found[40:] == 0.0)
    for n in (0, 17, 39):
        p = belief.predict(jnp.asarray(data.state[n]), jnp.asarray(data.action[n]))
        known = multivariate_normal(p.mean, p.covariance()).logpdf(data.next_state[n])
        assert found[n] == pytest.approx(known, rel=1e-9)


@pytest.fixture(scope="module")
def runs():
    """Three episodes of 80 rows, with and without a term that the physics lacks."""
    out = {}
    with jax.enable_x64(True):
        for bent in (0.0, 0.6):
            model, data = auto(), empty()
            beliefs = [model.init(KEY)]
            for e in range(3):
                data = extended(data, rows(80, bent, 10 + e))
                key = jax.random.fold_in(KEY, e)
                beliefs.append(model.fit(beliefs[-1], data, key=key))
            out[bent] = model, data, beliefs
    return out


def test_physics_that_is_right_keeps_the_floor(runs):
    assert [int(b.index) for b in runs[0.0][2]] == [0, 0, 0, 0]


def test_a_residual_is_chosen_once_it_has_foretold_an_episode(runs):
    """After one episode all were priors; after two the network has been tested."""
    assert [int(b.index) for b in runs[0.6][2]][2:] == [1, 1]


def test_the_score_is_of_the_newest_episode_before_training(runs):
    """By hand: the beliefs after episode 2, on the rows of episode 3 alone."""
    _, data, beliefs = runs[0.6]
    for k, belief in enumerate(beliefs[2].beliefs):
        by_hand = np.asarray(log_scores(belief, data))[160:240].mean()
        assert float(beliefs[3].scores[k]) == pytest.approx(by_hand, rel=1e-9)


def test_it_answers_as_the_chosen_model(runs):
    _, data, beliefs = runs[0.6]
    belief = beliefs[-1]
    chosen = belief.beliefs[int(belief.index)]
    s, a = jnp.asarray(data.state[3]), jnp.asarray(data.action[3])
    for which in ("latent", "predict"):
        mine, its = getattr(belief, which)(s, a), getattr(chosen, which)(s, a)
        np.testing.assert_allclose(mine.mean, its.mean, rtol=1e-12)
        np.testing.assert_allclose(mine.covariance(), its.covariance(), rtol=1e-12)
    for which in ("sample", "point"):
        arguments = (KEY,) if which == "sample" else ()
        mine = getattr(belief, which)(*arguments)(s.astype("f4"), a.astype("f4"))
        its = getattr(chosen, which)(*arguments)(s.astype("f4"), a.astype("f4"))
        np.testing.assert_array_equal(mine, its)
    gains = belief.information_gain(s, a), chosen.information_gain(s, a)
    assert float(gains[0]) == float(gains[1])


def test_draws_before_and_after_data_are_one_program(runs):
    """None has a number of 64 bits: on a GPU planning would fail."""
    _, _, beliefs = runs[0.6]
    for draw in (
        f(b) for b in beliefs for f in (lambda b: b.sample(KEY), lambda b: b.point())
    ):
        kinds = {leaf.dtype.itemsize for leaf in jax.tree.leaves(draw)}
        assert kinds == {4}


def test_it_acts_on_what_each_would(runs):
    _, _, beliefs = runs[0.6]
    doubtful = eqx.tree_at(lambda b: b.beliefs[1].kappa, beliefs[-1], jnp.asarray(9.0))
    wide = eqx.tree_at(
        lambda b: b.beliefs[1].physics.scale, doubtful, replace_fn=lambda x: 9.0 * x
    )
    found = wide.untempered()
    np.testing.assert_array_equal(
        found.beliefs[0].posterior.scale, wide.beliefs[0].posterior.scale
    )
    np.testing.assert_array_equal(
        found.beliefs[1].physics.scale, wide.beliefs[1].sim.posterior.scale
    )


def test_updates_reach_every_model(runs):
    model, data, beliefs = runs[0.0]
    row = data.state[5], data.action[5], data.next_state[5]
    updated = model.update(beliefs[-1], *map(jnp.asarray, row))
    for m, old, new in zip(
        model.models, beliefs[-1].beliefs, updated.beliefs, strict=True
    ):
        alone = m.update(old, *map(jnp.asarray, row))
        for x, y in zip(jax.tree.leaves(alone), jax.tree.leaves(new), strict=True):
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(
    ("gaps", "expected"),
    [
        ((0.0, 0.0, 0.0), 0),  # a tie: the simplest
        ((0.0, 0.5, 0.5), 1),  # the simpler one of the better ones
        ((0.0, 0.001, -1.0), 0),  # better by less than its standard error
        ((0.0, np.nan, -1.0), 0),  # no number never wins
        ((np.nan, -5.0, -6.0), 1),
        ((-np.inf, -5.0, -6.0), 1),
    ],
)
def test_choice(gaps, expected):
    rng = np.random.default_rng(0)
    each = np.asarray(gaps)[:, None] + 0.1 * rng.standard_normal((3, 50))
    if gaps[0] == gaps[1]:
        each = np.zeros((3, 50))
    padded = np.concatenate([each, np.full((3, 14), np.nan)], axis=1)
    new = jnp.asarray(np.arange(64) < 50)
    index, means = choose(jnp.asarray(padded), new)
    assert int(index) == expected
    if np.all(np.isfinite(gaps)):
        np.testing.assert_allclose(means, each.mean(axis=1), rtol=1e-12)
