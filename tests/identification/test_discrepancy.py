"""Intervals that allow for missing physics: Bayes' mixture; an arm with friction."""

import dataclasses
import importlib.util
import itertools
import sys
from pathlib import Path
from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from descents import estimate_of
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals.averaging import NONE, NOTHING, SHARES, averaged
from sim2gp.identification.intervals.discrepancy import (
    _apart,
    _next,
    corrected_windows,
)
from sim2gp.identification.intervals.pulls import Pulls
from sim2gp.identification.intervals.scatter import CorrectedFit, correct_posterior
from sim2gp.identification.intervals.words import interval_entry, missing_forces_table
from sim2gp.identification.missing_physics.at_zero import (
    at_zero,
    forces_at_zero,
    forces_of,
)
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameter
from sim2gp.systems import Delay, UniformRodArm, with_parts
from sim2gp.types import in_float64
from tests.identification.test_intervals import (
    HIGH,
    LOW,
    Linear,
    Plain,
    ar1,
    gaussian,
    smooth,
)

ROOT = Path(__file__).resolve().parents[2]
BOX = ("q1", "q2", "torque1", "torque2")
OWN, ALL = 3, 5
EFFECTS = np.arange(ALL) >= OWN
GROUPS = {"force": np.flatnonzero(EFFECTS)}


def sensitivities(rng: np.random.Generator) -> np.ndarray:
    """Of three constants, and of two effects that they nearly mimic: (W, rows, 5)."""
    J = smooth(rng, 2.0)
    like = J @ rng.standard_normal((OWN, ALL - OWN))
    return np.concatenate([J, like + 0.3 * smooth(rng, 2.0)[..., : ALL - OWN]], axis=-1)


@pytest.mark.parametrize(
    "groups", [{"a": [3, 4]}, {"a": [3], "b": [4]}], ids=["one group", "two"]
)
def test_the_average_over_groups_is_bayes(groups: dict[str, list[int]]) -> None:
    """Against the marginal of the data under each choice, in covariances, by scipy."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((7, ALL)) * [3.0, 1.0, 2.0, 4.0, 0.5]
    data = root @ [0.5, -1.0, 0.2, 0.15, -0.1] + rng.standard_normal(7)
    places = {name: np.asarray(at) for name, at in groups.items()}
    mean, scale, each = averaged(root, data, places)

    def choice(scales: dict[str, float]) -> tuple[float, np.ndarray, np.ndarray]:
        sd = np.where(EFFECTS, 0.0, 1.0)
        for name, share in scales.items():
            sd[groups[name]] = share
        prior = np.diag(sd**2)
        S = root @ prior @ root.T + np.eye(7)
        odds = scipy.stats.multivariate_normal(np.zeros(7), S).pdf(data)
        sizes = [1.0, 0.5][: len(groups)]  # a second group is half as likely
        if scales:
            alike = len(list(itertools.combinations(groups, len(scales))))
            share = sizes[len(scales) - 1] / sum(sizes) / alike
            odds *= (1.0 - NOTHING) * share / len(SHARES) ** len(scales)
        else:
            odds *= NOTHING
        gain = prior @ root.T @ np.linalg.inv(S)
        return odds, gain @ data, prior - gain @ root @ prior

    tried: list[dict[str, float]] = [{}]
    tried += [{name: s} for name in groups for s in SHARES]
    best = max(tried, key=lambda s: choice(s)[0])
    if len(groups) > 1 and best:
        tried += [{**best, n: s} for n in groups if n not in best for s in SHARES]
    found = [choice(scales) for scales in tried]
    odds = np.asarray([f[0] for f in found])
    odds /= odds.sum()
    assert 0.05 < odds[0] < 0.95
    assert each[NONE] == pytest.approx(odds[0], rel=1e-9)
    for name in groups:
        on = [name in scales for scales in tried]
        assert each[name] == pytest.approx(float(odds @ np.asarray(on, float)))
    means = np.asarray([f[1] for f in found])
    want = odds @ means
    np.testing.assert_allclose(mean, want, rtol=1e-9)
    away = means - want
    covs = np.asarray([f[2] for f in found]) + away[:, :, None] * away[:, None]
    cov = np.einsum("k,kij->ij", odds, covs)
    np.testing.assert_allclose(scale @ scale.T, cov, rtol=1e-8, atol=1e-12)


def test_what_acts_as_a_parameter_is_no_force() -> None:
    """Of a group all directions but the one that is a sum of parameters' columns."""
    rng = np.random.default_rng(4)
    own, free = rng.standard_normal((30, 2)), rng.standard_normal((30, 3))
    like = own @ [0.3, -0.7]
    turn = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    G = np.concatenate([free, like[:, None]], axis=1) @ turn
    kept = _apart(G, np.linalg.qr(own)[0])
    assert kept.shape == (4, 3)
    np.testing.assert_allclose(kept.T @ kept, np.eye(3), atol=1e-12)
    # What is left acts apart: with no direction is all in the parameters' span.
    rest = G @ kept - own @ np.linalg.lstsq(own, G @ kept)[0]
    lengths = np.linalg.svd(rest)[1] / np.linalg.norm(G @ kept, 2)
    assert lengths.min() > 0.1
    assert _apart(np.zeros((30, 2)), np.linalg.qr(own)[0]).shape == (2, 0)


