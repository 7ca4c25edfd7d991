"""Several likelihoods as one, against closed forms and one dense least squares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from scipy.stats import multivariate_normal

import linear_system
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.stacked import Stacked
from sim2gp.systems import AbstractSystem, UniformRodArm

pytestmark = pytest.mark.usefixtures("float64")

START_SD = np.asarray([0.3, 0.7])  # of the windows' start states
SD, WEIGHTS = np.asarray([0.2, 0.5, 0.4, 0.1]), np.asarray([1.0, 0.5, 2.0, 1.5])


def fit(
    likelihood: AbstractLikelihood,
    system: AbstractSystem,
    noise: Noise | None,
    learn: bool = False,
) -> Estimate:
    """From the prior's mean; unless it is to ``learn`` the noise stays."""
    table = system.parameters
    found = estimate(
        likelihood,
        ParameterPrior(table.prior(), table),
        starts=jnp.zeros((1, len(table))),
        noise=noise,
        learn=learn,
    )
    found.convergence.check(table.names, "a test")
    return found


def linear_data(
    p: int = 3,
) -> tuple[AbstractSystem, OneStepLikelihood, WindowsLikelihood]:
    """Eight transitions, and three windows of one row from start states of their own.

    Two channels each; the transitions have no nuisances, the windows two.
    """
    rng, system = np.random.default_rng(5), linear_system.linear(p, 2)
    J, y = rng.standard_normal((8, 2, p)), rng.standard_normal((8, 2))
    one_step = OneStepLikelihood(system, linear_system.transitions(J, y), 1.0)
    J, y = rng.standard_normal((3, 2, p)), rng.standard_normal((3, 2))
    windows = linear_system.windows_of(J, y, np.zeros(3))
    sd = np.broadcast_to(START_SD[None], (3, 2))
    windows = Windows(**{**vars(windows), "start_sd": np.asarray(sd)})
    return system, one_step, WindowsLikelihood(system, windows)


def rows_of(part: AbstractLikelihood) -> tuple[np.ndarray, np.ndarray]:
    """Jacobian and target of each row and channel, read from the data."""
    if isinstance(part, OneStepLikelihood):
        A, y = part.data.action, part.data.delta()
    else:
        assert isinstance(part, WindowsLikelihood)
        A, y = part.windows.area[:, 1], part.windows.y[:, 1]
    y = np.asarray(y, float)
    return np.asarray(A, float).reshape(*y.shape, -1), y


@pytest.mark.nightly
def test_linear_likelihoods_have_the_posterior_of_both_data_sets() -> None:
    """Mean, covariance and evidence in closed form; the order changes nothing."""
    system, one_step, windows = linear_data()
    (J1, y1), (J2, y2) = rows_of(one_step), rows_of(windows)
    A = np.concatenate([J1.reshape(-1, 3), J2.reshape(-1, 3)])
    y = np.concatenate([y1.ravel(), y2.ravel()])
    first = np.broadcast_to(SD[:2] ** 2 / WEIGHTS[0], (8, 2))
    second = SD[None, 2:] ** 2 / WEIGHTS[1:, None] + START_SD[None] ** 2
    V = np.diag(np.concatenate([first.ravel(), second.ravel()]))
    precision = np.eye(3) + A.T @ np.linalg.solve(V, A)
    covariance = np.linalg.inv(precision)
    mean = covariance @ A.T @ np.linalg.solve(V, y)
    evidence = multivariate_normal.logpdf(y, np.zeros(len(y)), A @ A.T + V)

    found = fit(
        Stacked([one_step, windows]),
        system,
        Noise(jnp.asarray(SD), jnp.asarray(WEIGHTS)),
    )
    turned = fit(
        Stacked([windows, Stacked([one_step])]),
        system,
        Noise(jnp.asarray(np.roll(SD, 2)), jnp.asarray(np.roll(WEIGHTS, -1))),
    )
    for each in (found, turned):
        np.testing.assert_allclose(each.posterior.mean, mean, atol=1e-10)
        np.testing.assert_allclose(each.posterior.covariance(), covariance, atol=1e-10)
        assert float(each.log_evidence) == pytest.approx(evidence, rel=1e-10)
    # The transitions' padded nuisances stay at nothing.
    np.testing.assert_array_equal(found.nuisances[0], 0.0)
    assert np.all(np.abs(found.nuisances[1:]) > 1e-3)


