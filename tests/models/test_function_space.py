"""FS and RES-FS: the divergence, its training, and what a fit leaves behind."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from linear_system import Linear, linear, transitions
from sim2gp.errors import InputError, NotFinite
from sim2gp.inference.gaussian import Gaussian
from sim2gp.models import FunctionSpace, ResidualFunctionSpace, Sim2GP, features
from sim2gp.models import function_space as module
from sim2gp.models import function_space_loss as loss_module
from sim2gp.models import function_space_training as training
from sim2gp.models.function_space_loss import OBJECTIVES, Objective

P, D, M = 3, 2, 5
KEY = jax.random.key(0)
NIGHT = pytest.param(FunctionSpace, marks=pytest.mark.nightly)  # the same code


pytestmark = pytest.mark.usefixtures("float64")


def a_q(seed=0, m=M, outputs=D, dtype=jnp.float64):
    """A posterior layer over random features of three inputs, in double precision."""
    rng = np.random.default_rng(seed)
    network = features.Network.random(jax.random.key(seed), 3, (m - 1,))
    network = jax.tree.map(lambda x: x.astype(dtype), network)
    factor = np.tril(rng.standard_normal((outputs, m, m)))
    mean, noise = rng.standard_normal((outputs, m)), rng.uniform(-2, 0, outputs)
    arrays = (jnp.asarray(x, dtype) for x in (mean, factor, noise))
    return loss_module.Variational(network, *arrays)


def joint(q, X, noise):
    """``N(mu_q(X), V_q(X) + Se)``, dense, ordered by input then output."""
    Phi = np.asarray(jax.vmap(q.network)(X))
    b, d = len(X), q.mean.shape[0]
    cov = np.zeros((b, d, b, d))
    for k in range(d):
        L = np.tril(np.asarray(q.factor[k]))
        cov[:, k, :, k] = Phi @ L @ L.T @ Phi.T
    cov = cov.reshape(b * d, b * d) + np.diag(np.tile(np.asarray(noise) ** 2, b))
    return Gaussian(
        jnp.asarray((Phi @ np.asarray(q.mean).T).ravel()),
        jnp.asarray(np.linalg.cholesky(cov)),
    )


def a_target(b, seed=1, groups=2):
    """A pool of sets with its dense Gaussians; kept in double precision."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (groups * b, 3))
    mean, A = (
        rng.standard_normal((groups * b, D)),
        rng.standard_normal((groups * b, D, P)),
    )
    noise = np.array([0.3, 0.7])
    target = loss_module.targets(*(jnp.asarray(x) for x in (X, mean, A, noise)), b)
    dense = []
    for g in range(groups):
        rows = slice(g * b, (g + 1) * b)
        scale = np.concatenate(
            [A[rows].reshape(b * D, P), np.diag(np.tile(noise, b))], axis=1
        )
        dense.append(Gaussian(jnp.asarray(mean[rows].ravel()), jnp.asarray(scale)))
    return target, dense


@pytest.mark.parametrize("b", [1, 4])
def test_divergence_is_that_of_dense_gaussians(b):
    """Against `Gaussian.kl`; targets are stored in single precision."""
    q, (target, dense) = a_q(), a_target(b)
    noise = jnp.asarray([0.2, 0.5])
    for g in range(2):
        X = target.X[g].astype(float)
        # Inputs and means as stored: single precision.
        p = dataclasses.replace(dense[g], mean=target.mean[g].astype(float).ravel())
        expected = float(joint(q, X, noise).kl(p))
        exact = dataclasses.replace(
            target,
            X=target.X.astype(float),
            mean=target.mean.astype(float),
            whiten=target.whiten.astype(float),
        )
        got = float(loss_module.divergence(q, noise, exact, jnp.asarray(g)))
        assert got == pytest.approx(expected, rel=1e-5)
        assert got > 0.0


def test_divergence_vanishes_at_equality_and_only_there():
    """A target that is the layer's own process: zero to rounding, and a minimum."""
    q = a_q()
    X = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (4, 3)))
    noise = jnp.asarray([0.2, 0.5])
    p = joint(q, X, noise)
    inverse = jax.scipy.linalg.solve_triangular(p.scale, jnp.eye(8), lower=True)
    target = loss_module.Targets(
        X[None],
        p.mean.reshape(1, 4, D),
        inverse.reshape(1, 8, 4, D),
        jnp.sum(jnp.log(jnp.diag(p.scale)))[None],
    )

    def kl(q, noise):
        return loss_module.divergence(q, noise, target, jnp.asarray(0))

    assert abs(float(kl(q, noise))) <= 1e-12 * 8
    slope = jax.grad(kl)(q, noise)
    assert max(float(jnp.max(jnp.abs(g))) for g in jax.tree.leaves(slope)) <= 1e-9
    assert float(kl(q, 1.3 * noise)) > 1e-2


