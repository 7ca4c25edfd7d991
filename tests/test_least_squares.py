"""Descents: stationary points, the best of several starts, and typed verdicts (S14)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import least_squares as ls
from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.gaussian import Gaussian


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def rosenbrock(z):
    """Residuals with a curved valley; the prior's own rows come on top."""
    return jnp.stack([10.0 * (z[1] - z[0] ** 2), 1.0 - z[0]]) / 0.05


def factor_of(residual):
    """What `minimise` wants of a residual function."""
    return lambda z: (ls.factor(jax.jacfwd(residual)(z), residual(z)), ())


def test_the_map_is_a_stationary_point():
    residual = rosenbrock
    start = jnp.asarray([-1.2, 1.0])
    fit = jax.jit(lambda z: ls.minimise(factor_of(residual), z))(start)
    gradient = jax.grad(lambda z: 0.5 * jnp.sum(residual(z) ** 2) + 0.5 * z @ z)(fit.z)
    cost = 0.5 * float(jnp.sum(residual(fit.z) ** 2) + fit.z @ fit.z)
    assert int(fit.status) == ls.CONVERGED
    assert float(jnp.max(jnp.abs(gradient))) <= 1e-8 * (1.0 + cost)
    assert float(fit.cost) == pytest.approx(cost, rel=1e-12)
    assert float(fit.gradient) <= ls.GRADIENT_TOLERANCE
    # Gauss-Newton, not the full Hessian, is the precision.
    J = jax.jacfwd(residual)(fit.z)
    np.testing.assert_allclose(fit.R.T @ fit.R, J.T @ J + jnp.eye(2), rtol=1e-10)
    np.testing.assert_allclose(
        fit.scale() @ fit.scale().T, np.linalg.inv(J.T @ J + np.eye(2)), rtol=1e-9
    )


def test_laplace_terms_of_the_evidence():
    """log_joint = -1/2 |r|^2 - 1/2 |z|^2 - 1/2 logdet(I + J^T J)."""
    fit = ls.minimise(factor_of(rosenbrock), jnp.asarray([0.5, 0.2]))
    r, J = rosenbrock(fit.z), jax.jacfwd(rosenbrock)(fit.z)
    expected = -0.5 * (r @ r + fit.z @ fit.z)
    expected -= 0.5 * jnp.linalg.slogdet(jnp.eye(2) + J.T @ J)[1]
    assert float(fit.log_joint()) == pytest.approx(float(expected), rel=1e-10)


def test_the_polish_finishes_what_the_descent_left():
    """A coarse descent stops at 1e-2; the QR steps bring the gradient to rounding."""

    def residual(z):
        return 30.0 * jnp.stack([jnp.sin(z[0]) - 0.3, z[0] * z[1] - 0.1, z[1] - 0.4])

    fit = ls.minimise(factor_of(residual), jnp.zeros(2), tolerance=1e-3)
    assert float(fit.gradient) <= 1e-8
    far = ls.polish(factor_of(residual), fit.z + 1e-3, jnp.zeros((), int))
    assert float(jnp.max(jnp.abs(far.z - fit.z))) <= 1e-8
    assert int(far.status) == ls.CONVERGED


def no_update(fit, noise):
    return noise


def multi_start(residual, starts, rounds=0, update=no_update, noise=1.0):
    return ls.multi_start(
        lambda z, noise: factor_of(lambda z: residual(z) / noise)(z),
        jnp.asarray(starts),
        jnp.asarray(noise),
        update,
        rounds=rounds,
        searches=rounds,
    )


def test_a_start_that_is_not_finite_never_wins():
    def residual(z):
        return jnp.where(z > 3.0, jnp.nan, 5.0 * (z - 1.0))

    fit, _, costs = multi_start(residual, [[4.0], [0.0], [5.0]])
    assert float(fit.z[0]) == pytest.approx(25.0 / 26.0)
    assert not np.isfinite(costs[0])
    assert int(fit.status) == ls.CONVERGED
    fit.raise_unless_converged(("k",), "here")


