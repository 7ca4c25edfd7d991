"""RES: physics plus network, where the answer is known."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linear_system import linear, transitions
from sim2gp.inference import linear_regression as last_layer
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import Residual, Sim2GP, features
from sim2gp.models import residual as module
from sim2gp.models.point_estimate import PointEstimate

P, D, M = 3, 2, 5
KEY = jax.random.key(0)


pytestmark = pytest.mark.usefixtures("float64")


def make(N, bent, seed=1, noise=0.1):
    """Rows of a linear machine, with a bent residual that no constant explains."""
    rng = np.random.default_rng(seed)
    J = rng.uniform(-1.0, 1.0, (N, D, P))
    y = J @ np.array([0.7, -0.4, 1.1]) + noise * rng.standard_normal((N, D))
    y[:, 1] += bent * np.cos(3.0 * J[:, 0, 0])
    return J, y


def padded(J, y, capacity=128):
    data = transitions(J, y)
    empty = type(data).empty(capacity, D, D * P)
    return empty.extend(data.state, data.action, data.next_state)


def model(**options):
    sim = Sim2GP(linear(P, D), dt=1.0)
    return Residual(sim, **{"hidden": (12, 10), "refit_steps": 200, **options})


@pytest.fixture(scope="module")
def fits():
    """One fit for each mode, with and without a residual to be found."""
    made = {}
    with jax.enable_x64(True):
        for mode in module.MODES:
            for bent in (0.0, 1.0):
                recipe = model(mode=mode)
                data = padded(*make(100, bent))
                belief = recipe.fit(recipe.init(KEY), data, key=KEY)
                made[mode, bent] = recipe, data, belief
    return made


def a_point(seed=0):
    rng = np.random.default_rng(seed)
    return jnp.zeros(D), jnp.asarray(rng.uniform(-1.0, 1.0, D * P))


def assert_same(one, two, s, a):
    for which in ("latent", "predict"):
        g, h = getattr(one, which)(s, a), getattr(two, which)(s, a)
        np.testing.assert_allclose(g.mean, h.mean, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(
            g.covariance(), h.covariance(), rtol=1e-12, atol=1e-16
        )
    gains = [float(b.information_gain(s, a)) for b in (one, two)]
    assert gains[0] == pytest.approx(gains[1], rel=1e-9)


@pytest.mark.parametrize("mode", module.MODES)
def test_without_a_residual_it_is_sim2gp(fits, mode):
    """Before data, and after data that the simulator explains: equal to 1e-12."""
    recipe, data, belief = fits[mode, 0.0]
    assert np.all(np.asarray(belief.head.output_scale) == 0.0)
    alone = recipe.sim.fit(recipe.sim.init(KEY), data, key=jax.random.split(KEY)[0])
    before, prior = recipe.init(KEY), recipe.sim.init(KEY)
    for seed in range(3):
        assert_same(belief, alone, *a_point(seed))
        assert_same(before, prior, *a_point(seed))
    s, a = (x.astype(jnp.float32) for x in a_point())
    np.testing.assert_allclose(belief.point()(s, a), alone.point()(s, a), rtol=1e-6)
    np.testing.assert_array_equal(belief.parameters()[0], alone.parameters()[0])


@pytest.mark.parametrize("mode", module.MODES)
def test_a_belief_keeps_its_shape(fits, mode):
    """Nothing retraces: structure, types and weak types are those before the fit."""
    recipe, _, belief = fits[mode, 1.0]
    before = recipe.init(KEY)
    assert jax.tree.structure(before) == jax.tree.structure(belief)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(belief), strict=True):
        assert old.aval.strip_weak_type() == new.aval.strip_weak_type()
        assert old.weak_type == new.weak_type
    for one, two in (
        (before.sample(KEY), belief.sample(KEY)),
        (before.point(), belief.point()),
    ):
        assert jax.tree.structure(one) == jax.tree.structure(two)
        assert {x.dtype for x in jax.tree.leaves(two)} == {jnp.dtype("float32")}


@pytest.mark.parametrize("mode", module.MODES)
def test_the_residual_is_found(fits, mode):
    recipe, data, belief = fits[mode, 1.0]
    assert float(belief.head.output_scale[1]) > 0.0
    J, y = make(200, 1.0, seed=9, noise=0.0)
    test = transitions(J, y)
    args = jnp.asarray(test.state), jnp.asarray(test.action)
    alone = recipe.sim.fit(recipe.sim.init(KEY), data, key=KEY)
    got = jax.vmap(lambda s, a: belief.latent(s, a).mean)(*args)
    without = jax.vmap(lambda s, a: alone.latent(s, a).mean)(*args)
    error = np.sqrt(np.mean((np.asarray(got) - y)[:, 1] ** 2))
    assert error < 0.5 * np.sqrt(np.mean((np.asarray(without) - y)[:, 1] ** 2))
    assert 0.05 < float(belief.noise[1]) < 0.6 * float(belief.sim.noise[1])
    assert float(belief.sim.noise[1]) > 0.4


def test_the_sum_is_of_two_posteriors(fits):
    """``J Sq J^T + c^2 phi^T S phi``, and the layer's S by the textbook."""
    _, data, belief = fits["seq_sum", 1.0]
    head, mask = belief.head, np.asarray(data.mask)
    X, y = features.encoded(head.encoding, jax.tree.map(jnp.asarray, data))
    Phi = np.asarray(head.trained.features(X))[mask]
    mean_tt = np.asarray(belief.sim.posterior.mean)
    J = np.asarray(data.action)[mask].reshape(-1, D, P)
    r = np.asarray(y)[mask] - J @ mean_tt
    s, a = a_point()
    phi, here = np.asarray(head.phi(s, a)), np.asarray(a).reshape(D, P)
    mean, var = here @ mean_tt, []
    for k in range(D):
        c, sd = float(head.output_scale[k]), float(belief.noise[k])
        var.append(0.0)
        if c:
            precision = float(head.trained.alpha[k]) * np.eye(len(phi))
            precision += c**2 * Phi.T @ Phi / sd**2
            S = np.linalg.inv(precision)
            mean[k] += c * phi @ S @ Phi.T @ r[:, k] * c / sd**2
            var[-1] = c**2 * phi @ S @ phi
    got = belief.latent(s, a)
    np.testing.assert_allclose(got.mean, mean, rtol=1e-8)
    cov = here @ np.asarray(belief.sim.posterior.covariance()) @ here.T + np.diag(var)
    np.testing.assert_allclose(got.covariance(), cov, rtol=1e-8)
    noise = np.asarray(belief.noise)
    gain = 0.5 * np.linalg.slogdet(np.eye(D) + cov / np.outer(noise, noise))[1]
    assert float(belief.information_gain(s, a)) == pytest.approx(gain, rel=1e-8)