@pytest.mark.parametrize(
    "objective",
    [
        OBJECTIVES["recommended"],
        pytest.param(OBJECTIVES["literal"], marks=pytest.mark.nightly),
    ],
    ids=["recommended", "literal"],
)
@pytest.mark.nightly
def test_gradients_against_differences(objective):
    """Divergence and likelihood; the recommended comparison leaves the noise alone."""
    q, (target, _) = a_q(3), a_target(objective.sets)
    target = jax.tree.map(lambda x: x.astype(float), target)
    rng = np.random.default_rng(4)
    X, Y = jnp.asarray(rng.uniform(-1, 1, (6, 3))), jnp.asarray(rng.normal(size=(6, D)))
    valid = jnp.arange(6) < 5

    def loss(q):
        kl = loss_module.mean_divergence(q, target, objective, KEY)
        return 0.1 * kl - loss_module.expected_log_likelihood(q, X, Y, valid)

    def alone(q):
        return loss_module.mean_divergence(q, target, objective, KEY)

    slope = jax.grad(alone)(q).log_noise
    assert bool(jnp.all(slope == 0.0)) is not objective.own_noise

    leaves, tree = jax.tree.flatten(q)
    for function in (jax.jit(loss), jax.jit(alone)):
        grads = jax.tree.leaves(jax.grad(function)(q))
        steps = [1e-5 * rng.standard_normal(leaf.shape) for leaf in leaves]
        if not objective.own_noise:
            steps[-1] = np.zeros(D)  # differences would see the stopped gradient
        up, down = (
            tree.unflatten([x + sign * d for x, d in zip(leaves, steps, strict=True)])
            for sign in (1.0, -1.0)
        )
        got = sum(
            float(np.sum(np.asarray(g) * d)) for g, d in zip(grads, steps, strict=True)
        )
        difference = float(function(up) - function(down)) / 2.0
        assert got == pytest.approx(difference, rel=1e-6)


def test_expected_log_likelihood():
    """Against Monte Carlo's exact moments: a Gaussian's cross-entropy."""
    q = a_q(5)
    rng = np.random.default_rng(5)
    X, Y = rng.uniform(-1, 1, (4, 3)), rng.normal(size=(4, D))
    Phi = np.asarray(jax.vmap(q.network)(jnp.asarray(X)))
    sd, total = np.asarray(q.noise), 0.0
    for n in range(3):
        for k in range(D):
            L = np.tril(np.asarray(q.factor[k]))
            mean, V = Phi[n] @ np.asarray(q.mean[k]), np.sum((L.T @ Phi[n]) ** 2)
            total -= 0.5 * np.log(2 * np.pi * sd[k] ** 2)
            total -= 0.5 * ((Y[n, k] - mean) ** 2 + V) / sd[k] ** 2
    got = loss_module.expected_log_likelihood(
        q, jnp.asarray(X), jnp.asarray(Y), jnp.arange(4) < 3
    )
    assert float(got) == pytest.approx(total / 3, rel=1e-10)


def test_inputs_fill_the_box_and_surround_the_data():
    encoding = features.Encoding.of(linear(1, 1), {"x0": 2.0, "a0": 3.0})
    rows = transitions(np.full((4, 1, 1), 1.5), np.zeros((4, 1)))
    data = jax.tree.map(jnp.asarray, rows)
    S, A = loss_module.inputs(KEY, encoding, data, 6000)
    near = np.abs(np.asarray(A[:, 0]) - 1.5) < 0.9  # three sd of the jitter
    expected = 1 / 3 + 2 / 3 * 1.8 / 6.0
    assert np.mean(near) == pytest.approx(expected, abs=0.03)
    assert np.max(np.abs(S)) <= 2.0
    assert np.max(np.abs(A)) <= 3.0
    assert np.min(A) < -2.9
    none = dataclasses.replace(data, mask=jnp.zeros(4, bool))
    _, A = loss_module.inputs(KEY, encoding, none, 6000)
    assert np.mean(np.asarray(A)) == pytest.approx(0.0, abs=0.1)


def make(N, bent=1.0, seed=1, noise=0.1):
    rng = np.random.default_rng(seed)
    J = rng.uniform(-0.4, 0.4, (N, D, P))
    y = J @ np.array([0.7, -0.4, 1.1]) + noise * rng.standard_normal((N, D))
    y[:, 1] += bent * np.cos(3.0 * J[:, 0, 0])
    return J, y


def padded(J, y, capacity=512):
    data = transitions(J, y)
    empty = type(data).empty(capacity, D, D * P)
    return empty.extend(data.state, data.action, data.next_state)


