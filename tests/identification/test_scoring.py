"""Scores of forecasts against other formulas, and when a model is called better."""

import math

import numpy as np
import pytest
import scipy.integrate
import scipy.stats

from sim2gp.commands.compare_folds import MODELS, ModelFactory
from sim2gp.identification.forecasts import scoring
from sim2gp.identification.forecasts.scoring import PairedComparison


@pytest.mark.parametrize("error", [-2.0, -0.1, 0.0, 0.7, 9.0])
@pytest.mark.parametrize("sd", [0.05, 1.0, 3.0])
def test_crps_is_the_integral_of_its_definition(error: float, sd: float) -> None:
    """Integral over x of (F(x) - 1{x >= y})^2, with F the forecast's, y = -error."""
    forecast = scipy.stats.norm(0.0, sd)
    y, far = -error, 40.0
    below = scipy.integrate.quad(
        lambda x: forecast.cdf(x) ** 2, -far, y, points=[0.0] if y > 0 else None
    )[0]
    above = scipy.integrate.quad(
        lambda x: forecast.sf(x) ** 2, y, far, points=[0.0] if y < 0 else None
    )[0]
    found = scoring.crps(np.asarray(error), np.asarray(sd))
    assert float(found) == pytest.approx(below + above, rel=1e-6)


def test_crps_is_that_of_draws() -> None:
    rng = np.random.default_rng(0)
    x = 0.4 + 0.3 * rng.standard_normal(20_000)
    gaps = np.sort(x)
    n = len(x)
    # Mean distance of two draws, from the order statistics.
    apart = 2.0 * np.sum((2 * np.arange(1, n + 1) - n - 1) * gaps) / (n * (n - 1))
    sampled = np.mean(np.abs(x)) - 0.5 * apart
    found = scoring.crps(np.asarray(0.4), np.asarray(0.3))
    assert float(found) == pytest.approx(sampled, rel=0.02)


def test_crps_without_spread_is_the_absolute_error() -> None:
    found = scoring.crps(np.asarray([-2.0, 3.0]), np.zeros(2))
    np.testing.assert_array_equal(found, [2.0, 3.0])


def test_nll_is_scipys() -> None:
    error, sd = np.asarray([0.3, -2.0]), np.asarray([0.1, 4.0])
    want = -scipy.stats.norm.logpdf(error, 0.0, sd)
    np.testing.assert_allclose(scoring.nll(error, sd), want, rtol=1e-12)


def test_a_model_that_ran_away_scores_without_warnings() -> None:
    error = np.asarray([math.inf, 1.0])
    np.testing.assert_array_equal(scoring.crps(error, np.ones(2))[0], math.inf)
    np.testing.assert_array_equal(scoring.nll(error, np.ones(2))[0], math.inf)


def test_spread_covers_the_known_errors() -> None:
    """Draws three times too narrow are widened until the training errors fit."""
    rng = np.random.default_rng(1)
    W, truth = 4000, np.asarray([0.2, 5.0])
    draws = rng.standard_normal((16, W, 1, 2)) * truth / 3.0
    error = rng.standard_normal((W, 1, 2)) * truth
    known = np.ones((W, 1, 2), bool)
    known[2000:] = False
    error[2000:] *= 100.0  # what was left out must not be looked at
    sd = scoring.predicted_spread(error, draws, known, np.zeros(2), 1.0)
    inside = np.abs(error[:2000]) <= 1.96 * sd[:2000]
    np.testing.assert_allclose(inside.mean(axis=(0, 1)), 0.95, atol=0.02)
    wide = scoring.predicted_spread(error, draws, known, np.zeros(2), 4.0)
    np.testing.assert_allclose(wide, 2.0 * sd, rtol=1e-12)


