"""Corrected intervals: closed forms of the linear-Gaussian case, and what must hold."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from beliefs import believe, named, study
from linear_system import Linear as Machine
from linear_system import linear
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood, linearise
from sim2gp.errors import NotFinite
from sim2gp.identification.exact_posterior.importance import DRAWS, check_windows
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals import scatter as intervals
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.intervals.pulls import (
    Pulls,
    pulls_of_windows,
    rows_of,
)
from sim2gp.identification.intervals.scatter import correct_posterior
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter, Parameters

W, L, P = 40, 10, 3
ROWS = W * L
#: Of coverage over 200 sets at 95 %, all but one time in a thousand.
LOW, HIGH = 0.895, 0.990


def gaussian(mean: np.ndarray, scale: np.ndarray) -> Gaussian:
    with jax.enable_x64(True):
        return Gaussian(jnp.asarray(mean, float), jnp.asarray(scale, float))


class Linear:
    """``y = J z + eps`` in windows, with the prior N(0, 1) on ``z``."""

    def __init__(self, J: np.ndarray) -> None:
        self.J, p = J, J.shape[-1]
        flat = J.reshape(-1, p)
        self.F = flat.T @ flat
        self.H = self.F + np.eye(p)
        self.prior = gaussian(np.zeros(p), np.eye(p))
        self.group = np.zeros(len(J), int)

    def fit(self, y: np.ndarray) -> tuple[Gaussian, Pulls]:
        """The posterior for white noise of variance 1, and the windows' pulls."""
        z = np.linalg.solve(self.H, np.einsum("wlp,wl->p", self.J, y))
        r = self.J @ z - y
        scores = np.einsum("wlp,wl->wp", self.J, r)
        scale = np.linalg.inv(np.linalg.cholesky(self.H)).T
        return gaussian(z, scale), Pulls(self.J, scores, self.group)

    def corrected(self, y: np.ndarray) -> tuple["Plain", "Plain"]:
        """Plain and corrected, in numpy."""
        p, pulls = self.fit(y)
        return Plain(p), Plain(correct_posterior(self.prior, p, pulls).posterior)


class Plain:
    """Mean and covariance of a Gaussian in float64, wherever one asks."""

    def __init__(self, of: Gaussian) -> None:
        scale = np.asarray(of.scale)
        self.mean, self.C = np.asarray(of.mean), scale @ scale.T
        self.sd = np.sqrt(np.diag(self.C))


def smooth(rng: np.random.Generator, size: float = 0.3) -> np.ndarray:
    """Sensitivities of a moving machine: slow sines."""
    t = np.arange(ROWS)[:, None]
    period = rng.uniform(15.0, 60.0, (3, 1, P))
    waves = np.sin(2 * np.pi * t / period + rng.uniform(0, 6.3, (3, 1, P)))
    return size * waves.sum(axis=0).reshape(W, L, P)


def ar1(rng: np.random.Generator, rho: float) -> np.ndarray:
    e = np.sqrt(1.0 - rho**2) * rng.standard_normal(ROWS)
    first = [rho * rng.standard_normal()]
    return scipy.signal.lfilter([1.0], [1.0, -rho], e, zi=first)[0].reshape(W, L)


def covered(model: Linear, rho: float, sets: int, seed: int) -> tuple[float, float]:
    """Coverage of nominal 95 %, all constants together, and the median width ratio."""
    rng, inside, ratio = np.random.default_rng(seed), [], []
    for _ in range(sets):
        z = rng.standard_normal(P)
        plain, found = model.corrected(model.J @ z + ar1(rng, rho))
        inside.append(np.abs(found.mean - z) < 1.96 * found.sd)
        ratio.append(found.sd / plain.sd)
    return float(np.mean(inside)), float(np.median(ratio))