def test_each_likelihood_has_its_own_noise() -> None:
    """EM's fixed point in both channels of both: by hand, from the joint posterior."""
    system, one_step, windows = linear_data()
    stack = Stacked([one_step, windows])
    first = stack.first_noise()
    np.testing.assert_array_equal(first.sd[:2], one_step.first_noise().sd)
    np.testing.assert_array_equal(first.sd[2:], windows.first_noise().sd)
    found = fit(stack, system, None, learn=True)
    (J1, y1), (J2, y2) = rows_of(one_step), rows_of(windows)
    mean, C = found.posterior.mean, found.posterior.covariance()
    r = np.einsum("nci,i->nc", J1, mean) - y1
    spread = np.einsum("nci,ij,ncj->nc", J1, C, J1)
    floor = np.asarray(one_step.floor)
    variance = (2.0 * floor**2 + np.sum(r**2 + spread, axis=0)) / 10.0
    np.testing.assert_allclose(found.noise.sd[:2] ** 2, variance, rtol=1e-5)
    # A start state takes its part of each residual, and adds its own spread.
    r = np.einsum("nci,i->nc", J2, mean) - y2
    sd, start = np.asarray(found.noise.sd[2:]), START_SD
    kept = sd**2 / (sd**2 + start**2)
    left = kept * r
    spread = kept**2 * np.einsum("nci,ij,ncj->nc", J2, C, J2) + kept * start**2
    floor = np.asarray(windows.floor)
    variance = (2.0 * floor**2 + np.sum(left**2 + spread, axis=0)) / 5.0
    np.testing.assert_allclose(sd**2, variance, rtol=1e-3)


def arm_data() -> tuple[AbstractSystem, OneStepLikelihood, WindowsLikelihood]:
    """The paper's arm: 12 steps of exact states, and 2 windows of positions."""
    rng, system = np.random.default_rng(2), UniformRodArm()
    params, dt, count = system.nominal(), 0.02, 12
    step = jax.jit(lambda s, a: system.step(params, s, a, dt))

    def rolled(s: np.ndarray, A: np.ndarray) -> np.ndarray:
        S = [s]
        for a in A:
            S.append(np.asarray(step(jnp.asarray(S[-1]), jnp.asarray(a))))
        return np.stack(S)

    A = rng.uniform(-1.0, 1.0, (count, 2))
    S = rolled(np.asarray([0.1, -0.4, 0.5, 1.0]), A)
    S2 = S[1:] + np.asarray([1e-3, 1e-3, 2e-2, 2e-2]) * rng.standard_normal((count, 4))
    one_step = OneStepLikelihood(system, Transitions.of(S[:-1], A, S2), dt)
    A = np.repeat(rng.uniform(-1.0, 1.0, (2, 1, 2)), count, axis=1)
    S = np.stack([rolled(rng.standard_normal(4), each) for each in A])
    y = S[..., :2] + 2e-3 * rng.standard_normal((2, count + 1, 2))
    time = np.broadcast_to(dt * np.arange(count + 1.0)[None], (2, count + 1))
    area = np.concatenate([np.zeros((2, 1, 2)), dt * np.cumsum(A, axis=1)], axis=1)
    windows = Windows(
        np.diff(time, axis=1, prepend=0.0),
        np.asarray(time),
        area,
        y,
        np.ones(y.shape, bool),
        S[:, 0] + 0.02 * rng.standard_normal((2, 4)),
        np.full((2, 4), 0.05),
        np.full(2, 1e-5),
        np.zeros(2, np.int32),
        (0, 1),
    )
    return system, one_step, WindowsLikelihood(system, windows)


@pytest.mark.nightly
def test_one_step_data_and_windows_of_an_arm_are_one_least_squares() -> None:
    """MAP and Gauss-Newton covariance against scipy's dense solver of all residuals."""
    system, one_step, windows = arm_data()
    prior, p = system.parameters.prior(), len(system.parameters)
    sd = jnp.asarray([1e-3, 1e-3, 2e-2, 2e-2, 2e-3, 2e-3])
    found = fit(Stacked([one_step, windows]), system, Noise(sd, jnp.ones(3)))

    def residuals(x: jax.Array) -> jax.Array:
        z, e = x[:p], x[p:].reshape(2, 4)
        tt = prior.at(z)
        step, _ = one_step.rows(tt, prior.scale)
        rows = windows.windows.each(lambda w, e: windows.simulated(w, tt, e)[0], e)
        step, rows = step / sd[None, :4], rows / sd[None, None, 4:]
        return jnp.concatenate([step.ravel(), rows.ravel(), x])

    slopes, values = jax.jit(jax.jacfwd(residuals)), jax.jit(residuals)
    dense = scipy.optimize.least_squares(
        lambda x: np.asarray(values(jnp.asarray(x))),
        np.zeros(p + 8),
        jac=lambda x: np.asarray(slopes(jnp.asarray(x))),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-12,
    )
    covariance = np.linalg.inv(dense.jac.T @ dense.jac)[:p, :p]
    scale = np.asarray(prior.scale)
    away = found.posterior.mean - np.asarray(prior.at(jnp.asarray(dense.x[:p])))
    # A descent ends where a step saves less than 1e-12 of the cost.
    assert np.max(np.abs(away / found.posterior.sd())) < 2e-6
    np.testing.assert_allclose(
        found.posterior.covariance(), scale @ covariance @ scale.T, rtol=1e-5
    )
    np.testing.assert_allclose(
        found.nuisances[1:], dense.x[p:].reshape(2, 4), atol=1e-6
    )
    # Either alone is another answer.
    for part, channels, rows in ((one_step, sd[:4], 1), (windows, sd[4:], 2)):
        alone = fit(part, system, Noise(channels, jnp.ones(rows)))
        assert np.all(alone.posterior.sd() > found.posterior.sd())