def test_units_add_up_to_one_for_the_simulator() -> None:
    rng = np.random.default_rng(2)
    score = rng.uniform(1.0, 2.0, (3, 20, 2, 2)) * [1.0, 50.0]  # unlike units
    valid = rng.uniform(size=(20, 2, 2)) < 0.9
    score[1] = 0.5 * score[0]
    unit = np.repeat([7, 3], 10)
    sums = scoring.crps_by_unit(score, valid, unit)
    assert sums.shape == (3, 2)
    # Each of the two steps and two channels weighs the same.
    assert sums[0].sum() == pytest.approx(4.0)
    np.testing.assert_allclose(sums[1], 0.5 * sums[0])


RNG = np.random.default_rng


def test_a_pair_is_compared_unit_by_unit() -> None:
    old = np.asarray([1.0, 2.0, 3.0, 4.0, 5.0])
    found = scoring.compare_paired(0.9 * old, old, RNG(0))
    for value in (found.change, found.low, found.high):
        assert value == pytest.approx(-0.1)
    assert (found.better, found.units) == (5, 5)
    assert found.wins
    mixed = scoring.compare_paired(old * [0.5, 1.2, 0.9, 1.1, 1.02], old, RNG(0))
    assert mixed.low < mixed.change < mixed.high
    assert mixed.better == 2
    assert not mixed.wins


def test_the_interval_is_the_bootstraps() -> None:
    """With many units, that of the delta method."""
    rng = RNG(3)
    old = rng.uniform(0.5, 1.5, 400)
    new = old * (0.97 + 0.2 * rng.standard_normal(400))
    found = scoring.compare_paired(new, old, RNG(4))
    ratio = new.sum() / old.sum()
    error = np.std(new - ratio * old) / old.mean() / math.sqrt(400)
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.08)


def test_ties_keep_the_simpler_and_runaways_lose() -> None:
    old = np.ones(6)
    hair = 0.995 * old  # sure, but too little to matter
    unsure = np.asarray([0.5, 0.6, 0.7, 1.4, 1.3, 1.2])
    gone = np.full(6, math.inf)
    better, best = 0.8 * old, 0.6 * old
    cases = [
        ([old, hair, unsure, gone], 0),
        ([old, gone, better], 2),
        ([old, better, 0.996 * better], 1),
        ([old, better, best], 2),
        ([old, best, better], 1),
        ([old, np.full(6, math.nan)], 0),
    ]
    for sums, kept in cases:
        assert scoring.select_model(np.stack(sums), RNG(0)) == kept


WHAT = {name: MODELS[name].what for name in ("SIM2GP", "RES", "NLM")}
SAME = PairedComparison(0.0, 0.0, 0.0, 0, 6)


@pytest.mark.parametrize(
    ("res", "nlm", "kept", "words"),
    [
        (-0.04, 0.5, 1, ["plus a learned residual (RES)", "5 of 6 logs", "-4.0 %"]),
        (0.2, -0.3, 2, ["black box", "(NLM)", "-30.0 %"]),
        (0.2, 0.3, 0, ["simulator alone", "is worse", "RES: CRPS +20.0 %"]),
        (0.2, -0.02, 0, ["simulator alone", "tie", "NLM: CRPS -2.0 %"]),
        (math.inf, math.inf, 0, ["simulator alone", "ran away"]),
    ],
)
def test_the_verdict_in_words(
    res: float, nlm: float, kept: int, words: list[str]
) -> None:
    pairs = [SAME, *(PairedComparison(x, x - 0.03, x + 0.03, 5, 6) for x in (res, nlm))]
    said = scoring.selection_sentence(WHAT, pairs, kept, "logs")
    for word in words:
        assert word in said
    assert "nan" not in said
    assert "inf" not in said


def test_every_learner_that_is_compared_has_words() -> None:
    """A learner of one's own is one entry of the table; the verdict says it."""
    own = ModelFactory(lambda sim, reach: sim, "a table of numbers")
    known = {**MODELS, "OWN": own}
    what = {name: learner.what for name, learner in known.items()}
    pairs = [SAME, *[PairedComparison(-0.1, -0.2, -0.05, 5, 6)] * (len(what) - 1)]
    for kept, (name, words) in list(enumerate(what.items()))[1:]:
        said = scoring.selection_sentence(what, pairs, kept, "logs")
        assert f"support {words} ({name})" in said
