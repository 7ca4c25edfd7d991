"""Descents: stationary points, the best of several starts, and typed verdicts (S14)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import descents
from descents import Curves, curves, some_noise, stacked, whitened
from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.inference import estimate as estimates
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import CONVERGED, NEAR, NOT_FINITE
from sim2gp.inference.descent import TRUST, Learning, Scales
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.laplace import expected_noise
from sim2gp.inference.levenberg_marquardt import GRADIENT_TOLERANCE

pytestmark = pytest.mark.usefixtures("float64")


def rosenbrock(z):
    """Residuals with a curved valley; the prior's own rows come on top."""
    return jnp.stack([10.0 * (z[1] - z[0] ** 2), 1.0 - z[0]]) / 0.05


NOTHING = (1, 0)  # windows and nuisances


def unit():
    return Noise(jnp.ones(1), jnp.ones(1))


def minimise(residual, start):
    """A descent without nuisances, of residuals that are already whitened."""
    return descents.minimise(whitened(residual), start, jnp.zeros(NOTHING), unit())


def test_the_map_is_a_stationary_point():
    residual = rosenbrock
    start = jnp.asarray([-1.2, 1.0])
    fit = jax.jit(lambda z: minimise(residual, z))(start)
    gradient = jax.grad(lambda z: 0.5 * jnp.sum(residual(z) ** 2) + 0.5 * z @ z)(fit.z)
    cost = 0.5 * float(jnp.sum(residual(fit.z) ** 2) + fit.z @ fit.z)
    assert int(fit.ended.status) == CONVERGED
    assert float(jnp.max(jnp.abs(gradient))) <= 1e-8 * (1.0 + cost)
    assert float(fit.cost) == pytest.approx(cost, rel=1e-12)
    assert float(fit.ended.gradient) <= GRADIENT_TOLERANCE
    # Gauss-Newton, not the full Hessian, is the precision.
    J = jax.jacfwd(residual)(fit.z)
    np.testing.assert_allclose(
        fit.about.R.T @ fit.about.R, J.T @ J + jnp.eye(2), rtol=1e-10
    )
    np.testing.assert_allclose(
        fit.about.scale() @ fit.about.scale().T,
        np.linalg.inv(J.T @ J + np.eye(2)),
        rtol=1e-9,
    )


def test_laplace_terms_of_the_evidence():
    """log_joint = -1/2 |r|^2 - 1/2 |z|^2 - 1/2 logdet(I + J^T J)."""
    fit = minimise(rosenbrock, jnp.asarray([0.5, 0.2]))
    r, J = rosenbrock(fit.z), jax.jacfwd(rosenbrock)(fit.z)
    expected = -0.5 * (r @ r + fit.z @ fit.z)
    expected -= 0.5 * jnp.linalg.slogdet(jnp.eye(2) + J.T @ J)[1]
    assert float(fit.about.log_joint()) == pytest.approx(float(expected), rel=1e-10)


def test_the_last_turn_goes_on_to_a_zero_gradient():
    """Starts are compared where they are roughly finished; the best is followed."""

    def residual(z):
        return 30.0 * jnp.stack([jnp.sin(z[0]) - 0.3, z[0] * z[1] - 0.1, z[1] - 0.4])

    fit = multi_start(residual, [[0.0, 0.0], [1.0, 1.0]])
    assert float(jnp.min(fit.costs[:2])) > float(fit.cost) * (1.0 + 1e-9)
    assert float(fit.ended.gradient) <= 1e-8
    assert int(fit.ended.status) == CONVERGED
    again = minimise(residual, fit.z + 1e-3)
    assert float(jnp.max(jnp.abs(again.z - fit.z))) <= 1e-8


def test_a_gradient_that_is_small_next_to_a_large_cost_is_followed():
    """The last turn takes two steps at least."""

    def residual(z):
        return jnp.stack([jnp.asarray(1e5), z[0] - 1.0])

    fit = minimise(residual, jnp.zeros(1))
    assert float(fit.z[0]) == pytest.approx(0.5)


def multi_start(residual, starts, learning=descents.NOTHING):
    start = jnp.asarray(starts), jnp.zeros(NOTHING), unit()
    return descents.descend(whitened(residual), *start, learning)


