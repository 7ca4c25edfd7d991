"""The linear-Gaussian posterior against 150-digit arithmetic, scaled and degenerate.

Tolerances are the project's S1, S5, N1, N2, N4 and N5; measured errors stand beside
them. Priors are informative: a prior counted twice then moves the mean by tenths of an
sd, while a vague one would hide it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from oracles import exact
from sim2gp.inference import least_squares as ls
from sim2gp.inference.gaussian import Gaussian

#: (p, outputs, most rows): one compilation each.
SHAPES = [(1, 2, 500), (2, 1, 100), (3, 4, 20), (4, 3, 500), (6, 2, 100)]
SHAPES += [(8, 1, 20), (11, 4, 100), (14, 3, 100), (17, 2, 20), (20, 1, 500)]


pytestmark = pytest.mark.usefixtures("float64")


@dataclass(frozen=True)
class Problem:
    """``y = J tt + eps``: J (N, d, p), y (N, d), noise factor (d, d), prior factor."""

    J: np.ndarray
    y: np.ndarray
    L: np.ndarray
    mean: np.ndarray
    scale: np.ndarray

    @property
    def prior(self):
        return Gaussian(jnp.asarray(self.mean), jnp.asarray(self.scale))

    def exact(self):
        return exact.posterior(self.J, self.y, self.L, self.mean, self.scale)


def lower(rng, n, spread=1.0):
    """A lower factor with correlations of order one and sd over two decades."""
    L = np.tril(0.5 * rng.standard_normal((n, n)), -1) + np.diag(rng.uniform(0.5, 2, n))
    return 10.0 ** rng.uniform(-spread, spread, (n, 1)) * L


def random_problem(rng, p, d, N, log_cond=None, ratio=None):
    """Information of the prior is ``ratio`` times that of the data."""
    log_cond = rng.uniform(0.0, 12.0) if log_cond is None else log_cond
    ratio = 10.0 ** rng.uniform(-1.0, 1.0) if ratio is None else ratio
    L, scale = lower(rng, d), lower(rng, p)
    rank = min(N * d, p)
    J = np.zeros((N * d, p))
    if rank:
        U = np.linalg.qr(rng.standard_normal((N * d, rank)))[0]
        V = np.linalg.qr(rng.standard_normal((p, rank)))[0]
        J = (U * np.logspace(0.0, -log_cond, rank)) @ V.T
    J = 10.0 ** rng.uniform(-3.0, 3.0) * J.reshape(N, d, p)
    information = np.sum(np.linalg.solve(L, J @ scale) ** 2)
    scale = scale * np.sqrt(p / (ratio * information)) if rank else scale
    mean = scale @ rng.standard_normal(p)
    tt = mean + scale @ rng.standard_normal(p)
    y = J @ tt + rng.standard_normal((N, d)) @ L.T
    return Problem(J, y, L, mean, scale)


def padded(problem, capacity):
    """Zero rows up to a fixed capacity carry no information: one compilation each p."""
    extra = capacity - len(problem.J)
    J = np.concatenate([problem.J, np.zeros((extra, *problem.J.shape[1:]))])
    return J, np.concatenate([problem.y, np.zeros((extra, problem.y.shape[1]))])


@jax.jit
def solve_all(J, y, L, mean, scale, J_new):
    """Posterior, predictive and evidence of a batch of problems of one shape."""

    def solve(J, y, L, mean, scale, J_new):
        # The prior's data are y - J mu0: rows of zeros must stay rows of zeros.
        posterior, evidence = ls.linear_posterior(J, y, L, Gaussian(mean, scale))
        predictive = posterior.push(J_new, jnp.zeros(len(J_new))).plus(L)
        return (
            posterior.mean,
            posterior.covariance(),
            evidence,
            predictive.mean,
            predictive.covariance(),
        )

    return jax.vmap(solve)(J, y, L, mean, scale, J_new)


def errors_of(problems, rng, capacity):
    """Largest errors over problems of one shape: mean, cov, evidence, predictive."""
    rows = [padded(q, capacity) for q in problems]
    J_new = [rng.standard_normal(q.J.shape[1:]) / np.mean(q.scale**2) for q in problems]
    stacked = [
        np.stack(x)
        for x in (
            [r[0] for r in rows],
            [r[1] for r in rows],
            [q.L for q in problems],
            [q.mean for q in problems],
            [q.scale for q in problems],
            J_new,
        )
    ]
    got = [np.asarray(x) for x in solve_all(*stacked)]
    errors = np.zeros((len(problems), 5))
    for i, (q, A) in enumerate(zip(problems, J_new, strict=True)):
        ref = q.exact()
        # What the zero rows added to the normalisation of the noise.
        d = q.y.shape[1]
        unit = np.sum(np.log(np.diag(q.L))) + 0.5 * d * np.log(2 * np.pi)
        evidence = float(got[2][i]) + (capacity - len(q.J)) * unit
        A, L = exact.numbers(A), exact.numbers(q.L)
        mean = exact.product(A, ref.mean)
        cov = exact.product(exact.product(A, ref.cov), A.T) + exact.product(L, L.T)
        sd = np.sqrt(exact.floats(np.diag(cov)))
        predictive = np.max(np.abs(exact.floats(exact.numbers(got[3][i]) - mean)) / sd)
        reference = ref.log_evidence
        errors[i] = (
            ref.mean_error(got[0][i]),
            exact.cov_error(ref.cov, got[1][i]),
            abs(evidence - reference) / max(1.0, abs(reference)),
            predictive,
            exact.cov_error(cov, got[4][i]),
        )
    return errors


@pytest.mark.parametrize(
    ("shapes", "count"),
    [(SHAPES[1::2], 17), pytest.param(SHAPES, 97, marks=pytest.mark.nightly)],
    ids=["five shapes", "all"],
)
def test_conjugate_oracle(shapes, count):
    """S1: 1,000 problems against 150 digits (measured: 5e-15, evidence 3e-14)."""
    worst = np.zeros(5)
    for p, d, capacity in shapes:
        rng = np.random.default_rng(p)
        rows = [0, 1, capacity, *rng.integers(0, capacity + 1, count)]
        problems = [random_problem(rng, p, d, int(N)) for N in rows]
        worst = np.maximum(worst, errors_of(problems, rng, capacity).max(axis=0))
    print("mean, cov, evidence, predictive mean, cov:", worst)
    assert np.all(worst <= [1e-10, 1e-10, 1e-9, 1e-10, 1e-10])


@pytest.mark.parametrize("log_cond", [2, 4, 6, 12])
def test_vague_prior(log_cond):
    """The table of reliability.md 3.2: prior sd 1e4, where normal equations fail."""
    rng = np.random.default_rng(log_cond)
    worst = np.zeros(3)
    for _ in range(8):
        q = random_problem(rng, 6, 1, 400, log_cond, ratio=1.0)
        q = Problem(q.J / np.max(np.abs(q.J)), q.y, np.eye(1), q.mean, 1e4 * np.eye(6))
        q = Problem(q.J, q.y / np.std(q.y), q.L, q.mean / 1e4, q.scale)
        posterior, _ = solve(q)
        ref = q.exact()
        cov = exact.cov_error(ref.cov, posterior.covariance())
        error = ref.mean_error(posterior.mean), cov, ref.whitened_error(posterior.mean)
        worst = np.maximum(worst, error)
    print("mean, cov, mean along any direction:", worst)
    assert np.all(worst <= 1e-10)


@jax.jit
def _solve(J, y, L, mean, scale):
    return ls.linear_posterior(J, y, L, Gaussian(mean, scale))


def solve(q):
    """One problem, as it is."""
    return _solve(q.J, q.y, q.L, q.mean, q.scale)


def sd_error(got, reference):
    """Difference of two Gaussians: means in sd, covariances relative to the sd."""
    sd = np.asarray(reference.sd())
    mean = np.abs(np.asarray(got.mean - reference.mean)) / sd
    cov = np.asarray(got.covariance() - reference.covariance()) / np.outer(sd, sd)
    return max(mean.max(initial=0.0), np.abs(cov).max(initial=0.0))


def test_no_rows_give_the_prior_exactly():
    rng = np.random.default_rng(0)
    q = random_problem(rng, 5, 2, 0)
    data = map(jnp.asarray, (q.J, q.y, q.L))
    posterior, evidence = ls.linear_posterior(*data, q.prior)
    np.testing.assert_array_equal(posterior.mean, q.mean)
    np.testing.assert_array_equal(posterior.scale, q.scale)
    assert float(evidence) == 0.0


def test_order_and_splitting():
    """S5: rows in any order; D1 then D2 = D1 + D2; k copies = weight k."""
    rng = np.random.default_rng(5)
    for _ in range(5):
        q = random_problem(rng, 6, 2, 40, log_cond=rng.uniform(0, 12))
        whole, evidence = solve(q)
        order = rng.permutation(40)
        shuffled, _ = solve(Problem(q.J[order], q.y[order], q.L, q.mean, q.scale))
        assert sd_error(shuffled, whole) <= 1e-12
        first = Problem(q.J[:15], q.y[:15], q.L, q.mean, q.scale)
        middle, one = solve(first)
        rest = Problem(q.J[15:], q.y[15:], q.L, middle.mean, middle.scale)
        last, two = solve(rest)
        assert sd_error(last, whole) <= 1e-10
        assert float(one + two) == pytest.approx(float(evidence), rel=1e-9)
        copies = np.repeat(q.J[:10], 4, axis=0), np.repeat(q.y[:10], 4, axis=0)
        copied, _ = solve(Problem(*copies, q.L, q.mean, q.scale))
        weighed, _ = solve(Problem(q.J[:10], q.y[:10], q.L / 2, q.mean, q.scale))
        assert sd_error(copied, weighed) <= 1e-12


def test_rescaling_by_powers_of_two_is_exact():
    """N1: rows with their noise, outputs, and parameters by 2^+-40, bit for bit."""
    rng = np.random.default_rng(1)
    q = random_problem(rng, 4, 2, 30, log_cond=6.0)
    base, evidence = solve(q)
    for k in (-40, -20, 20, 40):
        c = 2.0**k
        same, e = solve(Problem(q.J * c, q.y * c, q.L * c, q.mean, q.scale))
        np.testing.assert_array_equal(same.mean, base.mean)
        np.testing.assert_array_equal(same.scale, base.scale)
        assert float(e) == pytest.approx(float(evidence) - q.y.size * np.log(c))
        per = 2.0 ** np.array([k, -k, k // 2, 0])
        scaled = Problem(q.J / per, q.y, q.L, q.mean * per, q.scale * per[:, None])
        got, e = solve(scaled)
        np.testing.assert_array_equal(got.mean / per, base.mean)
        np.testing.assert_array_equal(got.scale / per[:, None], base.scale)
        assert float(e) == float(evidence)


def test_rescaling_by_powers_of_ten():
    """N1: 10^-12 .. 10^12 per parameter and for the data, at most 1e-9 sd."""
    rng = np.random.default_rng(10)
    q = random_problem(rng, 4, 2, 30, log_cond=6.0)
    base, _ = solve(q)
    for k in range(-12, 13):
        c, per = 10.0**k, 10.0 ** np.array([k, -k, k / 2, 0])
        scaled = Problem(
            q.J / per * c, q.y * c, q.L * c, q.mean * per, q.scale * per[:, None]
        )
        got, _ = solve(scaled)
        back = Gaussian(got.mean / per, got.scale / per[:, None])
        assert sd_error(back, base) <= 1e-9


def degenerate_problems():
    """(name, J, null directions) with p = 4 and two outputs."""
    rng = np.random.default_rng(2)
    J = rng.standard_normal((3, 2, 4))
    flat = J.copy()
    flat[..., 2] = 0.0
    u, v = rng.standard_normal((3, 2, 1)), np.array([1.0, 2.0, -1.0, 0.5])
    null = np.linalg.svd(v[None])[2][1:]
    steep = np.linalg.qr(rng.standard_normal((6, 4)))[0] * [1.0, 1e-5, 1e-10, 1e-16]
    yield "no rows", np.zeros((0, 2, 4)), np.eye(4)
    yield "one row", J[:1], np.linalg.svd(J[0])[2][2:]
    yield "no sensitivity", 0.0 * J, np.eye(4)
    yield "dead column", flat, np.eye(4)[2:3]
    yield "row a thousand times", np.repeat(J[:1], 1000, 0), np.linalg.svd(J[0])[2][2:]
    yield "constant columns", np.ones((3, 2, 4)), np.linalg.svd(np.ones((1, 4)))[2][1:]
    yield "rank one", u * v, null
    yield "condition 1e16", steep.reshape(3, 2, 4), np.zeros((0, 4))


@pytest.mark.parametrize("case", list(degenerate_problems()), ids=lambda case: case[0])
def test_degenerate_data(case):
    """N2: nothing is NaN, and what the data do not see stays as the prior said."""
    _, J, null = case
    rng = np.random.default_rng(3)
    mean = rng.standard_normal(4)
    q = Problem(J, rng.standard_normal(J.shape[:2]), np.eye(2), mean, 0.7 * np.eye(4))
    posterior, evidence = solve(q)
    for leaf in (posterior.mean, posterior.scale, evidence):
        assert np.all(np.isfinite(leaf))
    cov = np.asarray(posterior.covariance())
    np.testing.assert_allclose(null @ (posterior.mean - mean), 0.0, atol=1e-10)
    expected = 0.49 * null @ null.T
    np.testing.assert_allclose(null @ cov @ null.T, expected, atol=1e-10)
    ref = q.exact()
    assert ref.mean_error(posterior.mean) <= 1e-10
    assert exact.cov_error(ref.cov, cov) <= 1e-10
    assert float(evidence) == pytest.approx(ref.log_evidence, rel=1e-9, abs=1e-9)


def test_more_parameters_than_rows():
    """N2: p = 200, N = 3."""
    rng = np.random.default_rng(4)
    J, y = rng.standard_normal((3, 1, 200)), rng.standard_normal((3, 1))
    q = Problem(J, y, np.eye(1), np.zeros(200), np.eye(200))
    posterior, _ = solve(q)
    A = J[:, 0]
    K = A @ A.T + np.eye(3)
    mean = A.T @ np.linalg.solve(K, y[:, 0])
    cov = np.eye(200) - A.T @ np.linalg.solve(K, A)
    np.testing.assert_allclose(posterior.mean, mean, atol=1e-10)
    np.testing.assert_allclose(posterior.covariance(), cov, atol=1e-10)
    null = np.linalg.svd(A)[2][3:]
    np.testing.assert_allclose(null @ posterior.mean, 0.0, atol=1e-10)


def test_covariances_are_positive_semidefinite():
    """N4: 10,000 posteriors up to condition 1e16, by their factors' singular values."""
    rng = np.random.default_rng(6)
    p, N, batch = 5, 12, 10_000
    U = np.linalg.qr(rng.standard_normal((batch, N, p)))[0]
    V = np.linalg.qr(rng.standard_normal((batch, p, p)))[0]
    decades = -rng.uniform(0, 16, (batch, 1)) * np.linspace(0, 1, p)
    steep = 10.0 ** (rng.uniform(0, 8, (batch, 1)) + decades)
    J = (U * steep[:, None, :]) @ V.transpose(0, 2, 1)
    y = rng.standard_normal((batch, N))

    @jax.jit
    @jax.vmap
    def posterior(J, y):
        prior = Gaussian(jnp.zeros(p), jnp.eye(p))
        found, _ = ls.linear_posterior(J[:, None], y[:, None], jnp.eye(1), prior)
        values = jnp.linalg.svd(found.scale, compute_uv=False)
        return found.mean, found.scale, found.covariance(), values

    mean, scale, cov, values = map(np.asarray, posterior(J, y))
    for leaf in (mean, scale, cov, values):
        assert np.all(np.isfinite(leaf))
    np.testing.assert_array_equal(cov, cov.transpose(0, 2, 1))
    assert np.all(np.diagonal(cov, axis1=1, axis2=2) > 0.0)
    assert np.all(values > 0.0)
    # And no larger than the prior.
    assert values.max() <= 1.0 + 1e-12


def test_precision_holds_without_jitter():
    """N5: nothing is added to any diagonal, at any scale of the problem."""
    rng = np.random.default_rng(8)
    for unit in (1e-12, 1e-3, 1.0, 1e6):
        q = random_problem(rng, 3, 1, 20, log_cond=2.0, ratio=1.0)
        q = Problem(q.J / unit, q.y, q.L, q.mean * unit, q.scale * unit)
        ref = q.exact()
        assert exact.cov_error(ref.cov, solve(q)[0].covariance()) <= 1e-12