def model(kind, **options):
    own = {"hidden": (12, 12), "steps": 600, "refit_steps": 300}
    if kind is FunctionSpace:
        own["pretrain"] = 600
    return kind(Sim2GP(linear(P, D), dt=1.0), **{**own, **options})


@pytest.fixture(scope="module", params=[NIGHT, ResidualFunctionSpace])
def fitted(request):
    with jax.enable_x64(True):
        recipe = model(request.param)
        data = padded(*make(400))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "POOL", 2048)
            fitted = recipe.fit(recipe.init(KEY), data, key=KEY)
        return recipe, data, fitted


def test_before_data_it_is_the_simulators_prior(fitted):
    recipe, _, after = fitted
    before, prior = recipe.init(KEY), recipe.sim.init(KEY)
    s, a = jnp.zeros(D), jnp.linspace(-0.5, 1.0, D * P)
    for which in ("latent", "predict"):
        g, h = getattr(before, which)(s, a), getattr(prior, which)(s, a)
        np.testing.assert_allclose(g.mean, h.mean, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(g.covariance(), h.covariance(), rtol=1e-12)
    assert jax.tree.structure(before) == jax.tree.structure(after)
    for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(after), strict=True):
        assert old.aval.strip_weak_type() == new.aval.strip_weak_type()
        assert old.weak_type == new.weak_type
    one, two = before.sample(KEY), after.sample(KEY)
    assert jax.tree.structure(one) == jax.tree.structure(two)
    assert {x.dtype for x in jax.tree.leaves((one, two))} == {jnp.dtype("float32")}


def test_it_learns_what_the_simulator_cannot(fitted):
    recipe, data, belief = fitted
    J, y = make(200, seed=9, noise=0.0)
    args = jnp.zeros((200, D)), jnp.asarray(J.reshape(200, -1))
    alone = recipe.sim.fit(recipe.sim.init(KEY), data, key=jax.random.split(KEY)[0])
    np.testing.assert_array_equal(belief.parameters()[0], alone.parameters()[0])
    got, without = (
        np.asarray(jax.vmap(lambda s, a, b=b: b.latent(s, a).mean)(*args))
        for b in (belief, alone)
    )
    errors = [np.sqrt(np.mean((x - y)[:, 1] ** 2)) for x in (got, without)]
    assert errors[0] < 0.6 * errors[1]
    assert np.all(np.asarray(belief.noise) > 0.04)


def between(belief, a, b, phi_a, phi_b):
    """Covariance of the changes at two inputs, of constants and layer, dense."""
    S = np.asarray(belief.physics.scale) * float(belief.keep)
    A, B = (np.asarray(x).reshape(D, P) @ S for x in (a, b))
    c, scale = np.asarray(belief.head.output_scale), np.asarray(belief.head.layer.scale)
    own = [x**2 * (phi_a @ L) @ (phi_b @ L) for x, L in zip(c, scale, strict=True)]
    return A @ B.T + np.diag(own)


def test_predictions_are_those_of_constants_and_layer(fitted):
    """Mean and variance at a point, from the belief's own arrays; draws likewise."""
    recipe, _, belief = fitted
    head = belief.head
    s, a = jnp.zeros(D), jnp.linspace(-0.3, 0.4, D * P)
    phi, c = np.asarray(head.phi(s, a)), np.asarray(head.output_scale)
    mean = c * (np.asarray(head.layer.mean) @ phi)
    if isinstance(recipe, ResidualFunctionSpace):
        tt = np.asarray(belief.sim.posterior.mean)
        mean = mean + np.asarray(a).reshape(D, P) @ tt
    covariance = between(belief, a, a, phi, phi)
    latent = belief.latent(s, a)
    np.testing.assert_allclose(latent.mean, mean, rtol=1e-9)
    np.testing.assert_allclose(latent.covariance(), covariance, rtol=1e-9, atol=1e-15)
    noise = np.asarray(belief.noise)
    scaled = np.eye(D) + covariance / np.outer(noise, noise)
    gain = 0.5 * np.linalg.slogdet(scaled)[1]
    assert float(belief.information_gain(s, a)) == pytest.approx(gain, rel=1e-9)

    @eqx.filter_jit
    def values(keys):
        x = s.astype(jnp.float32), a.astype(jnp.float32)
        return jax.lax.map(lambda k: belief.sample(k)(*x), keys, batch_size=1000)

    n = 10_000
    got = np.asarray(values(jax.random.split(KEY, n)), float)
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(got.mean(0) - mean) <= 4.5 * sd / np.sqrt(n) + 1e-6)
    np.testing.assert_allclose(got.std(0), sd, rtol=4.5 / np.sqrt(2 * n))
    x = s.astype(jnp.float32), a.astype(jnp.float32)
    np.testing.assert_allclose(belief.point()(*x), mean, rtol=1e-4)