@pytest.mark.parametrize("b", [1, 4])
def test_the_scatter_of_pulls_has_fishers_information_for_its_mean(b: int) -> None:
    """Exactly, prior and small samples included: a quadratic form, entry by entry."""
    model = Linear(smooth(np.random.default_rng(0))[:8])
    R = np.linalg.cholesky(model.H).T
    total = np.zeros((P, P))
    for source in np.eye(8 * L + P):  # independent: the noise, then the truth
        y = model.J @ source[8 * L :] + source[: 8 * L].reshape(8, L)
        _, pulls = model.fit(y)
        # The prior's mean is zero, its spread that of the truth.
        rows = intervals._scatter(*intervals._whitened(pulls, R), b) @ R
        total += rows.T @ rows
    np.testing.assert_allclose(total, model.F, rtol=1e-9)


def test_white_noise_leaves_the_intervals() -> None:
    model = Linear(smooth(np.random.default_rng(1)))
    inside, ratio = covered(model, 0.0, 150, seed=2)
    assert LOW < inside < HIGH
    assert 1.0 <= ratio < 1.25


@pytest.mark.parametrize("rho", [0.8, 0.95])
def test_coloured_noise_is_covered(rho: float) -> None:
    """Beside the closed form of the errors' covariance under the noise's own."""
    model = Linear(smooth(np.random.default_rng(3)))
    lag = np.abs(np.subtract.outer(np.arange(ROWS), np.arange(ROWS)))
    J = model.J.reshape(ROWS, P)
    root = np.linalg.solve(model.H, J.T @ np.linalg.cholesky(rho**lag))
    true = np.linalg.norm(np.hstack([root, np.linalg.inv(model.H)]), axis=1)
    wide = float(np.median(true / np.sqrt(np.diag(np.linalg.inv(model.H)))))
    inside, ratio = covered(model, rho, 150, seed=4)
    assert wide > 1.5
    assert 0.75 * wide < ratio < 1.35 * wide
    assert LOW < inside < HIGH


def test_between_the_plain_and_the_prior() -> None:
    rng = np.random.default_rng(5)
    for size in (0.01, 0.05, 0.3):
        model = Linear(smooth(rng, size))
        for rho in (-0.9, 0.0, 0.99):  # -0.9: samples say more than counted
            y = model.J @ np.ones(P) + 3.0 * ar1(rng, rho)
            plain, found = model.corrected(y)
            assert np.linalg.eigvalsh(found.C - plain.C).min() > -1e-12
            assert np.linalg.eigvalsh(found.C).max() < 1.0 + 1e-12
            # Data of any weight: the mean follows from the covariance.
            data = np.linalg.lstsq(model.J.reshape(ROWS, P), y.ravel())[0]
            want = (np.eye(P) - found.C) @ data
            np.testing.assert_allclose(found.mean, want, rtol=1e-6, atol=1e-9)


def test_what_the_data_do_not_see_stays_the_prior() -> None:
    rng = np.random.default_rng(6)
    J = smooth(rng)
    J[..., 2] = 0.0
    model = Linear(J)
    _, found = model.corrected(model.J @ np.ones(P) + ar1(rng, 0.9))
    assert abs(found.mean[2]) < 1e-12
    assert abs(found.sd[2] - 1.0) < 1e-12
    assert found.sd[0] < 0.5


def test_units_of_the_constants_do_not_matter() -> None:
    """Other coordinates of the same prior and data: the same belief."""
    rng = np.random.default_rng(7)
    model = Linear(smooth(rng))
    plain, pulls = model.fit(model.J @ np.ones(P) + ar1(rng, 0.9))
    found = Plain(correct_posterior(model.prior, plain, pulls).posterior)
    turn = np.linalg.qr(rng.standard_normal((P, P)))[0]
    A = rng.standard_normal((P, P))  # tt = A turn z' + 5: whitened coordinates z'
    prior = gaussian(np.full(P, 5.0), A @ turn)
    other = gaussian(A @ np.asarray(plain.mean) + 5.0, A @ np.asarray(plain.scale))
    turned = Pulls(pulls.factors @ turn, pulls.scores @ turn, pulls.group)
    same = Plain(correct_posterior(prior, other, turned).posterior)
    np.testing.assert_allclose(same.mean, A @ found.mean + 5.0, rtol=1e-9)
    np.testing.assert_allclose(same.C, A @ found.C @ A.T, rtol=1e-8, atol=1e-12)


