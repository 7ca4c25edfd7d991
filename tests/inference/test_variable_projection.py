"""Parameters that a model is linear in: solved for at starts, and in each descent."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.stats
from jaxtyping import Array

from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import estimate
from sim2gp.inference.groups import Start, estimate_groups
from sim2gp.inference.least_squares import factor
from sim2gp.inference.levenberg_marquardt import evaluate, relaxed
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.variable_projection import SHAPES, projected

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


def at_rate(rate):
    """Whitened parameters, the weights at zero."""
    return prior().gaussian.whitened(TABLE.unconstrain(jnp.asarray([rate, 0.0, 0.0])))


def test_a_start_has_the_noise_of_highest_evidence():
    """The noise of highest evidence, and the ridge solution under it, at the better
    rate: the given one."""
    likelihood = waves()
    start, noise, less = projected(likelihood, prior(), at_rate(RATE + 0.1))
    about = prior().gaussian
    rate = float(TABLE.constrain(about.at(start))[0])
    assert rate == pytest.approx(RATE + 0.1)
    assert bool(less)
    A = 2.0 * np.stack([np.sin(rate * T), np.cos(rate * T)], axis=1)
    y = np.asarray(likelihood.y)

    def cost(log_variance):
        C = A @ A.T + np.exp(log_variance) * np.eye(T.size)
        # Two more samples at the floor, as everywhere.
        floor = log_variance + 1e-12 / np.exp(log_variance)
        return -scipy.stats.multivariate_normal(cov=C).logpdf(y) + floor

    best = scipy.optimize.minimize_scalar(cost, (-6.0, 0.0), tol=1e-12).x
    assert float(noise[0]) == pytest.approx(np.exp(0.5 * best), rel=1e-5)
    ridge = np.linalg.solve(A.T @ A + np.exp(best) * np.eye(2), A.T @ y)
    np.testing.assert_allclose(start[1:], ridge, atol=1e-6)


def test_many_weights_do_not_leave_few_rows_less_noise():
    """Of noise alone: forty weights, sixty rows."""
    rng = np.random.default_rng(1)
    free = (
        Parameter(f"w{k}", "1", "", "identity", sd=2.0, group="w") for k in range(40)
    )
    table, y = Parameters(tuple(free)), jnp.asarray(rng.normal(size=60))
    A = jnp.asarray(rng.normal(size=(60, 40)))

    class Noisy(Waves):
        def residual(self, tt):
            return A @ tt - self.y

    likelihood = Noisy(jnp.full((1, 1), 60.0), jnp.full(1, 1e-6), y)
    about = ParameterPrior(table.prior(), table)
    _, noise, less = projected(likelihood, about, jnp.zeros(40))
    assert not bool(less)
    assert float(noise[0]) > 0.9 * float(jnp.std(y))


def test_a_descent_from_there_finds_what_one_from_the_mean_does_not():
    likelihood, unit = waves(), jnp.ones(1)
    start, left, _ = projected(likelihood, prior(), at_rate(RATE + 0.1))

    @eqx.filter_jit
    def fit(z, sd):
        noise = Noise(sd, unit)
        return estimate(likelihood, prior(), starts=z, noise=noise)

    good = fit(start[None], left)
    poor = fit(jnp.zeros((1, 3)), likelihood.first_noise().sd)
    assert float(good.noise.sd[0]) == pytest.approx(NOISE, rel=0.2)
    assert float(good.log_evidence) > float(poor.log_evidence) + 50.0


@pytest.mark.parametrize("rate", [0.7, np.nan])
def test_the_mean_is_better_than_a_start_that_explains_less(rate):
    start, noise, _ = projected(waves(), prior(), at_rate(rate))
    assert float(start[0]) == 0.0
    assert np.isfinite(float(noise[0]))


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


EDGE = 2.9
ABRUPT = Parameters(
    (
        Parameter("rate", "1/s", "", "bounded", 0.5, 60.0),
        Parameter("w", "1", "", "identity", sd=2.0, group="w"),
        Parameter("edge", "s", "", "log", 0.0, np.inf, 0.7, 0.6, group="w", shape=True),
    )
)


class Late(Waves):
    """A wave from an edge on: its rate is hard to draw, the edge to descend to."""

    def residual(self, tt):
        rate, w, edge = ABRUPT.constrain(tt)
        began = 0.5 * (1.0 + jnp.tanh((T - edge) / 0.01))
        return w * began * jnp.sin(rate * T) - self.y


def late() -> tuple[Late, ParameterPrior, Array]:
    """Data, the prior, and the true parameters, whitened."""
    rng = np.random.default_rng(0)
    y = 0.8 * (T > EDGE) * np.sin(47.0 * T) + 0.02 * rng.normal(size=T.size)
    likelihood = Late(
        jnp.full((1, 1), float(T.size)), jnp.full(1, 1e-6), jnp.asarray(y)
    )
    about = ParameterPrior(ABRUPT.prior(), ABRUPT)
    true = about.gaussian.whitened(ABRUPT.unconstrain(jnp.asarray([47.0, 0.8, EDGE])))
    return likelihood, about, true


def test_a_shape_is_searched_from_the_parameters_that_are_given():
    """To the nearest point of the search; the rate is that of ``also``."""
    likelihood, about, true = late()
    also = true.at[1:].set(0.0)
    start, noise, _ = projected(likelihood, about, also)
    assert float(start[0]) == pytest.approx(float(also[0]))
    spacing = float(SHAPES[1] - SHAPES[0])
    assert abs(float(start[2] - true[2])) < 0.51 * spacing
    assert float(start[1]) == pytest.approx(float(true[1]), rel=0.2)
    alone = projected(likelihood, about, jnp.zeros(3)).noise
    assert float(noise[0]) < 0.5 * float(alone[0])


def test_no_shape_is_searched_where_a_fit_is_as_good():
    """The shape is the fit's where it has no more noise than that leaves."""
    likelihood, about, true = late()
    z, _, less = projected(likelihood, about, true)
    assert float(z[2]) == float(true[2])
    assert not bool(less)
    z, _, less = projected(likelihood, about, true.at[1:].set(0.0))
    assert float(z[2]) not in (0.0, float(true[2]))
    assert bool(less)


