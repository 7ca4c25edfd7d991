"""SIM2GP where the answer is known: a step that is linear in the constants."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from linear_system import linear, transitions
from oracles import exact
from oracles.hessian import full_hessian
from sim2gp.data.one_step import FLOOR
from sim2gp.data.transitions import Transitions
from sim2gp.errors import DeadParameters, NotFinite
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import PointEstimate, PriorMean, Sim2GP

P, D, N = 3, 2, 40
KEY = jax.random.key(0)
SYSTEM = linear(P, D)


pytestmark = pytest.mark.usefixtures("float64")


@dataclasses.dataclass
class Case:
    """A fitted belief beside its data (J (N, d, p), y (N, d)) and prior."""

    model: Sim2GP
    J: np.ndarray
    y: np.ndarray

    @property
    def data(self):
        return transitions(self.J, self.y)

    @property
    def prior(self):
        return np.asarray(self.model.prior.mean), np.asarray(self.model.prior.scale)


def make_case():
    rng = np.random.default_rng(1)
    scale = np.tril(0.5 * rng.standard_normal((P, P)), -1) + np.diag([0.7, 1.5, 0.3])
    prior = Gaussian(jnp.asarray(rng.standard_normal(P)), jnp.asarray(scale))
    J = rng.standard_normal((N, D, P)) * [0.5, 0.2, 1.0]
    tt = np.asarray(prior.mean) + scale @ rng.standard_normal(P)
    y = J @ tt + rng.standard_normal((N, D)) * [0.5, 1.5]
    return Case(Sim2GP(SYSTEM, dt=1.0, prior=prior), J, y)


@pytest.fixture(scope="module")
def case():
    with jax.enable_x64(True):
        return make_case()


@pytest.fixture(scope="module")
def belief(case):
    return case.model.fit(case.model.init(KEY), case.data, key=KEY)


def assert_exact(posterior, evidence, reference):
    assert reference.mean_error(np.asarray(posterior.mean)) <= 1e-10
    assert exact.cov_error(reference.cov, np.asarray(posterior.covariance())) <= 1e-10
    assert float(evidence) == pytest.approx(reference.log_evidence, rel=1e-9)


def test_laplace_is_exact_regression(case, belief):
    noise = np.diag(np.asarray(belief.noise))
    reference = exact.posterior(case.J, case.y, noise, *case.prior)
    assert_exact(belief.posterior, belief.log_evidence, reference)
    assert int(belief.count) == N
    # The information is that of the data alone, in the prior's coordinates.
    A = np.linalg.solve(noise, case.J @ case.prior[1]).reshape(-1, P)
    R = np.asarray(belief.information)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-10)


def regression(J, y, noise, mean, scale):
    """Textbook formulas, for parts that need no more digits."""
    white = (J / noise[:, None]).reshape(-1, J.shape[2])
    S0 = scale @ scale.T
    cov = np.linalg.inv(np.linalg.inv(S0) + white.T @ white)
    right = np.linalg.solve(S0, mean) + white.T @ (y / noise).ravel()
    return cov @ right, cov


def test_noise_follows_expectation_maximisation(case, belief):
    """sig^2 = (2 floor^2 + sum r^2 + (J Sq J^T)) / (2 + N), from the rms change."""
    change = np.sqrt(np.mean(case.y**2, axis=0))
    noise = change
    for _ in range(40):  # to its fixed point
        mean, cov = regression(case.J, case.y, noise, *case.prior)
        r = case.J @ mean - case.y
        spread = np.einsum("ndi,ij,ndj->d", case.J, cov, case.J)
        prior = 2 * (FLOOR * change) ** 2
        noise = np.sqrt((prior + np.sum(r**2, axis=0) + spread) / (2 + N))
    np.testing.assert_allclose(belief.noise, noise, rtol=1e-6)


def test_weight_space_is_function_space(case, belief):
    """The same predictions from the kernel J S0 J^T, an (N d)-dimensional inverse."""
    rng = np.random.default_rng(2)
    mean, scale = case.prior
    X = case.J.reshape(-1, P)
    S0 = scale @ scale.T
    K = X @ S0 @ X.T + np.diag(np.tile(np.asarray(belief.noise) ** 2, N))
    right = case.y.ravel() - X @ mean
    for _ in range(3):
        A = rng.standard_normal((D, P))
        cross = A @ S0 @ X.T
        expected = A @ mean + cross @ np.linalg.solve(K, right)
        cov = A @ S0 @ A.T - cross @ np.linalg.solve(K, cross.T)
        got = belief.latent(jnp.zeros(D), jnp.asarray(A.ravel()))
        np.testing.assert_allclose(got.mean, expected, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(got.covariance(), cov, rtol=1e-9, atol=1e-12)


def test_predictive_has_the_noise(belief):
    s, a = jnp.ones(D), jnp.linspace(-1, 1, D * P)
    latent, predictive = belief.latent(s, a), belief.predict(s, a)
    np.testing.assert_array_equal(latent.mean, predictive.mean)
    A = np.asarray(a).reshape(D, P)
    mean = np.asarray(s) + A @ np.asarray(belief.posterior.mean)
    np.testing.assert_allclose(latent.mean, mean, rtol=1e-12)
    extra = predictive.covariance() - latent.covariance()
    np.testing.assert_allclose(extra, np.diag(belief.noise**2), atol=1e-13)


def test_update_is_the_refit(case):
    """One transition after another, from the prior, at unit noise: the batch."""
    belief = eqx.tree_at(lambda b: b.noise, case.model.init(KEY), jnp.ones(D))
    step = eqx.filter_jit(case.model.update)
    zero = jnp.zeros(D)
    for J, y in zip(case.J, case.y, strict=True):
        belief = step(belief, zero, jnp.asarray(J.ravel()), jnp.asarray(y))
    reference = exact.posterior(case.J, case.y, np.eye(D), *case.prior)
    assert_exact(belief.posterior, belief.log_evidence, reference)
    assert int(belief.count) == N
    A = (case.J @ case.prior[1]).reshape(-1, P)
    R = np.asarray(belief.information)
    np.testing.assert_allclose(R.T @ R, A.T @ A, rtol=1e-10)


def test_data_sets_one_after_another(case):
    """The posterior as the next prior (the noise is learned anew from each set)."""
    half = N // 2
    first, second = (
        dataclasses.replace(case, J=case.J[i], y=case.y[i])
        for i in (slice(half), slice(half, N))
    )
    one = case.model.fit(case.model.init(KEY), first.data, key=KEY)
    model = case.model.with_prior(one.posterior)
    two = model.fit(model.init(KEY), second.data, key=KEY)
    noise = [np.asarray(b.noise) for b in (one, two)]
    # The whole in one regression, each half with its own noise.
    J = np.concatenate([first.J / noise[0][:, None], second.J / noise[1][:, None]])
    y = np.concatenate([first.y / noise[0], second.y / noise[1]])
    reference = exact.posterior(J, y, np.eye(D), *case.prior)
    assert reference.mean_error(np.asarray(two.posterior.mean)) <= 1e-10
    cov = np.asarray(two.posterior.covariance())
    assert exact.cov_error(reference.cov, cov) <= 1e-10


def test_rows_that_do_not_exist_do_not_count(case, belief):
    """Room to grow, filled with anything, changes nothing."""
    roomy = case.data.extend(np.zeros((1, D)), np.zeros((1, D * P)), np.ones((1, D)))
    mask = np.arange(len(roomy.mask)) < N
    junk = [np.where(mask[:, None], x, np.nan) for x in (roomy.state, roomy.next_state)]
    data = dataclasses.replace(roomy, state=junk[0], next_state=junk[1], mask=mask)
    got = case.model.fit(case.model.init(KEY), data, key=KEY)
    error = np.abs(got.posterior.mean - belief.posterior.mean) / belief.posterior.sd()
    assert np.max(error) <= 1e-9
    assert float(got.log_evidence) == pytest.approx(float(belief.log_evidence))


def test_no_data_give_the_prior(case):
    empty = Transitions.empty(N, D, D * P)
    belief = case.model.fit(case.model.init(KEY), empty, key=KEY)
    mean, scale = case.prior
    np.testing.assert_allclose(belief.posterior.mean, mean, rtol=1e-12)
    cov = belief.posterior.covariance()
    np.testing.assert_allclose(cov, scale @ scale.T, rtol=1e-12, atol=1e-15)


def test_draws_have_the_moments_of_the_belief(belief):
    """50,000 functions at two inputs: mean, covariance, cross-covariance."""
    rng, n = np.random.default_rng(4), 50_000
    A = rng.standard_normal((2, D, P))
    zero = jnp.zeros(D, jnp.float32)
    inputs = jnp.asarray(A.reshape(2, -1), jnp.float32)

    @jax.jit
    @jax.vmap
    def values(key):
        f = belief.sample(key)
        return jnp.concatenate([f(zero, a) for a in inputs])

    got = np.asarray(values(jax.random.split(KEY, n)), float)
    both = A.reshape(2 * D, P)
    S = np.asarray(belief.posterior.covariance())
    mean, cov = both @ np.asarray(belief.posterior.mean), both @ S @ both.T
    sd = np.sqrt(np.diag(cov))
    assert np.all(np.abs(got.mean(0) - mean) <= 4.5 * sd / np.sqrt(n) + 1e-6)
    se = np.sqrt((np.outer(sd, sd) ** 2 + cov**2) / n)
    assert np.all(np.abs(np.cov(got.T) - cov) <= 4.5 * se + 1e-6)


def test_a_draw_is_one_function_in_single_precision(belief):
    draw = belief.sample(KEY)
    assert {x.dtype for x in jax.tree.leaves(draw)} == {jnp.dtype("float32")}
    s, a = jnp.zeros(D, jnp.float32), jnp.ones(D * P, jnp.float32)
    np.testing.assert_array_equal(draw(s, a), draw(s, a))
    np.testing.assert_array_equal(draw(s, a), belief.sample(KEY)(s, a))
    other = belief.sample(jax.random.key(1))
    assert not np.array_equal(draw(s, a), other(s, a))


def test_information_gain_identities(case, belief):
    """Entropy of the prediction minus the noise's; logdets; a telescoping sum."""
    rng = np.random.default_rng(6)
    S, A = jnp.zeros((5, D)), jnp.asarray(rng.standard_normal((5, D * P)))
    A = A.at[3].set(A[0])  # seen already
    noise = Gaussian(jnp.zeros(D), jnp.diag(belief.noise))
    total, later = 0.0, belief
    update = eqx.filter_jit(case.model.update)
    for a in A:
        gain = float(later.information_gain(S[0], a))
        entropy = later.predict(S[0], a).entropy() - noise.entropy()
        assert gain == pytest.approx(float(entropy), rel=1e-9)
        assert gain > 0.0
        total += gain
        later = update(later, S[0], a, jnp.ones(D))
    joint = float(belief.trajectory_information_gain(S, A))
    assert joint == pytest.approx(total, rel=1e-9)
    ratio = np.linalg.slogdet(belief.posterior.covariance())[1]
    ratio -= np.linalg.slogdet(later.posterior.covariance())[1]
    assert joint == pytest.approx(0.5 * ratio, rel=1e-9)
    alone = sum(float(belief.information_gain(S[0], a)) for a in A)
    assert joint < alone
    assert float(belief.information_gain(S[0], jnp.zeros(D * P))) == 0.0
    # Monotone in the trajectory's length.
    parts = [float(belief.trajectory_information_gain(S[:k], A[:k])) for k in (1, 2, 3)]
    assert parts == sorted(parts)