def test_a_scatter_as_expected_is_the_plain_posterior() -> None:
    """Pulls of independent windows whose variance is Fisher's, of many windows."""
    rng = np.random.default_rng(8)
    model = Linear(np.tile(rng.standard_normal((8, 1, 2)), (400, 1, 1)))
    y = rng.permutation(np.repeat([1.0, -1.0], 1600))[:, None]
    plain, found = model.corrected(y)
    np.testing.assert_allclose(found.C, plain.C, rtol=0.1, atol=1e-6)


def test_recordings_are_not_joined() -> None:
    rng = np.random.default_rng(9)
    v, C = rng.standard_normal((6, 2)), 1e-3 * np.tile(np.eye(2), (6, 1, 1))

    def scatter(v: np.ndarray, *group: int) -> np.ndarray:
        pulls = Pulls(np.zeros((len(v), 1, 2)), v, np.array(group))
        return intervals._scatter(pulls, C[: len(v)], 2)

    apart = scatter(v, 0, 0, 0, 1, 1, 1)
    each = [scatter(v[i : i + 3], 0, 0, 0) for i in (0, 3)]
    np.testing.assert_allclose(apart, np.concatenate(each))
    assert len(apart) == 8
    assert len(scatter(v, 0, 0, 0, 0, 0, 0)) == 7


def test_a_lag_follows_the_likeness_of_successive_pulls() -> None:
    rng = np.random.default_rng(10)
    white = rng.standard_normal((400, 2))
    alike = np.cumsum(white, axis=0)
    alike = alike - 0.9 * np.concatenate([np.zeros((1, 2)), alike[:-1]])
    one = np.zeros(400, int)
    assert intervals._lag(white, 400.0, one) <= 2
    # rho = 1/2 / (1 + 1/2) ...: only that it grows, and is cut at a quarter.
    slow = np.repeat(white[:40], 10, axis=0)
    assert 10 < intervals._lag(slow, 400.0, one) <= 100
    assert intervals._lag(slow, 20.0, one) == 5
    assert intervals._lag(slow, 400.0, np.arange(400)) == 1


def test_too_few_windows_say_nothing() -> None:
    rng = np.random.default_rng(11)
    model = Linear(smooth(rng)[:3])
    plain, pulls = model.fit(rng.standard_normal((3, L)))
    found = correct_posterior(model.prior, plain, pulls)
    assert not found.enough
    assert found.posterior is plain


def test_what_is_not_a_number_is_refused() -> None:
    rng = np.random.default_rng(12)
    model = Linear(smooth(rng))
    plain, pulls = model.fit(rng.standard_normal((W, L)))
    for what in ("scores", "factors"):
        broken = {
            k: np.array(getattr(pulls, k)) for k in ("factors", "scores", "group")
        }
        broken[what][3] = np.nan
        with pytest.raises(NotFinite):
            correct_posterior(model.prior, plain, Pulls(**broken))