def dense(J, Phi, y, noise, alpha, prior, c):
    """The joint posterior over [tt ; vec W] by one dense inverse."""
    N, m = Phi.shape
    B = np.zeros((N, D, P + D * m))
    B[:, :, :P] = J
    for k in range(D):
        B[:, k, P + k * m : P + (k + 1) * m] = c[k] * Phi
    S0 = np.asarray(prior.covariance())
    precision = np.zeros((P + D * m, P + D * m))
    precision[:P, :P] = np.linalg.inv(S0)
    precision[P:, P:] = np.kron(np.diag(alpha), np.eye(m))
    first = np.concatenate([np.asarray(prior.mean), np.zeros(D * m)])
    white = (B / noise[:, None]).reshape(N * D, -1)
    right = precision @ first + white.T @ (y / noise).ravel()
    cov = np.linalg.inv(precision + white.T @ white)
    return cov @ right, cov


def moments(z, layer):
    """Mean and covariance of [tt ; vec W] as the belief holds them."""
    d, m, p = layer.shared.shape
    scale = np.zeros((p + d * m, p + d * m))
    scale[:p, :p] = z.scale
    for k in range(d):
        rows = slice(p + k * m, p + (k + 1) * m)
        scale[rows, :p] = layer.shared[k]
        scale[rows, rows] = layer.scale[k]
    mean = np.concatenate([np.asarray(z.mean), np.asarray(layer.mean).ravel()])
    return mean, scale @ scale.T


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(3)
    N = 30
    J, Phi = rng.standard_normal((N, D, P)), rng.standard_normal((N, M))
    y = rng.standard_normal((N, D))
    scale = np.tril(rng.standard_normal((P, P))) + 2 * np.eye(P)
    with jax.enable_x64(True):
        prior = Gaussian(jnp.asarray(rng.standard_normal(P)), jnp.asarray(scale))
    noise, alpha, c = np.array([0.3, 0.1]), np.array([2.0, 0.5]), np.array([1.5, 0.2])
    return J, Phi, y, noise, alpha, prior, c