@pytest.mark.parametrize("gain", [-1.0, -1.3, 0.3])
def test_a_centre_that_is_overshot_is_found(gain: float) -> None:
    """Without halves, a gain of -1 goes to and fro for ever."""
    centre, sd = np.array([1.0, -2.0]), np.array([0.1, 3.0])
    before = at = centre + 0.8 * sd
    settled, rounds = False, 0
    while not settled:
        rounds += 1
        mean = centre + gain * (at - centre)
        posterior = Gaussian(mean, np.diag(sd))
        to, settled = _next(posterior, before, at)
        before, at = at, to
        assert rounds < 5
    assert np.max(np.abs(at - centre) / sd) < 0.1


def answer(model: Linear, y: np.ndarray, allowed: bool) -> CorrectedFit:
    """The intervals of a fit of the constants alone; effects stand at nothing."""
    H = model.H[:OWN, :OWN]
    z = np.zeros(ALL)
    z[:OWN] = np.linalg.solve(H, np.einsum("wlp,wl->p", model.J[..., :OWN], y))
    scores = np.einsum("wlp,wl->wp", model.J, model.J @ z - y)
    pulls = Pulls(model.J, scores, model.group)
    if allowed:
        return correct_posterior(model.prior, gaussian(z, np.eye(ALL)), pulls, GROUPS)
    prior = gaussian(np.zeros(OWN), np.eye(OWN))
    return correct_posterior(
        prior, gaussian(z[:OWN], np.eye(OWN)), pulls.onto(np.eye(ALL)[:, :OWN])
    )


def covered(lacks: float, rho: float, allowed: bool) -> tuple[float, float, float]:
    """Coverage of 95 % intervals, their median sd, and P(something) on average."""
    rng, inside, sd, missing = np.random.default_rng(1), [], [], []
    model = Linear(sensitivities(rng))
    for _ in range(150):
        z = rng.standard_normal(ALL) * np.where(EFFECTS, lacks, 1.0)
        found = answer(model, model.J @ z + ar1(rng, rho), allowed)
        lies = Plain(found.posterior)
        spread, error = lies.sd[:OWN], lies.mean[:OWN] - z[:OWN]
        inside.append(np.abs(error) < 1.96 * spread)
        sd.append(spread)
        missing.append(found.missing)
    return float(np.mean(inside)), float(np.median(sd)), float(np.mean(missing))


def test_what_all_windows_lack_is_covered() -> None:
    """A bias that no scatter of windows shows, of a size that is not the library's."""
    assert covered(0.3, 0.0, allowed=False)[0] < 0.4
    inside, _, missing = covered(0.3, 0.0, allowed=True)
    assert LOW < inside < HIGH
    assert missing > 0.7


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_where_nothing_is_missing_little_is_paid(rho: float) -> None:
    _, before, none = covered(0.0, rho, allowed=False)
    inside, sd, missing = covered(0.0, rho, allowed=True)
    assert none == 0.0
    assert missing < NOTHING  # effects too small to show cannot be ruled out
    assert inside > 0.93
    assert before < sd < 1.6 * before