def test_a_corrected_posterior_changes_spreads_and_not_the_structure() -> None:
    """Wider and elsewhere: what is flat is reported as before, what is left is not."""
    table = named("a b c", low=-10.0)
    visible = np.array([[1.0, 3.0, 0.0], [0.0, 0.0, 1.0]]) * 20.0
    belief = believe(table, visible, [2.0, 5.0, 0.0])
    plain = study(*belief)
    with jax.enable_x64(True):
        wide = belief[2].scale.at[2].multiply(5.0)
        other = Gaussian(belief[2].mean + 0.1, wide)
    found = study(*belief, corrected=other)
    assert [d["flat"] for d in found["directions"]] == [True, False, False]
    for key in ("text", "value", "unit"):
        assert found["base_parameters"][0][key] == plain["base_parameters"][0][key]
    assert found["directions"][0] == plain["directions"][0]
    assert "25 % of the prior" in json.dumps(found["directions"])
    assert "25 % of the prior" not in json.dumps(plain["directions"])
    a, c = (found["parameters"][name] for name in "ac")
    assert a["verdict"] == plain["parameters"]["a"]["verdict"] == "traded_off"
    assert plain["parameters"]["c"]["verdict"] == "identified"
    assert c["verdict"] == "weak"  # 25 % of the prior's sd is more than 20
    assert c["widened"] == pytest.approx(5.0, rel=1e-6)
    assert a["mean"] == pytest.approx(2.1)
    assert "plain" not in plain["parameters"]["a"]
    for key, value in c["plain"].items():
        assert value == pytest.approx(plain["parameters"]["c"][key])
    with jax.enable_x64(True):
        other = Gaussian(belief[2].mean, belief[2].scale.at[2].multiply(16.0))
    open_now = json.dumps(study(*belief, corrected=other)["directions"])
    assert "The data determine c" in json.dumps(plain["directions"])
    assert "The data hardly determine c: 80 % of the prior" in open_now


