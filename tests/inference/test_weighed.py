"""Measured sums of constants: closed forms, bounds, project files."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from descents import minimise
from linear_system import linear, transitions, windows_of
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.missing_physics.score import _LinearPrior
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_measurements import LinearMeasurement
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.project import load_project
from sim2gp.systems import Coulomb, Delay, Variant, free_parts, with_variants
from sim2gp.systems.assemble import with_measurements
from sim2gp.systems.machine import Machine
from sim2gp.systems.plants.furuta import Furuta
from sim2gp.types import in_float64

KEY = jax.random.key(0)
SUM = LinearMeasurement(("k0", "k1"), (1.0, 1.0), 3.0, 0.01)
BOXES = (
    Parameter("a", "kg", "one", "bounded", 0.0, 2.0),
    Parameter("b", "kg", "other", "log_bounded", 0.1, 1.0, mean=0.5),
    Parameter("c", "kg", "third", "log", 0.0, sd=0.5),
)


def data(getkey: object = None) -> tuple[np.ndarray, np.ndarray]:
    """Rows that tell ``k0 - k1`` and ``k2``, and nothing of ``k0 + k1``."""
    rng = np.random.default_rng(2)
    J = rng.normal(size=(25, 1, 3))
    J[..., 1] = -J[..., 0]
    return J, J @ np.asarray([2.0, 1.0, -0.5]) + 0.1 * rng.normal(size=(25, 1))


@pytest.fixture(scope="module")
def belief() -> Estimate:
    J, y = data()
    system = with_measurements(linear(3, 1), [SUM])
    return fit_windows(system, windows_of(J, y, np.zeros(25)), key=KEY)


def dense(sd: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean, covariance and log evidence by one regression, the sum a row of it."""
    J, y = data()
    X = np.concatenate([J[:, 0] / sd, np.asarray([[100.0, 100.0, 0.0]])])
    right = np.append(y[:, 0] / sd, 300.0)
    covariance = np.linalg.inv(X.T @ X + np.eye(3))
    C = np.eye(len(X)) + X @ X.T
    evidence = -0.5 * (right @ np.linalg.solve(C, right) + np.linalg.slogdet(C)[1])
    # Of the rows; that of the sum is a constant of the file.
    evidence -= len(y) * (np.log(sd) + 0.5 * np.log(2.0 * np.pi))
    return covariance @ X.T @ right, covariance, float(evidence)


def test_a_sum_is_one_more_row_of_a_regression(belief: Estimate) -> None:
    mean, covariance, evidence = dense(float(belief.noise.sd[0]))
    scale = np.asarray(belief.posterior.scale)
    np.testing.assert_allclose(scale @ scale.T, covariance, rtol=1e-7)
    np.testing.assert_allclose(belief.posterior.mean, mean, rtol=1e-8)
    np.testing.assert_allclose(float(belief.log_evidence), evidence, rtol=1e-9)
    # Without it the logs leave the sum to the prior, whose sd of it is sqrt(2).
    u = np.asarray([1.0, 1.0, 0.0])
    assert np.sqrt(u @ covariance @ u) == pytest.approx(0.01, rel=1e-3)
    assert float(u @ np.asarray(belief.posterior.mean)) == pytest.approx(3.0, abs=0.01)


@in_float64
def test_its_pull_is_part_of_the_gradient() -> None:
    """At the MAP the sum and the prior pull against each other."""
    J, y = data()
    system = with_measurements(linear(3, 1), [SUM])
    prior = ParameterPrior(system.parameters.prior(), system.parameters)
    noise = Noise(jnp.full(1, 0.1), jnp.ones(1))
    one, none = OneStepLikelihood(system, transitions(J, y), 1.0), jnp.zeros((1, 0))
    fit = jax.jit(lambda z: minimise(one, z, none, noise, prior))(jnp.zeros(3))
    mean, covariance, _ = dense(0.1)
    np.testing.assert_allclose(fit.z, mean, rtol=1e-9)
    np.testing.assert_allclose(
        fit.about.scale() @ fit.about.scale().T, covariance, rtol=1e-7
    )
    assert float(fit.ended.gradient) < 1e-8


@in_float64
def test_what_was_weighed_is_prior_to_the_logs(belief: Estimate) -> None:
    """Prior and information with the sums in them make the same posterior."""
    known = belief.with_measurements(with_measurements(linear(3, 1), [SUM]).parameters)
    u = jnp.asarray([1.0, 1.0, 0.0])
    assert float(jnp.linalg.norm(u @ belief.prior.scale)) == pytest.approx(np.sqrt(2.0))
    assert float(jnp.linalg.norm(u @ known.prior.scale)) == pytest.approx(
        0.01, rel=1e-4
    )
    assert float(u @ known.prior.mean) == pytest.approx(3.0, abs=1e-3)
    A, L0 = np.asarray(known.information), np.asarray(known.prior.scale)
    posterior = L0 @ np.linalg.inv(A.T @ A + np.eye(3)) @ L0.T
    scale = np.asarray(belief.posterior.scale)
    np.testing.assert_allclose(posterior, scale @ scale.T, rtol=1e-7)
    np.testing.assert_allclose(known.scores.sum(axis=0), -(known.z()), atol=1e-6)
    assert belief.with_measurements(linear(3, 1).parameters) is belief