def test_a_start_that_is_no_number_costs_nothing():
    """Padded to more starts, a descent is the same; no simulator runs."""
    seen = []

    def watched(z):
        jax.debug.callback(lambda z: seen.append(np.asarray(z)), z)
        return rosenbrock(z)

    one = multi_start(rosenbrock, [[-1.2, 1.0], [0.5, 0.5]])
    two = multi_start(watched, [[-1.2, 1.0], [np.nan, np.nan], [0.5, 0.5]])
    jax.effects_barrier()
    assert seen
    assert np.isfinite(seen).all()
    np.testing.assert_array_equal(two.z, one.z)
    assert int(two.ended.steps) == int(one.ended.steps)
    assert np.isinf(two.costs[1])


def test_a_start_that_is_not_finite_never_wins():
    def residual(z):
        return jnp.where(z > 3.0, jnp.nan, 5.0 * (z - 1.0))

    fit = multi_start(residual, [[4.0], [0.0], [5.0]])
    assert float(fit.z[0]) == pytest.approx(25.0 / 26.0)
    assert not np.isfinite(fit.costs[0])
    assert int(fit.ended.status) == CONVERGED
    fit.ended.check(("k",), "here")


def test_nothing_finite_is_a_typed_error():
    fit = multi_start(lambda z: z * jnp.nan, [[0.0], [1.0]])
    assert int(fit.ended.status) == NOT_FINITE
    with pytest.raises(NotFinite, match="E203"):
        fit.ended.check(("k",), "here")


def test_steps_whose_gain_rounding_hides_are_not_tried_for_ever():
    """Derivatives with an error of their own, as differences on the host have it."""

    def residual(z):
        exact = 30.0 * jnp.stack([jnp.sin(z[0]) - 0.3, z[0] * z[1] - 0.1, z[1] - 0.4])
        error = 1e-6 * jnp.sin(1e12 * jax.lax.stop_gradient(z)) * z
        return exact + (error - jax.lax.stop_gradient(error))[jnp.asarray([0, 1, 1])]

    fit = multi_start(residual, [[0.0, 0.0]])
    assert int(fit.ended.status) == CONVERGED
    assert float(fit.ended.gradient) > 1e-9
    assert int(fit.ended.steps) <= 20


def test_the_best_of_several_descents_wins():
    def residual(z):
        return jnp.stack([20.0 * (z[0] ** 2 - 4.0), 1.0 * (z[0] - 2.0)])

    fit = multi_start(residual, [[-3.0], [3.0], [-1.0]])
    assert float(fit.z[0]) == pytest.approx(2.0, abs=0.01)
    assert float(fit.cost) == pytest.approx(float(jnp.min(fit.costs)), rel=1e-12)


def test_a_start_that_goes_where_the_best_one_is_is_not_followed():
    """It costs two evaluations, not a descent; one that goes elsewhere is followed."""

    def steps(*starts):
        return int(multi_start(two_valleys, [*starts]).ended.steps)

    def two_valleys(z):
        return jnp.stack([20.0 * (z[0] ** 2 - 4.0), 1.0 * (z[0] - 2.0)])

    two = steps([3.0], [-5.0])
    assert steps([3.0], [2.0005], [-5.0]) <= two + 2
    assert two > steps([3.0], [2.0005]) + 2


def test_a_curved_valley_is_followed_by_pairs_of_steps():
    """A step off the floor is followed by one that leads back: 8 steps, else 200."""

    def valley(z):
        return jnp.stack([1e3 * (z[1] - z[0] ** 2), 1.0 - z[0]]) / 0.05

    fit = multi_start(valley, [[-1.2, 1.44]])
    assert int(fit.ended.status) == CONVERGED
    assert int(fit.ended.steps) <= 20


def test_dead_parameters_are_named():
    """mujoco#3286: zero iterations at a zero gradient is no success."""
    fit = multi_start(lambda z: jnp.stack([0.0 * z @ z - 1.0]), [[1.0, 1.0]])
    with pytest.raises(DeadParameters, match=r"E146.*mass, length"):
        fit.ended.check(("mass", "length"), "here")


def test_one_dead_parameter_keeps_its_prior():
    prior = Gaussian(jnp.asarray([0.0, 3.0]), jnp.diag(jnp.asarray([1.0, 2.0])))
    fit = estimates.estimate(
        whitened(lambda tt: jnp.stack([4.0 * tt[0] - 1.0])),
        descents.Standard(prior),
        starts=jnp.ones((1, 2)),
        nuisances=jnp.zeros(NOTHING),
        noise=unit(),
        learn=False,
    )
    np.testing.assert_array_equal(fit.information[:, 1], 0.0)
    fit.convergence.check(("mass", "length"), "here")
    posterior = fit.posterior
    assert float(posterior.mean[1]) == pytest.approx(3.0, abs=1e-10)
    assert float(posterior.sd()[1]) == pytest.approx(2.0, rel=1e-10)


