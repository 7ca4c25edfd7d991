"""Pareto-smoothed importance sampling against closed forms."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.stats import genpareto, norm
from scipy.stats import t as student

from descents import standard
from sim2gp.identification.exact_posterior.importance import (
    DRAWS,
    ImportanceCheck,
    _log_posterior,
    check_weights,
    pareto,
    pareto_smooth,
)
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.least_squares import factor
from sim2gp.inference.likelihood import AbstractLikelihood


@pytest.mark.parametrize("k", [-0.3, 0.0, 0.4, 0.9])
def test_the_shape_of_a_tail_is_found(k: float) -> None:
    """Quantiles of the law itself; the estimate is drawn to .5 by ten values."""
    n = 4000
    x = genpareto.ppf((np.arange(n) + 0.5) / n, k, scale=3.0)
    got, scale = pareto(x)
    assert got == pytest.approx((n * k + 5.0) / (n + 10.0), abs=0.01)
    assert scale == pytest.approx(3.0, rel=0.02)


def test_few_values_are_drawn_to_one_half() -> None:
    x = genpareto.ppf((np.arange(10) + 0.5) / 10, -0.5)
    assert -0.5 < pareto(x)[0] < 0.5


def test_the_right_gaussian_has_equal_weights() -> None:
    draws = np.random.default_rng(0).standard_normal((DRAWS, 2))
    found = check_weights(np.full(DRAWS, 7.0), draws)
    assert found.verdict == "fine"
    assert found.k == -math.inf
    assert found.draws == pytest.approx(DRAWS)
    np.testing.assert_allclose(found.shift, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.ratio, 1.0)
    assert found.as_dict(("a", "b"))["k"] is None
    assert "all weights alike, 256" in found.words(("a", "b"))


def test_weights_of_a_known_tail() -> None:
    """``p(w > x) ~ x^-1/k``."""
    for k in (0.3, 0.6, 1.0):
        w = (1.0 - (np.arange(4000) + 0.5) / 4000) ** -k
        assert pareto_smooth(np.log(w))[1] == pytest.approx(k, abs=0.04)


def test_moments_of_another_gaussian() -> None:
    """A posterior moved by .3 sd and .8 as wide: inside what the draws reach."""
    x = norm.ppf((np.arange(4000) + 0.5) / 4000)
    log_weights = norm.logpdf(x, 0.3, 0.8) - norm.logpdf(x)
    found = check_weights(log_weights + 50.0, x[:, None])
    assert found.k < 0.5
    assert found.verdict == "fine"
    assert found.shift[0] == pytest.approx(0.3, abs=0.01)
    assert found.ratio[0] == pytest.approx(0.8, abs=0.01)


def test_a_posterior_with_heavier_tails_is_not_trusted() -> None:
    """Student's t with two degrees of freedom: the ratio to a Gaussian has no mean."""
    x = np.random.default_rng(1).standard_normal((DRAWS, 1))
    wide = 3.0 * x  # draws of q = N(0, 1) of a posterior three times as wide
    found = check_weights(norm.logpdf(x[:, 0], 0.0, 3.0) - norm.logpdf(x[:, 0]), x)
    assert found.k > 0.7
    assert found.verdict == "not to be trusted"
    right = check_weights(student.logpdf(wide[:, 0], 30) - norm.logpdf(x[:, 0]), x)
    assert right.k > check_weights(np.zeros(DRAWS), x).k


def test_a_gaussian_that_is_too_wide_is_strained() -> None:
    """As along a curved ridge: light tails, and another spread."""
    x = np.random.default_rng(2).standard_normal((DRAWS, 2))
    found = check_weights(norm.logpdf(x[:, 0], 0.0, 0.4) - norm.logpdf(x[:, 0]), x)
    assert found.k < 0.5
    assert found.verdict == "strained"
    assert found.far().tolist() == [True, False]
    assert "it differs in a (mean by" in found.words(("a", "b"))


def test_a_draw_that_fails_has_no_weight() -> None:
    x = np.random.default_rng(3).standard_normal((DRAWS, 1))
    log_weights = np.zeros(DRAWS)
    log_weights[x[:, 0] > 1.0] = np.nan
    found = check_weights(log_weights, x)
    assert found.shift[0] < -0.1
    nothing = check_weights(np.full(DRAWS, np.nan), x)
    assert nothing.verdict == "not to be trusted"
    assert nothing.as_dict(("a",))["constants"]["a"] == {
        "shift": None,
        "sd_ratio": None,
    }
    assert "too few to say" in nothing.words(("a",))


@pytest.mark.parametrize(
    ("k", "verdict"),
    [(0.2, "fine"), (0.6, "strained"), (0.8, "not to be trusted"),
     (math.inf, "not to be trusted"), (math.nan, "not to be trusted")],
)  # fmt: skip
def test_words_follow_the_shape(k: float, verdict: str) -> None:
    assert ImportanceCheck(k, 200.0, np.zeros(1), np.ones(1)).verdict == verdict


class Product(AbstractLikelihood):
    """``y = z e + eps``: linear in the nuisance, whose weight is the constant."""

    counts: Float[Array, "W c"]
    floor: Float[Array, " c"]
    y: float

    @property
    def n_nuisances(self) -> int:
        return 1

    def first_noise(self) -> Noise:
        return Noise(jnp.ones(1), jnp.ones(len(self.counts)))

    def blocks(
        self,
        z: Float[Array, " p"],
        e: Float[Array, "W n"],
        scale: Float[Array, "p p"],
    ) -> Blocks:
        J = jnp.stack([z, e[0]], axis=1)
        return factor(J, z * e[0] - self.y)[None, None]


def test_nuisances_are_integrated_not_fitted() -> None:
    """``p(y | z) = N(y; 0, sig^2 + z^2)``, in closed form."""
    z, sd, y = np.linspace(0.2, 3.0, 8), 0.5, 1.3
    with jax.enable_x64(True):
        noise = Noise(jnp.full(1, sd), jnp.ones(1))
        start = jnp.full((1, 1), 0.1)
        likelihood = Product(jnp.ones((1, 1)), jnp.zeros(1), y)
        draws = jnp.asarray(z[:, None])
        found = _log_posterior(likelihood, standard(1), draws, start, noise)
    want = norm.logpdf(y, 0.0, np.hypot(sd, z)) + norm.logpdf(z)
    got = np.asarray(found)
    np.testing.assert_allclose(got - got[0], want - want[0], atol=1e-9)
