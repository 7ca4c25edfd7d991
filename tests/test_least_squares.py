"""The whitened MAP against 100-digit arithmetic, and its verdicts against known cases.

Tolerances are reliability.md's S1, S5, S14, N1, N2, N4, N5; the measured errors stand
beside them. Priors are informative: a prior counted twice then moves the mean by tenths
of an sd, while a vague one would hide it.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import exact

from sim2gp import least_squares as ls
from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.gaussian import Gaussian

CAPACITY = 500
DIMENSIONS = range(1, 21)


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


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


def random_problem(rng, p, d, N=None, log_cond=None, ratio=None):
    """Information of the prior is ``ratio`` times that of the data."""
    N = int(rng.integers(0, CAPACITY + 1)) if N is None else N
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


def padded(problem, capacity=CAPACITY):
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


def errors_of(problems, rng):
    """Largest errors over problems of one shape: mean, cov, evidence, predictive."""
    rows = [padded(q) for q in problems]
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
        evidence = float(got[2][i]) + (CAPACITY - len(q.J)) * unit
        A, L = exact.numbers(A), exact.numbers(q.L)
        mean, cov = A @ ref.mean, A @ ref.cov @ A.T + L @ L.T
        sd = np.sqrt(exact.floats(np.diag(cov)))
        predictive = np.max(np.abs(exact.floats(exact.numbers(got[3][i]) - mean)) / sd)
        reference = float(ref.log_evidence)
        errors[i] = (
            exact.mean_error(ref, got[0][i]),
            exact.cov_error(ref.cov, got[1][i]),
            abs(evidence - reference) / max(1.0, abs(reference)),
            predictive,
            exact.cov_error(cov, got[4][i]),
        )
    return errors


def test_conjugate_oracle():
    """S1: 1,000 problems, against 100 digits."""
    worst = np.zeros(5)
    for p in DIMENSIONS:
        rng = np.random.default_rng(p)
        d = 1 + p % 4
        problems = [random_problem(rng, p, d) for _ in range(50)]
        worst = np.maximum(worst, errors_of(problems, rng).max(axis=0))
    print("mean, cov, evidence, predictive mean, cov:", worst)
    assert np.all(worst <= [1e-10, 1e-10, 1e-9, 1e-10, 1e-10])