def test_an_update_conditions_the_layer_alone(fitted):
    """The constants, where they are part of the function, wait for the next fit."""
    recipe, _, belief = fitted
    apart = np.asarray(belief.physics.covariance()) * float(belief.keep)
    s, a, s2 = jnp.zeros(D), jnp.linspace(-0.3, 0.4, D * P), jnp.asarray([0.2, -0.1])
    t, b = jnp.zeros(D), jnp.linspace(0.2, -0.4, D * P)
    later = eqx.filter_jit(recipe.update)(belief, s, a, s2)
    np.testing.assert_array_equal(later.physics.scale, belief.physics.scale)
    np.testing.assert_array_equal(later.physics.mean, belief.physics.mean)
    still = eqx.tree_at(lambda b: b.physics.scale, belief, replace_fn=jnp.zeros_like)
    noise = np.asarray(belief.noise)
    one, two = (np.asarray(belief.head.phi(*x)) for x in ((s, a), (t, b)))
    here = between(still, a, a, one, one) + np.diag(noise**2)
    gain = between(still, b, a, two, one) @ np.linalg.inv(here)
    expected = belief.latent(t, b).mean + gain @ (s2 - belief.latent(s, a).mean)
    left = between(still, b, b, two, two) - gain @ between(still, a, b, one, two)
    got = later.latent(t, b)
    np.testing.assert_allclose(got.mean, expected, rtol=1e-8)
    B = np.asarray(b).reshape(D, P)
    np.testing.assert_allclose(
        got.covariance(), left + B @ apart @ B.T, rtol=1e-7, atol=1e-12
    )
    # A later fit starts from that posterior in its own coordinates.
    q = training.starting_point(later, later.sim, later.head.output_scale, 0.3)
    L, S = np.asarray(q.factor, float), np.asarray(later.head.layer.scale)
    np.testing.assert_allclose(
        L @ L.swapaxes(1, 2), S @ S.swapaxes(1, 2), rtol=1e-4, atol=1e-6
    )
    np.testing.assert_array_equal(np.triu(L[0], 1), 0.0)


def test_before_the_first_fit_the_constants_learn():
    recipe = model(ResidualFunctionSpace)
    belief, sim = recipe.init(KEY), recipe.sim.init(KEY)
    s, a, s2 = jnp.zeros(D), jnp.linspace(-0.3, 0.4, D * P), jnp.asarray([0.2, -0.1])
    later, alone = recipe.update(belief, s, a, s2), recipe.sim.update(sim, s, a, s2)
    np.testing.assert_allclose(later.physics.mean, alone.posterior.mean, rtol=1e-8)
    got, expected = later.physics.covariance(), alone.posterior.covariance()
    np.testing.assert_allclose(got, expected, rtol=1e-8, atol=1e-12)


def test_growing_data_retrace_nothing(fitted):
    """Refits share the first fit's trace; the scale of a network's outputs stays."""
    recipe, _, belief = fitted
    traces = []
    inner = training.train

    def counted(*args):
        traces.append(1)
        return inner(*args)

    J, y = make(100)
    scales = [np.asarray(belief.head.output_scale)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "train", counted)
        for count in (20, 50):
            data = padded(J[:count], y[:count])
            belief = recipe.fit(belief, data, key=jax.random.key(count))
            scales.append(np.asarray(belief.head.output_scale))
    assert traces == []
    if isinstance(recipe, FunctionSpace):
        np.testing.assert_array_equal(scales[0], scales[-1])


def test_options_are_checked():
    sim = Sim2GP(linear(P, D))
    with pytest.raises(InputError, match=r"^E145 .*literal"):
        FunctionSpace(sim, objective="best")
    with pytest.raises(InputError, match=r"^E145 .*posterior"):
        FunctionSpace(sim, fs_prior="lagged")
    literal = FunctionSpace(sim, objective="literal")
    assert literal.pretrain == 0
    assert literal.objective == Objective(1.0, 1, True)


class Rooted(Linear):
    """A machine that is not defined for negative inputs."""

    def ode(self, params, s, a):
        return super().ode(params, s, a) + 0.0 * jnp.sqrt(a[0] + 0.9)


@pytest.mark.nightly
def test_a_simulator_that_is_nowhere_on_the_box_is_said(monkeypatch):
    """Else its scale becomes the noise, and training skips what it meets."""
    monkeypatch.setattr(module, "POOL", 2048)
    system = linear(P, D)
    recipe = FunctionSpace(
        Sim2GP(Rooted(system.parameters, D), dt=1.0),
        hidden=(8,),
        pretrain=100,
        steps=100,
    )
    with pytest.raises(NotFinite, match=r"E203 the simulator is not finite on its box"):
        recipe.fit(recipe.init(KEY), padded(*make(100)), key=KEY)
