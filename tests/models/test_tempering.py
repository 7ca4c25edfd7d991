"""How many rows say no more than one: pulls of the data's parts, by other means."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linear_system import linear, transitions
from sim2gp.models import ResidualFunctionSpace, Sim2GP, hybrid
from sim2gp.models.tempering import PARTS, disagreement, parts, tempered

P, D = 3, 2
KEY = jax.random.key(0)


pytestmark = pytest.mark.usefixtures("float64")


def rows(N, seed=0, bent=0.0):
    """Rows of a linear machine; ``bent`` is what it does that no constants explain."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(-1.0, 1.0, (N, D, P))
    y = J @ np.array([0.7, -0.4, 1.1]) + 0.1 * rng.standard_normal((N, D))
    # Slowly, so that whole parts of the data are off to the same side.
    y += bent * np.sin(2 * np.pi * np.arange(N) / N)[:, None] * J[:, :, 0]
    return J, y


def fit(J, y, capacity=None):
    """SIM2GP's belief, and residuals and Jacobians of the rows."""
    (_, d, p), data = J.shape, transitions(J, y)
    if capacity is not None:
        empty = type(data).empty(capacity, d, d * p)
        data = empty.extend(data.state, data.action, data.next_state)
    model = Sim2GP(linear(p, d), dt=1.0)
    belief = model.fit(model.init(KEY), data, key=KEY)
    data = jax.tree.map(jnp.asarray, data)
    r, _, Jr = hybrid.residuals(belief, data, data.delta()[:, :d])
    return belief, r, Jr


def test_pulls_by_hand():
    """Against dense linear algebra, part by part; an uneven number of rows."""
    rng = np.random.default_rng(1)
    J, scores = rng.standard_normal((73, D, P)), rng.standard_normal((73, P))
    flat = J.reshape(-1, P)
    H = flat.T @ flat + np.eye(P)
    leverage = np.einsum("ndp,pq,ndq->n", J, np.linalg.inv(H), J)
    before, cuts = 0.0, [0]
    for n, share in enumerate(leverage / leverage.sum()):
        if int(PARTS * (before + 0.5 * share)) > len(cuts) - 1:
            cuts.append(n)
        before += share
    assert len(cuts) == PARTS
    B = np.zeros((P, P))
    for first, last in zip(cuts, [*cuts[1:], 73], strict=True):
        g = scores[first:last].sum(axis=0)
        B += np.outer(g, g)
    largest = np.max(np.linalg.eigvals(np.linalg.solve(H, B)).real)
    padding = ((0, 55), (0, 0))
    rows, pull = np.pad(J, (*padding, (0, 0))), np.pad(scores, padding)
    R = jnp.asarray(np.linalg.qr(flat, mode="r"))
    got = disagreement(R, jnp.asarray(rows), jnp.asarray(pull))
    expected = largest / (1.0 - 1.0 / PARTS)
    assert float(got) ** 2 == pytest.approx(expected, rel=1e-10)