def test_errors_of_the_parameters_frequencies_keep_their_width() -> None:
    """Many forces of high frequencies: slow errors pull the constants, not these."""
    rng, many, rows = np.random.default_rng(6), 24, 400
    t = np.arange(rows) / rows
    slow = np.stack([np.sin(2 * np.pi * (k + 1) * t) for k in range(OWN)], axis=1)
    fast = np.stack([np.sin(2 * np.pi * (97 + 3 * k) * t) for k in range(many)], axis=1)
    J = np.concatenate([3.0 * slow, 3.0 * fast], axis=1).reshape(40, 10, -1)
    groups = {"fast": np.arange(OWN, OWN + many)}
    model, own = Linear(J), np.eye(OWN + many)[:, :OWN]
    ratios, noises = [], []
    for _ in range(20):
        y = ar1(rng, 0.9)
        plain, pulls = model.fit(y)
        wide = correct_posterior(model.prior, plain, pulls, groups)
        few = gaussian(np.asarray(plain.mean)[:OWN], np.eye(OWN))
        prior = gaussian(np.zeros(OWN), np.eye(OWN))
        alone = correct_posterior(prior, few, pulls.onto(own))
        pairs = zip(*(Plain(x.posterior).sd[:OWN] for x in (wide, alone)), strict=True)
        ratios.append([one / other for one, other in pairs])
        noises.append(wide.inflation / alone.inflation)
    assert np.median(ratios) == pytest.approx(1.0, abs=0.1)
    assert np.median(noises) == pytest.approx(1.0, abs=0.2)


def test_forces_that_follow_slow_errors_do_not_narrow_what_is_without_them() -> None:
    """Free forces take slow errors out of the windows; those that are off do not."""
    rng, many = np.random.default_rng(7), OWN + 12
    waves = np.sin(np.pi * np.outer(np.arange(400) / 400, np.arange(many) + 1))
    model, own = Linear(3.0 * waves.reshape(40, 10, -1)), np.eye(many)[:, :OWN]
    groups = {f"wave {k}": np.asarray([k]) for k in range(OWN, many)}
    prior, ratios = gaussian(np.zeros(OWN), np.eye(OWN)), []
    for _ in range(20):
        plain, pulls = model.fit(0.3 * ar1(rng, 0.9))
        z = np.asarray(plain.mean)
        wide = correct_posterior(model.prior, plain, pulls, groups)
        still = pulls.at(own @ z[:OWN] - z).onto(own)
        alone = correct_posterior(prior, gaussian(z[:OWN], np.eye(OWN)), still)
        pairs = zip(*(Plain(x.posterior).sd[:OWN] for x in (wide, alone)), strict=True)
        ratios.append([wide.missing] + [one / other for one, other in pairs])
    missing, *wider = np.median(ratios, axis=0)
    assert missing < NOTHING
    assert min(wider) > 0.95


def test_it_does_not_matter_where_a_linear_machine_is_linearised() -> None:
    rng = np.random.default_rng(2)
    model = Linear(sensitivities(rng))
    y = model.J @ rng.standard_normal(ALL) + ar1(rng, 0.5)
    found = answer(model, y, allowed=True)
    z = rng.standard_normal(ALL)
    scores = np.einsum("wlp,wl->wp", model.J, model.J @ z - y)
    there = gaussian(z, np.eye(ALL))
    again = correct_posterior(
        model.prior, there, Pulls(model.J, scores, model.group), GROUPS
    )
    one, other = Plain(again.posterior), Plain(found.posterior)
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-9)
    np.testing.assert_allclose(one.C, other.C, atol=1e-9)
    assert again.missing == pytest.approx(found.missing)


# ---- an arm that another hand simulates --------------------------------------------