def test_joint_is_the_dense_posterior(problem):
    J, Phi, y, noise, alpha, prior, c = problem
    rows = np.arange(len(y)) < 25
    arrays = [jnp.asarray(x) for x in (Phi, J, y, rows, noise, alpha)]
    z, layer = last_layer.joint_regression(*arrays, prior, jnp.asarray(c))
    mean, cov = dense(J[:25], Phi[:25], y[:25], noise, alpha, prior, c)
    got_mean, got_cov = moments(z, layer)
    np.testing.assert_allclose(got_mean, mean, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(got_cov, cov, rtol=1e-9, atol=1e-11)


def test_updates_are_the_dense_posterior(problem):
    """Rows one by one from independent priors: correlations and all, to 1e-8."""
    J, Phi, y, noise, alpha, prior, c = problem
    layer = last_layer.LastLayer.prior(D, M, P, jnp.asarray(alpha))
    z = prior
    update = eqx.filter_jit(last_layer.condition)
    for n in range(12):
        phi = jnp.asarray(c[:, None] * Phi[n])
        seen = J[n] @ np.asarray(z.mean) + np.sum(phi * layer.mean, axis=1)
        residual = jnp.asarray(y[n] - seen)
        z, layer = update(z, layer, jnp.asarray(J[n]), phi, residual, noise)
    mean, cov = dense(J[:12], Phi[:12], y[:12], noise, alpha, prior, c)
    got_mean, got_cov = moments(z, layer)
    np.testing.assert_allclose(got_mean, mean, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(got_cov, cov, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("mode", module.MODES)
def test_update_conditions_the_belief(fits, mode):
    """Predictions after an update are the Gaussian conditional of those before."""
    recipe, _, belief = fits[mode, 1.0]
    (s, a), (t, b) = a_point(1), a_point(2)
    s2 = jnp.asarray([0.3, -0.8])
    later = eqx.filter_jit(recipe.update)(belief, s, a, s2)
    both = np.concatenate([np.asarray(scale_at(belief, *x)) for x in ((s, a), (t, b))])
    K = both @ both.T
    S = K[:D, :D] + np.diag(np.asarray(belief.noise) ** 2)
    gain = K[D:, :D] @ np.linalg.inv(S)
    old = np.asarray(belief.latent(t, b).mean)
    mean = old + gain @ np.asarray(s2 - belief.latent(s, a).mean)
    got = later.latent(t, b)
    np.testing.assert_allclose(got.mean, mean, rtol=1e-9)
    cov = K[D:, D:] - gain @ K[:D, D:]
    np.testing.assert_allclose(got.covariance(), cov, rtol=1e-8)
    alone = recipe.sim.update(belief.sim, s, a, s2)
    np.testing.assert_array_equal(later.sim.posterior.mean, alone.posterior.mean)
    assert int(later.count) == int(belief.count) + 1


def scale_at(belief, s, a):
    _, shared, own = belief.parts(s, a)
    blocks = jax.scipy.linalg.block_diag(*(own[k : k + 1] for k in range(D)))
    return jnp.concatenate([shared, blocks], axis=1)


def test_trajectory_gain_telescopes(fits):
    recipe, _, belief = fits["joint", 1.0]
    points = [a_point(seed) for seed in range(4)]
    total, later = 0.0, belief
    update = eqx.filter_jit(recipe.update)
    for s, a in points:
        total += float(later.information_gain(s, a))
        later = update(later, s, a, jnp.ones(D))
    S, A = (jnp.stack(x) for x in zip(*points, strict=True))
    joint = float(belief.trajectory_information_gain(S, A))
    assert joint == pytest.approx(total, rel=1e-9)


def test_draws_have_the_moments_of_the_belief(fits):
    """Constants and layer are drawn together: 20,000 draws at two points."""
    _, _, belief = fits["joint", 1.0]
    points = [a_point(1), a_point(2)]
    n = 20_000

    @eqx.filter_jit
    def values(keys):
        def one(key):
            f = belief.sample(key)
            rows = [(s.astype(jnp.float32), a.astype(jnp.float32)) for s, a in points]
            return jnp.concatenate([f(s, a) for s, a in rows])

        return jax.lax.map(one, keys, batch_size=1000)

    got = np.asarray(values(jax.random.split(KEY, n)), float)
    both = np.concatenate([np.asarray(scale_at(belief, *x)) for x in points])
    mean = np.concatenate([np.asarray(belief.latent(*x).mean) for x in points])
    cov = both @ both.T
    sd = np.sqrt(np.diag(cov))
    assert np.all(np.abs(got.mean(0) - mean) <= 4.5 * sd / np.sqrt(n) + 1e-6)
    se = np.sqrt((np.outer(sd, sd) ** 2 + cov**2) / n)
    assert np.all(np.abs(np.cov(got.T) - cov) <= 4.5 * se + 1e-9)


def test_growing_data_retrace_nothing():
    traces = []
    inner = module._posterior

    def counted(*args):
        traces.append(1)
        return inner(*args)

    recipe = model(hidden=(6, 5), steps=100, refit_steps=100)
    belief = recipe.init(KEY)
    J, y = make(100, 1.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_posterior", counted)
        for count in (20, 50, 100):
            data = padded(J[:count], y[:count])
            belief = recipe.fit(belief, data, key=jax.random.key(count))
    assert traces == [1]


def test_a_point_estimate_does_not_vary(fits):
    recipe, _, belief = fits["joint", 1.0]
    certain = PointEstimate(recipe).init(KEY)
    s, a = (x.astype(jnp.float32) for x in a_point())
    np.testing.assert_array_equal(
        certain.sample(KEY)(s, a), certain.sample(jax.random.key(1))(s, a)
    )
    np.testing.assert_allclose(
        belief.point()(s, a), belief.latent(*a_point()).mean, rtol=1e-5
    )