def test_a_descent_that_stands_near_its_map_is_an_answer():
    """A cusp, where no gradient vanishes: its distance from the MAP is reported."""
    fit = minimise(lambda z: 100.0 * jnp.abs(z - 0.3) ** 0.6, jnp.ones(1))
    assert float(fit.ended.gradient) > GRADIENT_TOLERANCE
    assert 0.0 < float(fit.ended.newton_step_sd) <= NEAR
    assert int(fit.ended.status) == CONVERGED
    np.testing.assert_allclose(fit.z, 0.3, atol=1e-6)


def test_a_step_that_is_left_is_no_arrival():
    """A kink of finite slope: the gradient says so in either unit."""
    fit = minimise(lambda z: 1.0 + 10.0 * jnp.abs(z - 0.3), jnp.ones(1))
    assert float(fit.ended.newton_step_sd) > 0.5
    with pytest.raises(NotConverged, match=r"E201 .* posterior sd\) after"):
        fit.ended.check(("k",), "here")


@pytest.mark.parametrize("N", [50, 5000])
def test_data_almost_free_of_noise_are_no_stall(N):
    """Rounding leaves a gradient that no descent removes; the way left is nothing."""
    x = jnp.linspace(-1.0, 1.0, N)
    truth = jnp.asarray([0.7, -0.4])

    def residuals(z):
        return 1e5 * (jnp.stack([x, jnp.cos(x)]).T @ (z - truth))

    fit = minimise(residuals, jnp.ones(2))
    assert float(fit.ended.gradient) > GRADIENT_TOLERANCE
    assert int(fit.ended.status) == CONVERGED
    assert float(fit.ended.newton_step_sd) <= GRADIENT_TOLERANCE
    np.testing.assert_allclose(fit.z, truth, rtol=1e-9)


@pytest.mark.parametrize("needed", [1.0, 1e3])
def test_a_choice_that_costs_evidence_is_undone(needed):
    """The next one trusts the linear model less, until a choice changes nothing."""

    def choose(at, noise, prior, trust):
        wild = trust < needed * TRUST
        worse = Noise(jnp.where(wild, 3.0, 0.5) * noise.sd, noise.weights)
        return worse, prior, jnp.where(wild, 1.0, 0.0)

    def score(at, noise, prior):
        return -noise.sd[0]

    learning = Learning(scales=Scales(choose, score))
    fit = multi_start(rosenbrock, [[-1.2, 1.0]], learning)
    assert float(fit.noise.sd[0]) == 0.5
    assert int(fit.ended.status) == CONVERGED


def test_noise_is_learned_with_the_steps():
    """Generalised EM: an update after each step, until both rest."""
    y = jnp.asarray([1.0, 1.4, 0.7, 1.2])

    def update(at, noise):
        r = at.z[0] - y
        scale = estimates.laplace(at, noise).scale()
        sd = jnp.sqrt(jnp.mean(r**2) + scale[0, 0] ** 2)
        return Noise(sd[None], noise.weights)

    fit = multi_start(lambda z: z[0] - y, [[0.0], [1.0]], Learning(update, still=1e-10))
    # The fixed point, by scalar iteration.
    v = 1.0
    for _ in range(500):
        s = 1.0 / (1.0 + 4.0 / v)
        z = s * float(jnp.sum(y)) / v
        v = float(jnp.mean((z - y) ** 2)) + s
    assert float(fit.noise.sd[0]) == pytest.approx(np.sqrt(v), rel=1e-8)
    assert float(fit.z[0]) == pytest.approx(z, rel=1e-8)


def test_slow_convergence_is_awaited():
    """Where the Gauss-Newton step contracts by 0.93 only, thirty steps do not do."""

    def residual(z):
        return 0.93 * 0.5 * z**2 - 1.0  # Hessian 0.07, Gauss-Newton 1, at z = 0

    fit = minimise(residual, jnp.asarray([1e-2]))
    assert int(fit.ended.status) == CONVERGED
    assert float(fit.ended.gradient) <= 1e-8