@in_float64
def test_bounded_constants_keep_their_sum() -> None:
    """The mode by scipy, the curvature by hand: the sum is not linear in ``tt``."""
    x = LinearMeasurement(("a", "b", "c"), (1.0, 2.0, -1.0), 0.7, 0.02)
    table = Parameters(BOXES, measurements=(x,))
    prior = table.prior()
    found = ParameterPrior(prior, table).at_mode()

    def cost(z: jax.Array) -> jax.Array:
        theta = table.constrain(prior.mean + prior.scale @ z)
        r = (theta @ jnp.asarray([1.0, 2.0, -1.0]) - 0.7) / 0.02
        return 0.5 * (z @ z + r**2)

    z = np.linalg.solve(np.asarray(prior.scale), np.asarray(found.mean - prior.mean))
    slope = jax.jit(jax.grad(cost))
    best = scipy.optimize.root(slope, np.zeros(3), tol=1e-12)
    np.testing.assert_allclose(z, best.x, atol=1e-6)
    assert float(jnp.max(jnp.abs(slope(jnp.asarray(z))))) < 1e-6

    def r(z: jax.Array) -> jax.Array:
        theta = table.constrain(prior.mean + prior.scale @ z)
        return (theta @ jnp.asarray([1.0, 2.0, -1.0])) / 0.02

    K = np.asarray(jax.grad(r)(jnp.asarray(z)))
    L0 = np.asarray(prior.scale)
    covariance = L0 @ np.linalg.inv(np.eye(3) + np.outer(K, K)) @ L0.T
    scale = np.asarray(found.scale)
    np.testing.assert_allclose(scale @ scale.T, covariance, rtol=1e-6, atol=1e-12)


def test_a_candidate_keeps_what_is_known() -> None:
    """Explain tries machines with one constant more."""
    x = LinearMeasurement(("arm_mass", "pendulum_mass"), (1.0, 1.0), 0.119, 0.001)
    heavy = Variant("heavy", own=("pendulum_mass",))
    both = with_measurements(with_variants(Furuta(), [Variant("bare"), heavy]), [x])
    machine = both
    for part in (Coulomb("theta", 0.01), Delay("voltage", 0.02)):
        machine = free_parts(machine, [part])
        assert isinstance(machine, Machine)
        assert machine.parameters.measurements == (x,)
        assert machine.variants == both.variants
        assert {*machine.parameters.names} >= {*both.parameters.names, part.name}
    assert machine.longest_delay == 0.02
    more = {"theta.coulomb", "voltage.delay"}
    assert {*machine.parameters.names} == {*both.parameters.names, *more}


@in_float64
def test_a_linearised_likelihood_moves_its_sums() -> None:
    table = Parameters(
        BOXES, measurements=(LinearMeasurement(("a", "c"), (1.0, 3.0), 2.0, 0.1),)
    )
    z0, z = jnp.asarray([0.3, -0.2, 0.1]), jnp.asarray([0.31, -0.21, 0.12])
    rows = table.measurement_rows(table.prior(), z0)
    prior = _LinearPrior(Gaussian(jnp.zeros(3), jnp.eye(3)), rows, z0)
    np.testing.assert_array_equal(prior.rows(z0)[3:], rows)
    np.testing.assert_array_equal(prior.rows(z)[:3, -1], z)
    exact = table.measurement_rows(table.prior(), z)
    moved = prior.rows(z)[3:]
    np.testing.assert_array_equal(moved[:, :-1], rows[:, :-1])
    np.testing.assert_allclose(moved[:, -1], exact[:, -1], atol=5e-3)
    assert float(jnp.abs(rows - exact)[0, -1]) > 0.1


ARM = """system = "uniform_rod_arm"
[[weighed]]
of = ["m1", "m2"]
value = {value}
sd = {sd}
"""


def test_a_project_file_says_what_was_weighed(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    path.write_text(ARM.format(value=1.24, sd=0.005))
    found = load_project(path).system.parameters
    assert found.measurements == (
        LinearMeasurement(("m1", "m2"), (1.0, 1.0), 1.24, 0.005),
    )
    path.write_text(ARM.format(value=0.2, sd=0.005) + "weights = [1.0, -0.5]\n")
    (x,) = load_project(path).system.parameters.measurements
    assert x.weights == (1.0, -0.5)