def test_evidence_against_quadrature():
    """One boxed parameter: nonlinear, so Laplace; within 2 % of the integral."""
    model = Sim2GP(linear(1, 1, "bounded", low=-1.0, high=3.0), dt=1.0)
    rng = np.random.default_rng(7)
    J = rng.standard_normal((60, 1, 1))
    y = 0.4 * J[:, :, 0] + 0.3 * rng.standard_normal((60, 1))
    belief = model.fit(model.init(KEY), transitions(J, y), key=KEY)
    sd = float(belief.noise[0])
    likelihood = scipy.stats.norm(scale=sd)
    peak = float(belief.log_evidence)

    def density(tt):
        theta = -1.0 + 4.0 / (1.0 + np.exp(-tt))
        value = np.sum(likelihood.logpdf(y[:, 0] - theta * J[:, 0, 0]))
        return np.exp(value + scipy.stats.norm.logpdf(tt) - peak)

    integral = scipy.integrate.quad(density, -3, 3, epsrel=1e-10, limit=500)[0]
    assert integral == pytest.approx(1.0, abs=0.02)


def test_the_precision_is_gauss_newtons():
    """With residuals of order one the full Hessian differs: it is a diagnostic."""
    model = Sim2GP(linear(2, 1, "bounded", low=-1.0, high=3.0), dt=1.0)
    rng = np.random.default_rng(8)
    J = rng.standard_normal((25, 1, 2))
    y = 1.5 * J[:, :, 0] ** 2 + 2.4 * J[:, :, 1]  # a model that does not fit
    data = transitions(J, y)
    belief = model.fit(model.init(KEY), data, key=KEY)
    tt, noise = np.asarray(belief.posterior.mean), float(belief.noise[0])
    sigmoid = 1 / (1 + np.exp(-tt))
    slope = J[:, 0] * 4.0 * sigmoid * (1 - sigmoid) / noise
    ggn = np.eye(2) + slope.T @ slope
    np.testing.assert_allclose(
        np.linalg.inv(belief.posterior.covariance()), ggn, rtol=1e-8
    )
    r = (J[:, 0] @ (-1.0 + 4.0 * sigmoid) - y[:, 0]) / noise
    curved = 4.0 * sigmoid * (1 - sigmoid) * (1 - 2 * sigmoid)
    full = ggn + np.diag(r @ (J[:, 0] / noise) * curved)
    got = np.asarray(full_hessian(belief, data))
    np.testing.assert_allclose(got, full, rtol=1e-8, atol=1e-8)
    assert np.max(np.abs(full / ggn - 1.0)) > 0.02


