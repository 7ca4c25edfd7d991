"""Scales of groups, against the closed form of the evidence and scipy's optimum."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import estimate
from sim2gp.inference.least_squares import factor
from sim2gp.inference.linear_likelihood import LinearLikelihood
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import (
    EARNED,
    NEVER,
    OFF,
    ON,
    TRIED,
    Linear,
    gains_if_on,
)
from sim2gp.inference.relevance import relevant as choose

pytestmark = pytest.mark.usefixtures("float64")
N, SIZES = 60, (1, 4, 4)  # rows, and parameters: one alone, two groups
NOISE = 0.3
relevant = eqx.filter_jit(choose)


def table() -> Parameters:
    groups = ["", *["a"] * 4, *["b"] * 4]
    each = [
        Parameter(f"x{i}", "1", "", "identity", sd=1.0 + 0.1 * i, group=group)
        for i, group in enumerate(groups)
    ]
    return Parameters(tuple(each))


def problem(strength: tuple[float, float]):
    """Rows of a regression, and what was measured, with groups of these strengths."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(N, sum(SIZES)))
    sd = np.concatenate([[1.0], np.full(4, strength[0]), np.full(4, strength[1])])
    x = rng.normal(size=sum(SIZES)) * sd
    return J, J @ x + NOISE * rng.normal(size=N)


def log_evidence(J, y, scales, noise):
    """The marginal likelihood, by the covariance of the data."""
    sd = table().prior().sd() * np.concatenate([[1.0], *([s] * 4 for s in scales)])
    C = noise**2 * np.eye(len(y)) + (J * np.asarray(sd) ** 2) @ J.T
    return scipy.stats.multivariate_normal(cov=C).logpdf(y)


def linear_at(J, y, prior, z):
    """The Gram matrix of the whitened rows, about ``z``."""
    A = J @ np.asarray(prior.gaussian.scale)
    rows = np.concatenate([A, (A @ z - y)[:, None]], axis=1)
    none = jnp.zeros(1)
    return Linear(jnp.asarray((rows.T @ rows)[None]), none, jnp.full(1, float(N)), none)


@pytest.mark.parametrize("about", [0.0, 0.7])
def test_scales_and_noise_have_the_highest_evidence(about: float):
    """At scipy's optimum of the closed form, wherever the data were linearised."""
    J, y = problem((2.0, 0.4))
    prior = ParameterPrior(table().prior(), table())
    z = np.full(sum(SIZES), about)
    noise = Noise(jnp.ones(1), jnp.ones(1))
    for _ in range(20):  # each begins where the last one ended
        linear = linear_at(J, y, prior, z)
        noise, prior = relevant(linear, jnp.asarray(z), noise, prior)

    # EM's prior on the noise: two samples at the floor, which is zero here.
    def lost(t):
        return -log_evidence(J, y, np.exp(t[:2]), np.exp(t[2])) + 2.0 * t[2]

    best = scipy.optimize.minimize(lost, [0.0, 0.0, -1.0], tol=1e-12)
    found = np.log([*np.asarray(prior.scales), float(noise.sd[0])])
    np.testing.assert_allclose(found, best.x, atol=2e-4)


def test_a_group_stays_on_where_it_earns_its_place():
    """At the threshold its gain is the closed form's."""
    prior = ParameterPrior(table().prior(), table())
    kept = {}
    for strength in np.geomspace(0.01, 0.3, 12).tolist():
        J, y = problem((2.0, strength))
        noise, p = Noise(jnp.ones(1), jnp.ones(1)), prior
        for _ in range(12):
            linear = linear_at(J, y, p, np.zeros(sum(SIZES)))
            noise, p = relevant(linear, jnp.zeros(sum(SIZES)), noise, p)
        a, b, s = *np.asarray(p.scales), float(noise.sd[0])

        def lost(t, data=(J, y, a, s)):
            J, y, a, s = data
            return -log_evidence(J, y, [a, np.exp(t)], s)

        best = scipy.optimize.minimize_scalar(
            lost, bounds=(-9.0, 2.0), method="bounded"
        )
        kept[lost(-20.0) - best.fun] = b > 2.0 * OFF
    gains = np.asarray(sorted(kept))
    on = np.asarray([kept[g] for g in gains])
    assert on[gains > EARNED + 0.5].all()
    assert not on[gains < EARNED - 0.5].any()
    assert 0 < on.sum() < on.size