@pytest.fixture(scope="module")
def arms() -> ModuleType:
    """The benchmark's recordings: plain numpy, none of the library's simulators."""
    script = ROOT / "benchmarks" / "interval_arms.py"
    spec = importlib.util.spec_from_file_location("interval_arms", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["interval_arms"] = module
    spec.loader.exec_module(module)
    return module


Fitted = tuple[np.ndarray, Estimate, WindowsLikelihood]


def fitted(arms: ModuleType, condition: str, s: int) -> Fitted:
    """Hidden virtual constants, and the fit of one arm's ten seconds."""
    data = arms.recordings(arms.CONDITIONS[condition], 20, 0)
    windows, _ = cut([data.log(s)], UniformRodArm(), window=0.2)
    belief = fit_windows(UniformRodArm(), windows, key=jax.random.key(0))
    return data.truth[s], belief, WindowsLikelihood(UniformRodArm(), windows)


def away(truth: np.ndarray, found: Gaussian) -> np.ndarray:
    """Errors in sd."""
    lies = Plain(found)
    error: np.ndarray = np.abs(lies.mean - truth) / lies.sd
    return error


@pytest.mark.nightly
def test_friction_that_the_simulator_lacks_is_in_the_intervals(
    arms: ModuleType,
) -> None:
    """20 mN m in both joints: the damping takes it up, with a narrow interval."""
    truth, belief, likelihood = fitted(arms, "friction20", 0)
    one = np.zeros(len(likelihood.windows), int)
    assert away(truth, belief.posterior).max() > 12.0
    alone = corrected_windows(at_zero(likelihood, belief, one, ()))
    assert alone.kinds == ()
    assert away(truth, alone.posterior).max() > 7.0
    found = corrected_windows(at_zero(likelihood, belief, one))
    assert found.missing > 0.99
    assert found.each["dry_friction"] > 0.99
    assert found.posterior.scale.shape == (4, 4)
    assert away(truth, found.posterior).max() < 2.5
    about = interval_entry(found, {}, 50)
    assert about["missing"] == found.missing
    curves = {curve.name: curve for curve in found.found}
    assert set(curves) == {"q1 by q1.velocity", "q2 by q2.velocity"}
    for q in "q1", "q2":
        curve = curves[f"{q} by {q}.velocity"]
        assert (curve.unit, curve.of_unit) == ("N m", "rad/s")
        true = -0.02 * np.tanh(curve.at / arms.WIDTH)
        inner = np.abs(curve.at) < 0.7 * curve.at.max()
        outside = np.abs(curve.mean - true) > 2.0 * curve.sd
        assert np.mean(outside[inner]) < 0.1
    (table,) = missing_forces_table(found)
    assert {row[0] for row in table["rows"]} == {"q1", "q2"}
    # Where a fit without effects stands is of no account.
    with jax.enable_x64(True):
        at = belief.posterior.mean + jnp.asarray([0.2, -0.3, 0.2, 0.5])
        other = dataclasses.replace(
            belief, posterior=Gaussian(at, belief.posterior.scale)
        )
    again = corrected_windows(at_zero(likelihood, other, one))
    assert away(Plain(found.posterior).mean, again.posterior).max() < 0.4


@pytest.mark.nightly
def test_a_sound_simulator_is_believed(arms: ModuleType) -> None:
    truth, belief, likelihood = fitted(arms, "white", 0)
    one = np.zeros(len(likelihood.windows), int)
    found = corrected_windows(at_zero(likelihood, belief, one))
    alone = corrected_windows(at_zero(likelihood, belief, one, ()))
    assert found.missing < 0.3
    assert missing_forces_table(found) == []
    assert interval_entry(alone, {}, 50)["missing"] is None
    assert interval_entry(alone, {}, 50)["allowed_for"] == {}
    assert np.max(Plain(found.posterior).sd / Plain(alone.posterior).sd) < 1.3
    assert away(truth, found.posterior).max() < 3.0


@in_float64
def test_a_belief_keeps_its_parameters_among_forces() -> None:
    """Actuators, whose constants stand elsewhere in the table, and a dense prior."""
    delay = Parameter("torque1.delay", "s", "delay", "bounded", 0.0, 0.02)
    parts = {"torque1.delay": delay}
    system = with_parts(UniformRodArm(), [Delay("torque1")], parts)
    p = len(system.parameters.names)
    scale = jnp.asarray(np.tril(1.0 + np.arange(p * p).reshape(p, p)))
    prior = Gaussian(jnp.linspace(0.5, 1.0, p), scale)
    posterior = Gaussian(jnp.linspace(-1.0, -2.0, p), scale)
    none = jnp.zeros(1)
    belief = estimate_of(prior, posterior, Noise(none, none), none[None])
    box = dict.fromkeys([*BOX, *(f"{q}.velocity" for q in BOX)], (-1.0, 1.0))
    forces = forces_of(system, box)
    wider, whole, own = forces_at_zero(system, belief, forces)
    names = wider.parameters.names
    assert len(names) > p + 6
    assert tuple(names[k] for k in own) == system.parameters.names
    np.testing.assert_array_equal(whole.posterior.mean[own], posterior.mean)
    np.testing.assert_array_equal(whole.prior.mean[own], prior.mean)
    np.testing.assert_array_equal(whole.prior.scale[np.ix_(own, own)], scale)
    others = np.setdiff1d(np.arange(len(names)), own)
    mean = wider.parameters.prior().mean
    np.testing.assert_array_equal(whole.posterior.mean[others], mean[others])
    assert not np.any(np.asarray(whole.prior.scale)[np.ix_(own, others)])
