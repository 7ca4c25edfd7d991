"""Neural linear model: the exact last layer, its training, and its safeguards."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oracles import exact
from sim2gp.data.transitions import Transitions
from sim2gp.errors import InputError, NotFinite
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import NLM, features
from sim2gp.models import nlm as module
from sim2gp.systems import Delay, Furuta, Machine

KEY = jax.random.key(0)
N, M, D = 40, 7, 2


pytestmark = pytest.mark.usefixtures("float64")


def table(seed=0, scales=1.0):
    rng = np.random.default_rng(seed)
    Phi = rng.standard_normal((N, M)) * scales
    Y = Phi @ rng.standard_normal((M, D)) + 0.1 * rng.standard_normal((N, D))
    return Phi, Y


@pytest.mark.parametrize("scales", [1.0, np.geomspace(1.0, 1e-4, M)])
def test_the_layer_is_exact_bayesian_regression(scales):
    """Mean, covariance and evidence against many digits; masked rows do not exist."""
    Phi, Y = table(0, scales)
    noise, alpha = np.array([0.1, 3.0]), np.array([2.0, 0.3])
    rows = np.arange(N) < 33
    R = last_layer.data_factor(jnp.asarray(Phi), jnp.asarray(Y), jnp.asarray(rows))
    layer, evidence = last_layer.regression(
        R, jnp.asarray(33.0), jnp.asarray(noise), jnp.asarray(alpha)
    )
    for k in range(D):
        reference = exact.posterior(
            Phi[:33, None, :],
            Y[:33, k : k + 1],
            np.array([[noise[k]]]),
            np.zeros(M),
            np.eye(M) / np.sqrt(alpha[k]),
        )
        S = np.asarray(layer.scale[k])
        assert reference.mean_error(np.asarray(layer.mean[k])) <= 1e-10
        assert exact.cov_error(reference.cov, S @ S.T) <= 1e-10
        assert float(evidence[k]) == pytest.approx(reference.log_evidence, rel=1e-10)


def test_fewer_rows_than_features():
    Phi, Y = table()
    rows = jnp.arange(3) < 2
    R = last_layer.data_factor(jnp.asarray(Phi[:3]), jnp.asarray(Y[:3]), rows)
    ones = jnp.ones(D)
    layer, _ = last_layer.regression(R, jnp.asarray(2.0), ones, ones)
    P, y = Phi[:2], Y[:2]
    cov = np.linalg.inv(np.eye(M) + P.T @ P)
    S = np.asarray(layer.scale[0])
    np.testing.assert_allclose(S @ S.T, cov, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(layer.mean, (cov @ P.T @ y).T, rtol=1e-10)


def small(**options):
    return NLM(
        Furuta(), **{"hidden": (8, 6), "steps": 200, "refit_steps": 100, **options}
    )


def some_data(count, capacity=64, noise=0.05, seed=0):
    rng = np.random.default_rng(seed)
    s = rng.uniform(-1.0, 1.0, (count, 4))
    a = rng.uniform(-5.0, 5.0, (count, 1))
    change = np.stack([s[:, 2], s[:, 3], 0.3 * a[:, 0], np.sin(s[:, 1])], axis=1)
    s2 = s + 0.1 * change + noise * rng.standard_normal((count, 4))
    return Transitions.empty(capacity, 4, 1).extend(s, a, s2)


def test_training_follows_the_evidence():
    """The surrogate's gradient is the exact evidence's, features and scalars alike."""
    model = small()
    trained = module.Trained.random(KEY, model.encoding, model.hidden)
    trained = jax.tree.map(lambda x: x.astype(float), trained)
    data = jax.tree.map(jnp.asarray, some_data(20, 24))
    X, Y = features.encoded(model.encoding, data)

    @eqx.filter_jit
    def evidence(trained):
        R = last_layer.data_factor(trained.features(X), Y, data.mask)
        count = jnp.asarray(20.0)
        _, each = last_layer.regression(R, count, trained.noise, trained.alpha)
        return -jnp.sum(each) / count

    loss = module.evidence_loss
    got = jax.jit(jax.grad(loss))(trained, X, Y, data.mask)
    # Central differences: QR with fewer rows than columns has no derivative in JAX.
    leaves, tree = jax.tree.flatten(trained)
    rng = np.random.default_rng(1)
    for _ in range(3):
        step = [1e-5 * rng.standard_normal(leaf.shape) for leaf in leaves]
        up = tree.unflatten([x + d for x, d in zip(leaves, step, strict=True)])
        down = tree.unflatten([x - d for x, d in zip(leaves, step, strict=True)])
        slope = sum(
            float(np.sum(np.asarray(g) * d))
            for g, d in zip(jax.tree.leaves(got), step, strict=True)
        )
        difference = float(evidence(up) - evidence(down)) / 2.0
        assert slope == pytest.approx(difference, rel=1e-6)


@pytest.fixture(scope="module")
def fitted():
    with jax.enable_x64(True):
        model, data = small(), some_data(40)
        return model, data, model.fit(model.init(KEY), data, key=KEY)


def batch(belief, data, count):
    """The posterior of ``count`` rows with the belief's own features, by formulas."""
    head = belief.head
    X, y = features.encoded(head.encoding, jax.tree.map(jnp.asarray, data))
    Phi = np.asarray(head.trained.features(X))[:count]
    means, covs = [], []
    for k in range(4):
        c, sd = float(head.output_scale[k]), float(belief.noise[k])
        alpha = float(head.trained.alpha[k])
        P = alpha * np.eye(Phi.shape[1]) + c**2 * Phi.T @ Phi / sd**2
        covs.append(np.linalg.inv(P))
        means.append(covs[-1] @ Phi.T @ np.asarray(y)[:count, k] * c / sd**2)
    return means, covs