def test_point_estimate_and_prior_mean(case, belief):
    data, s, a = case.data, jnp.zeros(D), jnp.ones(D * P)
    point, mean = PointEstimate(case.model), PriorMean(case.model)
    s32, a32 = s.astype(jnp.float32), a.astype(jnp.float32)
    fitted = point.fit(point.init(KEY), data, key=KEY)
    one, two = (fitted.sample(jax.random.key(k)) for k in (1, 2))
    np.testing.assert_array_equal(one(s32, a32), two(s32, a32))
    np.testing.assert_allclose(one(s32, a32), belief.latent(s, a).mean, rtol=1e-5)
    np.testing.assert_allclose(
        fitted.predict(s, a).covariance(), belief.predict(s, a).covariance()
    )
    assert float(fitted.information_gain(s, a)) == 0.0
    start = mean.init(KEY)
    assert mean.fit(start, data, key=KEY) is start
    assert mean.update(start, s, a, s) is start
    expected = case.model.init(KEY).latent(s, a).mean
    np.testing.assert_allclose(start.sample(KEY)(s32, a32), expected, rtol=1e-5)


def test_no_excitation_is_said(case):
    dead = transitions(0.0 * case.J, case.y)
    with pytest.raises(DeadParameters, match=r"E146.*k0, k1, k2"):
        case.model.fit(case.model.init(KEY), dead, key=KEY)


def test_data_that_are_not_finite_are_said(case):
    broken = transitions(case.J, np.where(np.arange(N)[:, None] == 3, np.nan, case.y))
    with pytest.raises(NotFinite):
        case.model.fit(case.model.init(KEY), broken, key=KEY)


def test_data_without_noise_are_fitted():
    """What a first try on simulated data looks like; the truth, to many digits."""
    rng = np.random.default_rng(3)
    J, truth = rng.uniform(-1.0, 1.0, (5000, D, P)), np.asarray([0.3, 0.6, 1.0])
    model = Sim2GP(SYSTEM, dt=1.0)
    belief = model.fit(model.init(KEY), transitions(J, J @ truth), key=KEY)
    np.testing.assert_allclose(belief.posterior.mean, truth, rtol=1e-8)
    assert np.all(np.asarray(belief.posterior.sd()) < 1e-6)
