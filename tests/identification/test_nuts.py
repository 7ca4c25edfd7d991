"""NUTS against a posterior that quadrature knows, and its verdicts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.stats import norm

from descents import minimise, standard
from sim2gp.identification.exact_posterior.nuts import (
    ChainSummary,
    sample_posterior,
    summarise_chains,
)
from sim2gp.inference.arrowhead import Blocks, Noise
from sim2gp.inference.least_squares import factor
from sim2gp.inference.likelihood import AbstractLikelihood

GOOD = ChainSummary(np.zeros(2), np.ones(2), 1.001, 900.0, 0)


class Bent(AbstractLikelihood):
    """``y_w = exp(z / 2) e_w + eps``: the nuisances' spread is the constant."""

    counts: Float[Array, "W c"]
    floor: Float[Array, " c"]
    y: Float[Array, " W"]

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
        a = jnp.exp(0.5 * z[0])

        def one(y: Array, e: Array) -> Array:
            return factor(jnp.stack([a, 0.5 * a * e[0]])[None], a * e - y)[None]

        return jax.vmap(one)(self.y, e)


@pytest.mark.nightly
def test_moments_are_those_of_the_marginal_posterior() -> None:
    """``y_w ~ N(0, e^z + sd^2)``: Laplace's mode and sd of it are far off."""
    y, sd = np.asarray([-1.9, 0.4, 1.1, -0.7, 2.3, 0.2]), 0.3
    grid = np.linspace(-6.0, 6.0, 4001)
    log = norm.logpdf(y[:, None], 0.0, np.sqrt(np.exp(grid) + sd**2)).sum(axis=0)
    log += norm.logpdf(grid)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ grid
    spread = np.sqrt(weight @ (grid - mean) ** 2)
    with jax.enable_x64(True):
        noise = Noise(jnp.full(1, sd), jnp.ones(len(y)))
        likelihood = Bent(jnp.ones((len(y), 1)), jnp.zeros(1), jnp.asarray(y))
        # About a point that is not the mode: coordinates alone rest on it.
        e = minimise(likelihood, jnp.zeros(1), jnp.zeros((len(y), 1)), noise).e
        z = jnp.full(1, 0.2)
        found, lost = sample_posterior(
            likelihood, standard(1), z, e, noise, jax.random.key(1)
        )
        R = _precision(z, e, sd)
    unit = np.full((1, 1), 1.0 / R)
    result = summarise_chains(np.asarray(found), np.asarray(lost), unit)
    assert result.r_hat < 1.05
    error = 5.0 * spread / np.sqrt(result.draws)
    assert 0.2 + result.shift[0] == pytest.approx(mean, abs=error)
    assert result.ratio[0] == pytest.approx(spread, rel=0.15)
    assert abs(0.2 - mean) > error


def _precision(z: Array, e: Array, sd: float) -> float:
    """The factor that the coordinates are standardised by, by hand."""
    a = np.exp(0.5 * float(z[0])) / sd
    by_z = 0.5 * a * np.asarray(e)[:, 0]
    schur = 1.0 + np.sum(by_z**2) - np.sum((by_z * a) ** 2 / (1.0 + a**2))
    return float(np.sqrt(schur))


@pytest.mark.nightly
def test_chains_that_do_not_meet_say_nothing() -> None:
    rng = np.random.default_rng(0)
    draws = rng.standard_normal((4, 250, 2))
    lost = np.zeros((4, 250), bool)
    fine = summarise_chains(draws, lost, np.eye(2))
    assert fine.mixed
    assert not fine.far().any()
    assert "agrees" in fine.words(("a", "b"))
    draws[0, :, 1] += 2.0
    apart = summarise_chains(draws, lost, np.eye(2))
    assert apart.r_hat > 1.1
    assert not apart.mixed
    assert "did not settle" in apart.words(("a", "b"))
    drift = summarise_chains(
        rng.standard_normal((4, 250, 1)) + np.linspace(-2, 2, 250)[:, None],
        lost,
        np.eye(1),
    )
    assert drift.r_hat > 1.1


def test_a_constant_is_a_direction_of_the_standardised_ones() -> None:
    draws = np.random.default_rng(1).standard_normal((4, 250, 2)) * [1.0, 3.0]
    unit = np.asarray([[0.6, 0.8], [1.0, 0.0]])
    found = summarise_chains(draws, np.zeros((4, 250), bool), unit)
    np.testing.assert_allclose(found.ratio, [np.hypot(0.6, 2.4), 1.0], rtol=0.1)


def test_what_differs_is_named() -> None:
    moved = replace(GOOD, shift=np.asarray([0.0, 1.2]), ratio=np.asarray([2.0, 1.0]))
    words = moved.words(("a", "b"))
    assert "a (mean by 0.0 sd, sd times 2.00)" in words
    assert "b (mean by 1.2 sd" in words
    assert not replace(GOOD, divergent=1).mixed
    assert not replace(GOOD, draws=399.0).mixed
    assert not replace(GOOD, r_hat=np.nan).mixed
    assert replace(GOOD, r_hat=np.nan).as_dict(("a", "b"))["r_hat"] is None