def test_a_fit_ends_in_the_posterior_of_all_rows(fitted):
    _, data, belief = fitted
    means, covs = batch(belief, data, 40)
    for k in range(4):
        S = np.asarray(belief.head.layer.scale[k])
        np.testing.assert_allclose(S @ S.T, covs[k], rtol=1e-7, atol=1e-10)
        np.testing.assert_allclose(belief.head.layer.mean[k], means[k], rtol=1e-7)


def test_updates_end_where_a_batch_does(fitted):
    model, _, belief = fitted
    data = some_data(60, seed=3)
    d, m = 4, belief.head.trained.network.features
    blank = last_layer.LastLayer.prior(d, m, 0, belief.head.trained.alpha)
    later = eqx.tree_at(lambda b: b.head.layer, belief, blank)
    update = eqx.filter_jit(model.update)
    for i in range(20):
        row = [jnp.asarray(x[i]) for x in (data.state, data.action, data.next_state)]
        later = update(later, *row)
    means, covs = batch(belief, data, 20)
    for k in range(d):
        S = np.asarray(later.head.layer.scale[k])
        np.testing.assert_allclose(S @ S.T, covs[k], rtol=1e-8, atol=1e-11)
        np.testing.assert_allclose(later.head.layer.mean[k], means[k], rtol=1e-8)
    assert int(later.count) == int(belief.count) + 20


def test_draws_have_the_moments_of_the_belief(fitted):
    """Mean and covariance of 20,000 draws at two points, within 4.5 standard errors."""
    _, _, belief = fitted
    points = [(0.3 * jnp.ones(4), jnp.ones(1)), (-0.2 * jnp.ones(4), -jnp.ones(1))]
    n = 20_000

    @eqx.filter_jit
    def values(keys):
        def one(key):
            f = belief.sample(key)
            rows = [(s.astype(jnp.float32), a.astype(jnp.float32)) for s, a in points]
            return jnp.concatenate([f(s, a) for s, a in rows])

        return jax.lax.map(one, keys, batch_size=1000)

    got = np.asarray(values(jax.random.split(KEY, n)), float)
    head = belief.head
    own = np.stack([np.asarray(head.moments(s, a)[2]) for s, a in points])
    mean = np.concatenate([np.asarray(belief.latent(s, a).mean) for s, a in points])
    cov = np.zeros((8, 8))
    for i in range(2):
        for j in range(2):
            cov[4 * i : 4 * i + 4, 4 * j : 4 * j + 4] = np.diag(
                np.sum(own[i] * own[j], axis=1)
            )
    here = belief.latent(*points[0]).covariance()
    np.testing.assert_allclose(cov[:4, :4], here, rtol=1e-12)
    sd = np.sqrt(np.diag(cov))
    assert np.all(np.abs(got.mean(0) - mean) <= 4.5 * sd / np.sqrt(n) + 1e-6)
    se = np.sqrt((np.outer(sd, sd) ** 2 + cov**2) / n)
    assert np.all(np.abs(np.cov(got.T) - cov) <= 4.5 * se + 1e-9)