def test_nothing_finite_is_a_typed_error():
    fit, _, _ = multi_start(lambda z: z * jnp.nan, [[0.0], [1.0]])
    assert int(fit.status) == ls.NOT_FINITE
    with pytest.raises(NotFinite, match="E203"):
        fit.raise_unless_converged(("k",), "here")


def test_the_best_of_several_descents_wins():
    def residual(z):
        return jnp.stack([20.0 * (z[0] ** 2 - 4.0), 1.0 * (z[0] - 2.0)])

    fit, _, costs = multi_start(residual, [[-3.0], [3.0], [-1.0]])
    assert float(fit.z[0]) == pytest.approx(2.0, abs=0.01)
    assert float(fit.cost) == pytest.approx(float(jnp.min(costs)), rel=1e-12)


def test_dead_parameters_are_named():
    """mujoco#3286: zero iterations at a zero gradient is no success."""
    fit, _, _ = multi_start(lambda z: jnp.stack([0.0 * z @ z - 1.0]), [[1.0, 1.0]])
    assert bool(jnp.all(fit.dead))
    with pytest.raises(DeadParameters, match=r"E146.*mass, length"):
        fit.raise_unless_converged(("mass", "length"), "here")


def test_one_dead_parameter_keeps_its_prior():
    fit, _, _ = multi_start(lambda z: jnp.stack([4.0 * z[0] - 1.0]), [[1.0, 1.0]])
    np.testing.assert_array_equal(fit.dead, [False, True])
    fit.raise_unless_converged(("mass", "length"), "here")
    prior = Gaussian(jnp.asarray([0.0, 3.0]), jnp.diag(jnp.asarray([1.0, 2.0])))
    posterior = fit.posterior(prior)
    assert float(posterior.mean[1]) == pytest.approx(3.0, abs=1e-10)
    assert float(posterior.sd()[1]) == pytest.approx(2.0, rel=1e-10)


def test_a_stalled_descent_is_a_typed_error():
    # A kink: no stationary point exists where the descent ends.
    fit = ls.minimise(factor_of(lambda z: 100.0 * jnp.abs(z - 0.3) ** 0.6), jnp.ones(1))
    assert int(fit.status) != ls.CONVERGED
    with pytest.raises((NotConverged, NotFinite)):
        fit.raise_unless_converged(("k",), "here")


def test_noise_rounds_follow_their_update():
    """EM: after every update the descent starts from the best point so far."""
    y = jnp.asarray([1.0, 1.4, 0.7, 1.2])

    def update(fit, noise):
        r = fit.z[0] - y
        return jnp.sqrt(jnp.mean(r**2) + fit.scale()[0, 0] ** 2)

    fit, noise, _ = multi_start(
        lambda z: z[0] - y, [[0.0], [1.0]], rounds=60, update=update
    )
    # The fixed point, by scalar iteration.
    v = 1.0
    for _ in range(500):
        s = 1.0 / (1.0 + 4.0 / v)
        z = s * float(jnp.sum(y)) / v
        v = float(jnp.mean((z - y) ** 2)) + s
    assert float(noise) == pytest.approx(np.sqrt(v), rel=1e-8)
    assert float(fit.z[0]) == pytest.approx(z, rel=1e-8)


def test_slow_convergence_is_awaited():
    """Where the Gauss-Newton step contracts by 0.93 only, thirty steps do not do."""

    def residual(z):
        return 0.93 * 0.5 * z**2 - 1.0  # Hessian 0.07, Gauss-Newton 1, at z = 0

    fit = ls.polish(factor_of(residual), jnp.asarray([1e-2]), jnp.zeros((), int))
    assert int(fit.status) == ls.CONVERGED
    assert float(fit.gradient) <= 1e-8
