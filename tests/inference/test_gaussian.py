"""`Gaussian` against scipy's densities, closed forms and moments of draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from sim2gp.errors import InputError
from sim2gp.inference.gaussian import (
    Gaussian,
    from_covariance,
    log_det_factor,
    lower_factor,
)

RNG = np.random.default_rng(0)
MEAN = RNG.standard_normal(3)
SCALE = RNG.standard_normal((3, 5))  # wider than the dimension
COV = SCALE @ SCALE.T


pytestmark = pytest.mark.usefixtures("float64")


@pytest.fixture
def x():
    return Gaussian(jnp.asarray(MEAN), jnp.asarray(SCALE))


def test_moments(x):
    np.testing.assert_allclose(x.covariance(), COV, rtol=1e-14)
    np.testing.assert_array_equal(x.covariance(), x.covariance().T)
    np.testing.assert_allclose(x.sd(), np.sqrt(np.diag(COV)), rtol=1e-14)


def test_density(x):
    reference = scipy.stats.multivariate_normal(MEAN, COV)
    for point in RNG.standard_normal((10, 3)) * 3:
        got = float(x.log_prob(jnp.asarray(point)))
        assert got == pytest.approx(reference.logpdf(point), rel=1e-11)
    assert float(x.entropy()) == pytest.approx(reference.entropy(), rel=1e-12)


def test_divergence(x):
    other = Gaussian(jnp.asarray(MEAN + 0.5), jnp.asarray(np.diag([1.0, 2.0, 0.7])))
    C = np.diag([1.0, 4.0, 0.49])
    e = np.full(3, 0.5)
    expected = np.trace(np.linalg.solve(C, COV)) + e @ np.linalg.solve(C, e) - 3
    expected += np.linalg.slogdet(C)[1] - np.linalg.slogdet(COV)[1]
    assert float(x.kl(other)) == pytest.approx(0.5 * expected, rel=1e-12)
    assert abs(float(x.kl(x))) <= 1e-12
    assert float(other.kl(x)) > 0.0
    # Any square root of the same covariance is the same distribution.
    turn = np.linalg.qr(RNG.standard_normal((5, 5)))[0]
    assert abs(float(x.kl(Gaussian(x.mean, jnp.asarray(SCALE @ turn))))) <= 1e-12


def test_push_and_plus(x):
    A, b = jnp.asarray(RNG.standard_normal((2, 3))), jnp.asarray([1.0, -2.0])
    pushed = x.push(A, b)
    np.testing.assert_allclose(pushed.mean, A @ MEAN + b, rtol=1e-14)
    np.testing.assert_allclose(pushed.covariance(), A @ COV @ A.T, rtol=1e-13)
    noise = np.array([[0.3, 0.0], [0.1, 0.2]])
    noisy = pushed.plus(jnp.asarray(noise)).covariance()
    np.testing.assert_allclose(noisy, A @ COV @ A.T + noise @ noise.T, rtol=1e-13)


def test_draws(x):
    n = 50_000
    keys = jax.random.split(jax.random.key(1), n)
    z = np.asarray(jax.vmap(x.sample)(keys)) - MEAN
    assert np.all(np.abs(z.mean(0)) <= 4.5 * np.sqrt(np.diag(COV) / n))
    se = np.sqrt((np.outer(np.diag(COV), np.diag(COV)) + COV**2) / n)
    assert np.all(np.abs(z.T @ z / n - COV) <= 4.5 * se)


def test_triangular_factor(x):
    L = np.asarray(x.triangular())
    np.testing.assert_allclose(L, np.linalg.cholesky(COV), rtol=1e-12, atol=1e-14)
    assert np.all(L[np.triu_indices(3, 1)] == 0.0)
    turned = np.asarray(lower_factor(-jnp.asarray(SCALE)))
    assert np.all(np.diag(turned) > 0.0)
    expected = 0.5 * np.linalg.slogdet(COV)[1]
    assert float(log_det_factor(-jnp.asarray(L))) == pytest.approx(expected)


def test_a_singular_covariance_has_draws_and_no_density():
    x = Gaussian(jnp.zeros(3), jnp.asarray(SCALE[:, :2]))
    assert np.linalg.matrix_rank(np.asarray(x.covariance())) == 2
    assert x.sample(jax.random.key(0)).shape == (3,)
    for density in (x.entropy, lambda: x.log_prob(x.mean), lambda: x.kl(x)):
        with pytest.raises(ValueError, match="singular; add noise"):
            density()


def test_single_precision_stays_single():
    with jax.enable_x64(False):
        x = Gaussian(jnp.zeros(2), jnp.eye(2))
        for leaf in (x.sample(jax.random.key(0)), x.covariance(), x.entropy()):
            assert leaf.dtype == jnp.float32


def test_a_covariance_of_another_tool():
    """The same covariance, of full rank or not, in any units; or E143."""
    rng = np.random.default_rng(0)
    for rank in (4, 2):
        root = rng.standard_normal((4, rank)) * np.asarray(
            [[1e-9], [1.0], [1e3], [2.0]]
        )
        given = from_covariance(np.arange(4.0), root @ root.T)
        np.testing.assert_array_equal(given.mean, np.arange(4.0))
        sd = np.sqrt(np.diag(root @ root.T))
        wrong = (np.asarray(given.covariance()) - root @ root.T) / np.outer(sd, sd)
        assert np.abs(wrong).max() < 1e-14
    fixed = from_covariance(np.zeros(2), np.diag([0.0, 4.0]))
    np.testing.assert_allclose(fixed.sd(), [0.0, 2.0], atol=1e-15)
    for matrix, where in (
        (np.diag([1.0, -1e-6]), "length"),
        (np.asarray([[1.0, np.nan], [np.nan, 1.0]]), "mass, length"),
        (np.asarray([[1.0, 1.1], [1.1, 1.0]]), "eigenvalue of -0.1"),
        (np.asarray([[0.0, 0.5], [0.5, 1.0]]), "eigenvalue"),
    ):
        with pytest.raises(InputError, match=f"E143 .*{where}"):
            from_covariance(np.zeros(2), matrix, ("mass", "length"))
    with pytest.raises(InputError, match=r"E143 .*mean nan"):
        from_covariance(np.asarray([0.0, np.nan]), np.eye(2))