def test_information_gain(fitted):
    """Closed form at a point; a trajectory's is the sum over updated beliefs."""
    model, _, belief = fitted
    rng = np.random.default_rng(4)
    S, A = (
        jnp.asarray(rng.standard_normal((5, 4))),
        jnp.asarray(rng.uniform(size=(5, 1))),
    )
    V = np.diag(belief.latent(S[0], A[0]).covariance())
    closed = 0.5 * np.sum(np.log1p(V / np.asarray(belief.noise) ** 2))
    assert float(belief.information_gain(S[0], A[0])) == pytest.approx(closed, rel=1e-9)
    total, later = 0.0, belief
    update = eqx.filter_jit(model.update)
    for s, a in zip(S, A, strict=True):
        total += float(later.information_gain(s, a))
        later = update(later, s, a, jnp.ones(4))
    joint = float(belief.trajectory_information_gain(S, A))
    assert joint == pytest.approx(total, rel=1e-9)


def test_recalibration_recovers_the_noise():
    """Planted noise of held-out residuals, beside epistemic variance that differs."""
    rng = np.random.default_rng(5)
    n, truth = 4000, np.array([0.02, 0.4])
    V = rng.uniform(0.0, 5e-4, (n, 2))
    r = np.sqrt(V + truth**2) * rng.standard_normal((n, 2))
    out = np.arange(n) < 3500
    r[~out] = 100.0
    noise, losses = last_layer.recalibrated(
        jnp.asarray(V), jnp.asarray(r), jnp.asarray(out), jnp.asarray([1.0, 1e-3])
    )
    np.testing.assert_allclose(noise, truth, rtol=0.08)
    total = V[out] + np.asarray(noise) ** 2
    expected = 0.5 * np.mean(np.log(2 * np.pi * total) + r[out] ** 2 / total, axis=0)
    np.testing.assert_allclose(losses, expected, rtol=1e-9)


def test_two_lucky_rows_do_not_end_the_noise():
    zeros = jnp.zeros((2, 1))
    out = jnp.ones(2, bool)
    noise, _ = last_layer.recalibrated(zeros, zeros, out, jnp.asarray([0.2]))
    assert float(noise[0]) > 0.1


@pytest.mark.nightly
def test_few_noisy_rows_do_not_end_the_noise():
    """Pure noise on 12 rows: type-II training alone explains it by features."""
    rng = np.random.default_rng(6)
    s, a = rng.uniform(-1, 1, (12, 4)), rng.uniform(-5, 5, (12, 1))
    data = Transitions.of(s, a, s + 0.1 * rng.standard_normal((12, 4)))
    model = NLM(Furuta(), steps=600)
    belief = model.fit(model.init(KEY), data, key=KEY)
    assert np.all(np.asarray(belief.noise) > 0.05)
    assert np.all(np.asarray(belief.noise) < 0.3)


@pytest.mark.nightly
def test_held_out_rows_stay_where_they_are():
    def out(count, capacity):
        return np.flatnonzero(features.held_out_rows(jnp.arange(capacity) < count))

    assert out(1, 8).size == 0
    for count in (2, 3, 5):
        assert out(count, 8).size == 1
    few, many = out(250, 256), out(500, 1024)
    assert many.size == 100
    np.testing.assert_array_equal(few, many[many < 250])
    assert few.size == 50