class WavesInWindows(Waves):
    """The same in eight windows of ten rows each."""

    def first_noise(self):
        return Noise(jnp.std(self.y)[None], jnp.ones(8))

    def blocks(self, tt, e, scale):
        J = jax.jacfwd(self.residual)(tt) @ scale
        rows = J.reshape(8, 10, -1), self.residual(tt).reshape(8, 10)
        return jax.vmap(factor)(*rows)[:, None]


def test_a_window_that_does_not_fit_counts_less():
    """Oracle: the fit of the rows without it."""
    one = waves()
    y = one.y.at[30:40].add(3.0)  # the fourth window was pushed
    pushed = WavesInWindows(jnp.full((8, 1), 10.0), one.floor, y)
    start = Start(at_rate(RATE), jnp.full(1, NOISE), jnp.ones(1), jnp.ones((), bool))
    without = np.delete(np.arange(T.size), np.arange(30, 40))

    def weights(found):
        return np.asarray(TABLE.constrain(found.posterior.mean))[1:]

    def squares(p):
        rate, *w = p
        fitted = w[0] * np.sin(rate * T) + w[1] * np.cos(rate * T)
        return (fitted - np.asarray(one.y))[without]

    oracle = scipy.optimize.least_squares(squares, [RATE, *WEIGHTS]).x[1:]
    robust = estimate_groups(pushed, prior(), start, 4.0)
    plain = estimate_groups(pushed, prior(), start)
    others = np.delete(np.asarray(robust.noise.weights), 3)
    assert float(robust.noise.weights[3]) < 0.15 * others.min()
    assert np.all(np.asarray(plain.noise.weights) == 1.0)
    far, near = (np.max(np.abs(weights(x) - oracle)) for x in (plain, robust))
    assert near < 0.01 < 0.3 < far