def test_a_step_too_long_is_shortened():
    """Under misfit the Hessian may be nine times Gauss-Newton's: undamped steps fly."""

    def residual(z):
        return jnp.stack([jnp.exp(z[0] + 8.0) - 1.0, 4.0 + jnp.exp(z[0])])

    fit = minimise(residual, jnp.zeros(1))
    gradient = jax.grad(lambda z: 0.5 * jnp.sum(residual(z) ** 2) + 0.5 * z @ z)(fit.z)
    assert int(fit.ended.status) == CONVERGED
    assert float(jnp.max(jnp.abs(gradient))) <= 1e-7
    assert int(fit.ended.steps) < 60


def test_a_step_that_gains_nothing_is_not_taken():
    """Gauss-Newton on an arctangent overshoots by more each time."""
    fit = minimise(lambda z: 1000.0 * jnp.arctan(z - 1.0), jnp.asarray([-4.0]))
    assert int(fit.ended.status) == CONVERGED
    assert float(fit.z[0]) == pytest.approx(1.0, abs=1e-5)


# Nuisances


def fit_of_curves():
    start = jnp.asarray([0.3, 0.2]), jnp.zeros((3, 2))
    likelihood = Curves(jnp.full((3, 2), 4.0), jnp.asarray([0.01, 0.02]))
    return descents.minimise(likelihood, *start, some_noise())


def test_nuisances_are_eliminated_exactly():
    """MAP, posterior and evidence against scipy's dense solver of the whole problem."""
    fit = fit_of_curves()
    x = jnp.concatenate([fit.z, fit.e.reshape(-1)])
    residuals, slopes = jax.jit(stacked), jax.jit(jax.jacfwd(stacked))
    dense = scipy.optimize.least_squares(
        lambda x: np.asarray(residuals(jnp.asarray(x))),
        np.asarray(x) + 0.01,
        jac=lambda x: np.asarray(slopes(jnp.asarray(x))),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-14,
    )
    np.testing.assert_allclose(x, dense.x, atol=1e-7)
    assert float(fit.cost) == pytest.approx(dense.cost, rel=1e-12)
    assert int(fit.ended.status) == CONVERGED
    J = np.asarray(slopes(x))
    covariance = np.linalg.inv(J.T @ J)
    np.testing.assert_allclose(
        fit.about.scale() @ fit.about.scale().T, covariance[:2, :2], rtol=1e-8
    )
    _, log_det = np.linalg.slogdet(J.T @ J)
    assert float(fit.about.log_joint()) == pytest.approx(-dense.cost - 0.5 * log_det)


def test_expected_squares_are_those_of_the_joint_posterior():
    """E||r||^2 per window and channel: at the MAP, plus J Sigma J^T of all unknowns."""
    fit = fit_of_curves()
    x = jnp.concatenate([fit.z, fit.e.reshape(-1)])
    whole = np.asarray(jax.jit(jax.jacfwd(stacked))(x))
    covariance = np.linalg.inv(whole.T @ whole)
    each = jax.jit(jax.jacfwd(lambda x: curves(x[:2], x[2:].reshape(3, 2))))
    J = np.asarray(each(x))
    r = np.asarray(curves(fit.z, fit.e))
    squares, spread = fit.about.squares()
    np.testing.assert_allclose(squares, np.sum(r**2, axis=1), rtol=1e-6)
    each = np.einsum("wtci,ij,wtcj->wc", J, covariance, J)
    np.testing.assert_allclose(spread, each, rtol=1e-8)


def test_weights_of_outlying_windows_fall():
    """Student-t: (1 + n / nu) / (1 + |r|^2 / nu), by hand."""
    fit, noise = fit_of_curves(), some_noise()
    count, floor = jnp.full((3, 2), 4.0), jnp.asarray([0.01, 0.02])
    found = fit.about.squares()
    new = expected_noise(noise, *found, count, floor, 4.0)
    squares, spread = map(np.asarray, found)
    weights = np.asarray(noise.weights)
    variance = weights @ (squares + spread) / weights.mean() + 2.0 * floor**2
    np.testing.assert_allclose(new.sd**2, variance / 14.0, rtol=1e-12)
    misfit = np.sum(squares / np.asarray(new.sd) ** 2, axis=1)
    np.testing.assert_allclose(new.weights, 3.0 / (1.0 + misfit / 4.0), rtol=1e-12)
    off = expected_noise(noise, *found, count, floor)
    np.testing.assert_array_equal(off.weights, 1.0)