def test_minibatches_take_every_row_once():
    rows = jnp.arange(64) % 3 > 0
    batches = features.Minibatches.shuffled(KEY, rows)
    index, valid = batches.batch(jnp.asarray(0), 64)
    assert sorted(np.asarray(index)[valid]) == list(np.flatnonzero(rows))
    seen = [np.asarray(batches.batch(jnp.asarray(t), 6)[0]) for t in range(7)]
    assert set(np.concatenate(seen)) == set(np.flatnonzero(rows))
    assert all(len(set(part)) == 6 for part in seen)


def test_encoding_of_channels():
    encoding = features.Encoding.of(Furuta(), {"alpha.velocity": 25.0})
    s, a = jnp.asarray([0.5, 2.0, 10.0, 5.0]), jnp.asarray([2.5])
    expected = [np.sin(0.5), np.cos(0.5), np.sin(2), np.cos(2), 0.5, 0.2, 0.5]
    np.testing.assert_allclose(encoding(s, a), expected, rtol=1e-12)
    assert encoding.size == 7
    with pytest.raises(InputError, match=r"E103.*alpha.velocity"):
        NLM(Furuta(), reach={"alpha.velocty": 1.0})


def test_past_actions_move_on():
    """Carried inputs are known, not predicted: newest first, the oldest dropped."""
    system = Machine(Furuta(), actuators=[Delay("voltage", 0.03)], period=0.02)
    model = NLM(system, hidden=(4,))
    belief = model.init(KEY)
    s, a = jnp.asarray([0.0, 0.1, 0.2, 0.3, 1.0, 2.0]), jnp.asarray([3.0])
    draw = belief.sample(KEY)
    np.testing.assert_array_equal(draw(s, a)[4:], [3.0, 1.0])
    latent = belief.latent(s, a)
    np.testing.assert_array_equal(latent.mean[4:], [3.0, 1.0])
    np.testing.assert_array_equal(latent.sd()[4:], 0.0)
    assert np.all(np.asarray(latent.sd()[:4]) > 0.0)


@pytest.mark.nightly
def test_growing_data_retrace_nothing():
    traces = []
    inner = module.type_two

    def counted(*args):
        traces.append(1)
        return inner(*args)

    model = small(hidden=(5, 5))
    belief = model.init(KEY)
    draws = [belief.sample(KEY)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "type_two", counted)
        for count in (10, 25, 60):
            belief = model.fit(belief, some_data(count), key=jax.random.key(count))
            draws.append(belief.sample(KEY))
    assert traces == [1]
    shapes = {jax.tree.structure(draw) for draw in draws}
    assert len(shapes) == 1
    assert {x.dtype for x in jax.tree.leaves(draws)} == {jnp.dtype("float32")}


def test_a_single_transition_and_none():
    model = small()
    start = model.init(KEY)
    assert model.fit(start, Transitions.empty(64, 4, 1), key=KEY) is start
    one = model.fit(start, some_data(1), key=KEY)
    assert np.all(np.asarray(one.noise) > 0.0)
    s, a = jnp.zeros(4), jnp.zeros(1)
    assert bool(jnp.all(jnp.isfinite(one.predict(s, a).covariance())))


def test_data_that_are_not_finite_are_said():
    data = some_data(30)
    broken = eqx.tree_at(
        lambda d: d.next_state, data, np.where(np.arange(64)[:, None] == 3, np.nan, 1.0)
    )
    model = small()
    with pytest.raises(NotFinite):
        model.fit(model.init(KEY), broken, key=KEY)


def test_prediction_adds_the_noise(fitted):
    _, _, belief = fitted
    s, a = jnp.zeros(4), jnp.zeros(1)
    latent, predictive = belief.latent(s, a), belief.predict(s, a)
    assert isinstance(predictive, Gaussian)
    extra = predictive.covariance() - latent.covariance()
    np.testing.assert_allclose(extra, np.diag(belief.noise**2), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(belief.point()(s, a), latent.mean, atol=1e-7)