def test_a_group_that_is_not_needed_goes_off():
    J, y = problem((2.0, 0.0))
    rng = np.random.default_rng(5)  # its rows have nothing to do with the data
    J[:, 5:] = np.linalg.qr(np.c_[J[:, :5], y, rng.normal(size=(N, 4))])[0][:, 6:]
    prior = ParameterPrior(table().prior(), table())
    noise = Noise(jnp.ones(1), jnp.ones(1))
    for _ in range(8):
        linear = linear_at(J, y, prior, np.zeros(sum(SIZES)))
        noise, prior = relevant(linear, jnp.zeros(sum(SIZES)), noise, prior)
    on, off = np.asarray(prior.scales)
    assert on > 1.0
    assert off == pytest.approx(OFF)


def test_the_gain_of_a_group_that_is_off_is_the_closed_form():
    """Its evidence at each scale, less that at zero, the rest marginalised."""
    J, y = problem((2.0, 0.4))
    prior = ParameterPrior(table().prior(), table()).scaled(jnp.asarray([2.0, OFF]))
    sd = np.asarray(prior.gaussian.sd())
    A, known = J * sd / NOISE, 1.0 / np.asarray(prior.each()) ** 2
    S = np.linalg.inv(A.T @ A + np.diag(known))
    x = S @ A.T @ y / NOISE
    gradient = A.T @ (y / NOISE - A @ x)
    found = gains_if_on(*map(jnp.asarray, (A.T @ A, gradient, S)), prior.members)
    off = log_evidence(J, y, [2.0, 0.0], NOISE)
    gains = [log_evidence(J, y, [2.0, t], NOISE) - off for t in TRIED]
    np.testing.assert_allclose(found[1], gains, rtol=1e-4, atol=1e-4)
    assert max(gains) > EARNED


@pytest.mark.parametrize("never", [False, True])
def test_of_two_groups_that_do_the_same_one_is_turned_on(never: bool):
    """Both are off, as where neither earns its place beside the other."""
    J, y = problem((2.0, 0.0))
    rng = np.random.default_rng(8)
    J[:, 5:] = J[:, 1:5] + 0.05 * rng.normal(size=(N, 4))
    begun = jnp.asarray([NEVER if never else OFF, OFF])
    prior = ParameterPrior(table().prior(), table()).scaled(begun)
    noise = Noise(jnp.ones(1), jnp.ones(1))
    for _ in range(8):
        linear = linear_at(J, y, prior, np.zeros(sum(SIZES)))
        noise, prior = relevant(linear, jnp.zeros(sum(SIZES)), noise, prior)
    on = np.asarray(prior.scales) > ON
    assert on.sum() == 1
    assert float(noise.sd[0]) < 1.5 * NOISE
    if never:
        assert on.tolist() == [False, True]


def test_a_fit_with_groups_is_the_conjugate_one_at_its_scales():
    """Posterior, evidence and information of `estimate`, in its own scaled prior."""
    J, y = problem((2.0, 0.4))
    unit = Noise(jnp.ones(1), jnp.ones(1))
    likelihood = LinearLikelihood(
        jnp.full((1, 1), float(N)),
        jnp.zeros(1),
        factor(jnp.asarray(J), jnp.asarray(-y))[None, None],
        jnp.zeros(sum(SIZES)),
        jnp.zeros((1, 0)),
        unit,
    )
    prior = ParameterPrior(table().prior(), table())
    found = jax.jit(
        lambda z: estimate(likelihood, prior, starts=z),
    )(jnp.zeros((1, sum(SIZES))))
    sd, s = np.diag(found.prior.scale), float(found.noise.sd[0])
    scales = (sd / np.asarray(table().prior().sd()))[[1, 5]]
    precision = J.T @ J / s**2 + np.diag(sd**-2.0)
    mean = np.linalg.solve(precision, J.T @ y / s**2)
    np.testing.assert_allclose(found.posterior.mean, mean, rtol=1e-6, atol=1e-8)
    covariance = found.posterior.scale @ found.posterior.scale.T
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), atol=1e-9)
    assert float(found.log_evidence) == pytest.approx(
        log_evidence(J, y, scales, s), abs=1e-6
    )
    information = np.asarray(found.information)
    white = J * sd / s
    np.testing.assert_allclose(information.T @ information, white.T @ white, rtol=1e-8)