def recorded(system: Machine, rows: int, rate: list[float], error: np.ndarray) -> Log:
    """Rows at 10 Hz of ``x' = a . rate`` under held inputs, measured with an error."""
    rng = np.random.default_rng(20)
    held = rng.standard_normal((rows // 4 + 1, 2))
    a = np.repeat(held, 4, axis=0)[:rows]
    x = np.cumsum(np.concatenate([[0.0], 0.1 * a[:-1] @ rate]))
    return Log(
        name="log",
        source="log.csv",
        time=0.1 * np.arange(rows),
        channels={"x0": x + error},
        inputs={"a0": a[:, 0], "a1": a[:, 1]},
        mask={"x0": np.ones(rows, bool)},
    )


def cost_of(likelihood: WindowsLikelihood, found: Estimate, tt: jax.Array) -> float:
    return rows_of(likelihood, found, tt, np.zeros(len(likelihood.windows), int)).cost


@pytest.fixture(scope="module")
def fitted() -> tuple[WindowsLikelihood, Estimate]:
    """A machine that is linear in constants and start states, three seconds of it."""
    system = linear(2, 1)
    noise = 0.02 * np.random.default_rng(21).standard_normal(31)
    windows, _ = cut([recorded(system, 31, [0.7, -0.4], noise)], system, window=0.6)
    found = fit_windows(system, windows, key=jax.random.key(0))
    return WindowsLikelihood(system, windows), found


def test_a_linear_machines_centre_is_where_the_gaussian_says(
    fitted: tuple[WindowsLikelihood, Estimate],
) -> None:
    """The misfit is the linear one, starts included, however far away."""
    likelihood, belief = fitted
    of = np.zeros(len(likelihood.windows), int)
    pulls = pulls_of_windows(likelihood, belief, of)
    at = np.asarray(belief.posterior.mean)
    dz = np.array([0.8, -1.1])
    answer = dz @ pulls.scores.sum(axis=0)
    answer += 0.5 * np.sum((pulls.factors @ dz) ** 2)
    with jax.enable_x64(True):
        there, here = (
            cost_of(likelihood, belief, jnp.asarray(x)) for x in (at + dz, at)
        )
    assert there - here == pytest.approx(answer, rel=1e-6)
    ours = corrected_windows(at_zero(likelihood, belief, of))
    plain = correct_posterior(belief.prior, belief.posterior, pulls)
    np.testing.assert_allclose(ours.posterior.mean, plain.posterior.mean, atol=1e-12)


@pytest.mark.nightly
def test_a_constant_at_its_bound_stays_where_the_data_are() -> None:
    """Its map is flat there: with less data the Gaussian alone leaves for the prior."""
    at = Parameter("k1", "1", "slope", "bounded", low=0.0, high=4.0)
    system = linear(1, 1)
    system = Machine(Parameters((*system.parameters.free, at)), 1)
    rng = np.random.default_rng(22)
    drift = 0.05 * ar1(rng, 0.97).ravel()[:301]
    windows, _ = cut([recorded(system, 301, [0.7, 0.0], drift)], system, window=0.8)
    belief = fit_windows(system, windows, key=jax.random.key(0))
    likelihood = WindowsLikelihood(system, windows)
    pulls = pulls_of_windows(likelihood, belief, of := np.zeros(len(windows), int))
    naive = correct_posterior(belief.prior, belief.posterior, pulls)
    ours = corrected_windows(at_zero(likelihood, belief, of))
    with jax.enable_x64(True):
        best, bad, good = (
            cost_of(likelihood, belief, found.posterior.mean)
            for found in (belief, naive, ours)
        )
    assert bad - best > 50.0 * naive.inflation
    assert good - best < 2.0 * naive.inflation
    assert 4.0 / (1.0 + np.exp(-float(naive.posterior.mean[1]))) > 0.1  # the truth is 0
    assert 4.0 / (1.0 + np.exp(-float(ours.posterior.mean[1]))) < 0.02


def test_pulls_are_those_of_the_dense_marginal(
    fitted: tuple[WindowsLikelihood, Estimate],
) -> None:
    """The start states integrated out: rows of covariance ``I + J_e J_e^T``."""
    likelihood, belief = fitted
    W = len(likelihood.windows)
    pulls = pulls_of_windows(likelihood, belief, np.zeros(W, int))
    found = linearise(likelihood, belief, belief.posterior.mean)
    J = np.asarray(found.jacobian)[:, :, 0] / float(belief.noise.sd[0])
    r = np.asarray(found.residual)[..., 0] / float(belief.noise.sd[0])
    e = np.asarray(belief.nuisances)
    for w in range(W):
        Jz, Je = J[w, :, :2], J[w, :, 2:]
        weight = np.linalg.inv(np.eye(len(Jz)) + Je @ Je.T)
        F = pulls.factors[w].T @ pulls.factors[w]
        np.testing.assert_allclose(F, Jz.T @ weight @ Jz, rtol=1e-7, atol=1e-9)
        score = Jz.T @ weight @ (r[w] - Je @ e[w])  # of the start at its prior mean
        np.testing.assert_allclose(pulls.scores[w], score, rtol=1e-7, atol=1e-7)
    A = np.asarray(belief.information)
    total = np.einsum("wkp,wkq->pq", pulls.factors, pulls.factors)
    np.testing.assert_allclose(total, A.T @ A, rtol=1e-9)
    away = np.asarray(belief.posterior.mean - belief.prior.mean)
    np.testing.assert_allclose(pulls.scores.sum(axis=0), -away, atol=1e-6)
    np.testing.assert_allclose(np.asarray(belief.scores).sum(0), -away, atol=1e-6)


def test_the_exact_posterior_of_a_linear_machine_is_laplaces(
    fitted: tuple[WindowsLikelihood, Estimate],
) -> None:
    likelihood, belief = fitted
    found = check_windows(likelihood, belief, key=jax.random.key(1))
    assert found.draws == pytest.approx(DRAWS, rel=1e-6)
    np.testing.assert_allclose(found.shift, 0.0, atol=1e-6)
    plain = belief.posterior
    narrow = gaussian(np.asarray(plain.mean), 0.4 * np.asarray(plain.scale))
    wrong = dataclasses.replace(belief, posterior=narrow)
    assert check_windows(likelihood, wrong, key=jax.random.key(1)).k > 0.7