def test_rows_that_say_nothing_make_no_part():
    """A pole that stands still for four fifths of the time is no evidence."""
    busy = jnp.concatenate([jnp.ones(50), jnp.zeros(200)])
    np.testing.assert_array_equal(parts(busy)[:50], np.arange(50) // 10)
    np.testing.assert_array_equal(parts(jnp.zeros(7)), 0)


@pytest.mark.nightly
def test_the_right_model_meets_the_information_identity():
    """The pulls' second moment is the identity, less one part in all for the MAP."""
    total, runs = np.zeros((P, P)), 60
    for seed in range(runs):
        belief, r, J = fit(*rows(200, seed))
        g = np.einsum("ndp,nd->np", J, np.asarray(r) / np.asarray(belief.noise) ** 2)
        g = g @ np.asarray(belief.prior.scale)
        R = np.asarray(belief.information)
        L = np.linalg.cholesky(np.linalg.inv(R.T @ R + np.eye(P)))
        white = np.asarray(J) / np.asarray(belief.noise)[None, :, None]
        white = white @ np.asarray(belief.prior.scale) @ L
        part = np.asarray(parts(jnp.asarray(np.sum(white**2, axis=(1, 2)))))
        pulls = np.stack([g[part == b].sum(axis=0) for b in range(PARTS)]) @ L
        total += pulls.T @ pulls / runs
        kappa = float(tempered(belief, r, J)[1])
        largest = np.linalg.norm(pulls, 2) / np.sqrt(1.0 - 1.0 / PARTS)
        assert kappa == pytest.approx(max(1.0, np.sqrt(2.0) * largest), rel=1e-6)
    # A sum of B squares with B - 1 degrees of freedom, and products that vanish.
    share = (PARTS - 1) / PARTS
    sd = share * np.sqrt(2.0 / (runs * (PARTS - 1)))
    np.testing.assert_allclose(np.diag(total), share, atol=4.5 * sd)
    off = total - np.diag(np.diag(total))
    np.testing.assert_allclose(off, 0.0, atol=4.5 * sd / np.sqrt(2.0))


@pytest.mark.nightly
def test_rows_said_twice_say_nothing_new():
    """Every row five times over, one after the other: the same posterior as once."""
    J, y = rows(400, bent=1.0)
    once, again = fit(J, y), fit(np.repeat(J, 5, axis=0), np.repeat(y, 5, axis=0))
    (one, kappa), (five, more) = tempered(*once), tempered(*again)
    assert float(more / kappa) == pytest.approx(np.sqrt(5.0), rel=0.01)
    np.testing.assert_allclose(five.covariance(), one.covariance(), rtol=0.02)
    plain = np.diag(again[0].posterior.covariance() / once[0].posterior.covariance())
    np.testing.assert_allclose(plain, 0.2, rtol=0.02)


@pytest.mark.nightly
def test_what_contradicts_itself_stays_wide():
    """Sixteen times the rows, and as much disagreement between the parts."""
    spreads, plain = [], []
    for N in (400, 6400):
        belief, *arrays = fit(*rows(N, bent=1.0))
        spreads.append(float(tempered(belief, *arrays)[0].sd()[0]))
        plain.append(float(belief.posterior.sd()[0]))
    assert spreads[1] == pytest.approx(spreads[0], rel=0.15)
    assert plain[1] == pytest.approx(plain[0] / 4.0, rel=0.1)


def test_an_interval_holds_what_the_parts_scatter_about():
    """Each fifth of the data has a constant of its own, all scatter about one.

    The interval of 95 % is that of Student's t: it holds 95 times in a hundred. Without
    the correction for few parts it would hold 88 times, untempered less than half.
    """
    runs, N = 4000, 50
    J = np.ones((N, 1, 1))
    template, _, _ = fit(J, np.cos(np.arange(N))[:, None])
    rng = np.random.default_rng(0)
    own = np.repeat(0.3 * rng.standard_normal((runs, PARTS)), N // PARTS, axis=1)
    Y = own + 0.1 * rng.standard_normal((runs, N))

    def intervals(y):
        noise = jnp.std(y)
        mean = jnp.sum(y) / (N + noise**2)  # the prior is N(0, 1)
        belief = eqx.tree_at(
            lambda b: (b.posterior.mean, b.noise, b.information),
            template,
            (mean[None], noise[None], jnp.sqrt(N) / noise * jnp.ones((1, 1))),
        )
        wide, _ = tempered(belief, (y - mean)[:, None], jnp.asarray(J))
        return jnp.abs(mean) / jnp.stack([wide.sd()[0], noise / jnp.sqrt(N)])

    off = np.asarray(jax.jit(jax.vmap(intervals))(jnp.asarray(Y)))
    within, plain = np.mean(off < 1.96, axis=0)
    sd = np.sqrt(0.95 * 0.05 / runs)
    assert within == pytest.approx(0.95, abs=4.0 * sd)
    assert plain < 0.6


@pytest.mark.nightly
def test_never_narrower_than_the_posterior():
    belief, r, J = fit(*rows(100), capacity=256)
    wide, kappa = tempered(belief, 0.0 * r, J)
    assert float(kappa) == 1.0
    np.testing.assert_allclose(
        wide.covariance(), belief.posterior.covariance(), rtol=1e-12
    )
    np.testing.assert_array_equal(wide.mean, belief.posterior.mean)
    for bad in ((r.at[3].set(jnp.nan), J), (r, J.at[3].set(jnp.nan))):
        assert np.isnan(float(tempered(belief, *bad)[1]))


@pytest.fixture(scope="module")
def bent():
    """RES-FS on data whose parts disagree, and the same constants by hand."""
    with jax.enable_x64(True):
        J, y = rows(300, bent=1.5)
        options = {"hidden": (8,), "steps": 100, "refit_steps": 100}
        model = ResidualFunctionSpace(Sim2GP(linear(P, D), dt=1.0), **options)
        belief = model.fit(model.init(KEY), transitions(J, y), key=KEY)
        alone, *arrays = fit(J, y)
        return belief, alone, tempered(alone, *arrays)


def without_its_layer(belief):
    return eqx.tree_at(lambda b: b.head.layer.scale, belief, replace_fn=jnp.zeros_like)


@pytest.mark.nightly
def test_the_residual_model_is_as_wide_as_its_data_disagree(bent):
    belief, _, (expected, kappa) = bent
    assert kappa > 3.0
    assert float(belief.kappa) == pytest.approx(float(kappa), rel=1e-6)
    np.testing.assert_allclose(
        belief.physics.covariance(), expected.covariance(), rtol=1e-6
    )
    s, a = jnp.zeros(D), jnp.ones(D * P)
    A = np.ones((D, P))
    found = without_its_layer(belief).latent(s, a)
    np.testing.assert_allclose(
        found.covariance(), A @ expected.covariance() @ A.T, rtol=1e-6
    )


@pytest.mark.nightly
def test_what_no_data_settle_is_not_acted_upon(bent):
    """Draws to act on: constants as wide as the rows say, the layer as it is."""
    belief, alone, (wide, _) = bent
    to_act, plain = belief.untempered(), alone.posterior
    np.testing.assert_allclose(
        to_act.physics.covariance(), plain.covariance(), rtol=1e-6
    )
    np.testing.assert_array_equal(to_act.physics.mean, belief.physics.mean)
    np.testing.assert_array_equal(to_act.head.layer.scale, belief.head.layer.scale)
    s, a = jnp.zeros(D, jnp.float32), jnp.ones(D * P, jnp.float32)
    keys = jax.random.split(KEY, 4000)
    for drawn, constants in ((belief, wide), (to_act, plain)):
        flat = without_its_layer(drawn)
        draws = jax.vmap(lambda key, flat=flat: flat.sample(key)(s, a))(keys)
        known = float(jnp.sum(constants.covariance()))
        assert np.var(np.asarray(draws)[:, 0]) == pytest.approx(known, rel=0.1)
    # Nothing was tempered: itself.
    certain = eqx.tree_at(lambda b: b.kappa, belief, jnp.ones(()))
    np.testing.assert_array_equal(
        certain.untempered().physics.scale, belief.physics.scale
    )
