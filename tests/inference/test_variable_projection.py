"""Parameters that a model is linear in: solved for at starts, and in each descent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jaxtyping import Array

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import estimate
from sim2gp.inference.least_squares import factor
from sim2gp.inference.levenberg_marquardt import evaluate, relaxed
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.variable_projection import projected

pytestmark = pytest.mark.usefixtures("float64")
T = np.linspace(0.0, 4.0, 80)
RATE, WEIGHTS, NOISE = 5.0, (0.8, -1.3), 0.05
TABLE = Parameters(
    (
        Parameter("rate", "1/s", "", "bounded", 0.5, 6.0),
        *(Parameter(f"w{k}", "1", "", "identity", sd=2.0, group="w") for k in (1, 2)),
    )
)


class Waves(AbstractLikelihood):
    """``w1 sin(rate t) + w2 cos(rate t)``: many optima in the rate, linear in ``w``."""

    counts: Array
    floor: Array
    y: Array

    @property
    def n_nuisances(self):
        return 0

    def first_noise(self):
        return Noise(jnp.std(self.y)[None], jnp.ones(1))

    def residual(self, tt):
        rate, *w = TABLE.constrain(tt)
        return w[0] * jnp.sin(rate * T) + w[1] * jnp.cos(rate * T) - self.y

    def blocks(self, tt, e, scale):
        J = jax.jacfwd(self.residual)(tt) @ scale
        return factor(J, self.residual(tt))[None, None]


def waves() -> Waves:
    rng = np.random.default_rng(0)
    y = WEIGHTS[0] * np.sin(RATE * T) + WEIGHTS[1] * np.cos(RATE * T)
    y = jnp.asarray(y + NOISE * rng.normal(size=T.size))
    return Waves(jnp.full((1, 1), float(T.size)), jnp.full(1, 1e-6), y)


def prior() -> ParameterPrior:
    return ParameterPrior(TABLE.prior(), TABLE)


def test_the_best_draw_has_its_weights_and_noise_at_the_profile():
    """As scipy finds them at the same rate; and the rate is near the true one."""
    likelihood = waves()
    starts, noises = projected(likelihood, prior(), 64, 2, jax.random.key(0))
    about = prior().gaussian
    tt = np.asarray(about.at(starts[0]))
    assert float(TABLE.constrain(jnp.asarray(tt))[0]) == pytest.approx(RATE, abs=0.1)

    def cost(x):
        z = np.asarray(starts[0]).copy()
        z[1:] = x[:2]
        r = np.asarray(likelihood.residual(about.at(jnp.asarray(z))))
        # Two more samples at the floor, as everywhere.
        scatter = (2e-12 + r @ r) / (2.0 + r.size)
        return 0.5 * r.size * np.log(scatter) + 0.5 * (x[:2] @ x[:2])

    best = scipy.optimize.minimize(cost, np.asarray(starts[0])[1:], tol=1e-12)
    np.testing.assert_allclose(starts[0, 1:], best.x, atol=1e-4)
    r = likelihood.residual(jnp.asarray(tt))
    assert float(noises[0, 0]) == pytest.approx(
        float(jnp.sqrt(jnp.mean(r**2))), rel=0.02
    )
    assert float(noises[0, 0]) <= float(noises[1, 0])  # best first


def test_a_descent_from_there_finds_what_one_from_the_mean_does_not():
    likelihood, unit = waves(), jnp.ones(1)
    starts, noises = projected(likelihood, prior(), 64, 1, jax.random.key(0))

    @eqx.filter_jit
    def fit(z, sd):
        noise = Noise(sd, unit)
        return estimate(likelihood, prior(), starts=z, noise=noise)

    good = fit(starts, noises[0])
    poor = fit(jnp.zeros((1, 3)), likelihood.first_noise().sd)
    assert float(good.noise.sd[0]) == pytest.approx(NOISE, rel=0.2)
    assert float(good.log_evidence) > float(poor.log_evidence) + 50.0


def test_relaxed_weights_are_the_ridge_solution():
    """And the point's cost and gradient are those at it, without a linearisation."""
    likelihood, about = waves(), prior().gaussian
    noise, z = Noise(jnp.full(1, 0.1), jnp.ones(1)), jnp.asarray([0.4, 0.0, 1.0])
    none = jnp.zeros((1, 0))
    here = relaxed(prior(), evaluate(likelihood, prior(), z, none, noise), noise)
    assert float(here.z[0]) == float(z[0])
    rate = float(TABLE.constrain(about.at(z))[0])
    A = 2.0 / 0.1 * np.stack([np.sin(rate * T), np.cos(rate * T)], axis=1)
    ridge = np.linalg.solve(A.T @ A + np.eye(2), A.T @ np.asarray(likelihood.y) / 0.1)
    np.testing.assert_allclose(here.z[1:], ridge, atol=1e-10)
    np.testing.assert_allclose(here.by_z[1:], 0.0, atol=1e-9)
    there = evaluate(likelihood, prior(), here.z, none, noise)
    assert float(here.cost) == pytest.approx(float(there.cost), rel=1e-12)
