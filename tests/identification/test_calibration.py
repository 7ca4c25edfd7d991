"""All levels of a forecast's bands, judged together: by simulated forecasts."""

from collections.abc import Sequence
from statistics import NormalDist

import numpy as np
import pytest

from sim2gp.data.logs import Log
from sim2gp.identification.forecasts.calibration import (
    LEVELS,
    blocks_of,
    calibrate_forecasts,
    half_widths,
)
from sim2gp.identification.forecasts.prediction import ScoredForecasts

HORIZON = 0.5  # s; windows start every 0.1 s, so that five of them overlap
NAMES = ("q1", "q2")


def judged(z: np.ndarray, log: np.ndarray | None = None) -> ScoredForecasts:
    """Forecasts at the horizons .1 and .5 s whose standardised errors are ``z``."""
    both = np.stack([0.0 * z, z], axis=1)
    valid = np.isfinite(both)
    none = np.zeros_like(both)
    scale = np.full_like(both, 0.2)
    of = np.zeros(len(z), int) if log is None else log
    return ScoredForecasts(
        np.array([50, 250]), valid, 0.2 * np.where(valid, both, 0.0), scale, none, none,
        none, of, valid, valid,
    )  # fmt: skip


def recorded(count: int) -> list[Log]:
    """So many recordings; only their names matter."""
    t = np.arange(2.0)
    return [Log(f"log{k}", f"log{k}.csv", t, {}, {}, {}) for k in range(count)]


def overlapping(rng: np.random.Generator, windows: int) -> np.ndarray:
    """Standardised errors of windows that overlap, of two correlated channels.

    Each is the mean of five disturbances, of which a window shares four with the next:
    exactly Gaussian, exactly calibrated.
    """
    noise = rng.standard_normal((windows + 4, 2))
    noise[:, 1] = 0.6 * noise[:, 0] + 0.8 * noise[:, 1]
    return np.asarray(sum(noise[k : k + windows] for k in range(5)) / np.sqrt(5.0))


def forecast(
    rng: np.random.Generator, blocks: int, *, logs: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Calibrated errors and their logs: one log for each block, or one in all.

    Errors of a log have a part in common, too.
    """
    if not logs:
        return overlapping(rng, 10 * blocks), np.zeros(10 * blocks, int)
    parts = []
    for _ in range(blocks):
        common = rng.standard_normal((1, 2))
        parts.append(np.sqrt(0.7) * overlapping(rng, 20) + np.sqrt(0.3) * common)
    return np.concatenate(parts), np.repeat(np.arange(blocks), 20)


def shares_wrong_in_the_middle(z: np.ndarray) -> np.ndarray:
    """Errors that calibrated ones become: the 90 % band holds 90 %, the others fewer.

    Below it, |z| becomes 1.645 (|z| / 1.645)^.4, so that the 50 % band holds 14 %.
    """
    edge = NormalDist().inv_cdf(0.95)
    size = np.abs(z)
    inner = edge * (size / edge) ** 0.4
    return np.asarray(np.sign(z) * np.where(size < edge, inner, size))


def verdicts(z: np.ndarray, log: np.ndarray) -> list[str]:
    about, _ = calibrate_forecasts(
        judged(z, log), NAMES, recorded(log.max() + 1), HORIZON, 4.0
    )
    return [entry["verdict"] for entry in about["channels"].values()]


def flagged(said: Sequence[str]) -> bool:
    assert "too few to say" not in said
    return any(word != "not contradicted" for word in said)


CASES = [(blocks, logs) for blocks in (8, 12, 30, 100) for logs in (True, False)]


def test_200_calibrated_forecasts_are_rarely_flagged() -> None:
    """5 in 100 may be, over all levels and channels: more than 17 of 200 has p < .02.

    A quarter each of 8, 12, 30 and 100 blocks, half of them logs, half stretches.
    """
    rng = np.random.default_rng(0)
    count = sum(
        flagged(verdicts(*forecast(rng, blocks, logs=logs)))
        for blocks, logs in CASES
        for _ in range(25)
    )
    assert count <= 17


def test_bands_too_narrow_by_half_are_flagged() -> None:
    rng = np.random.default_rng(1)
    for blocks, logs, least in ((8, True, 14), (12, False, 17), (30, True, 20)):
        found = []
        for _ in range(20):
            z, log = forecast(rng, blocks, logs=logs)
            found.append(verdicts(1.5 * z, log))
        caught = [said for said in found if flagged(said)]
        assert len(caught) >= least
        assert {word for said in caught for word in said} <= {
            "too narrow",
            "not contradicted",
        }


@pytest.mark.parametrize(("blocks", "logs"), CASES[:4])
def test_bands_right_at_90_and_wrong_at_50_are_flagged(blocks: int, logs: bool) -> None:
    rng = np.random.default_rng(2)
    for _ in range(10):
        z, log = forecast(rng, blocks, logs=logs)
        bent = shares_wrong_in_the_middle(z)
        about, _ = calibrate_forecasts(
            judged(bent, log), NAMES, recorded(blocks), HORIZON, 4.0
        )
        entries = about["channels"].values()
        assert "too narrow" in {entry["verdict"] for entry in entries}
        for entry in entries:
            assert all(level < 0.9 for level in entry["failed_levels"])
        assert "bands hold too few measurements" in about["text"]
        assert "as it should" not in about["text"]


def quantiles(count: int) -> np.ndarray:
    """Standardised errors that are exactly Gaussian, in an order without memory."""
    z = [NormalDist().inv_cdf((k + 0.5) / count) for k in range(count)]
    return np.random.default_rng(3).permutation(z)


def test_the_words_name_levels_direction_and_factor() -> None:
    """Oracle: errors of once, 1.5 times and half the spread that is stated."""
    z = np.stack([f * quantiles(2000) for f in (1.0, 1.5, 0.5)], axis=1)
    names = "right", "narrow", "wide"
    about, arrays = calibrate_forecasts(judged(z), names, recorded(1), HORIZON, 4.0)
    share = arrays["calibration/share/right"]
    np.testing.assert_allclose(share, np.asarray(LEVELS), atol=1e-3)
    right, narrow, wide = about["channels"].values()
    assert right["verdict"] == "not contradicted"
    assert right["failed_levels"] == []
    for entry, word, factor in ((narrow, "too narrow", 1.5), (wide, "too wide", 0.5)):
        assert entry["verdict"] == word
        assert {0.5, 0.9} <= set(entry["failed_levels"])
        np.testing.assert_allclose(entry["factors"], factor, rtol=0.01)
        assert entry["blocks"] == about["independent"] == 16
    assert (
        "right: 16 stretches of about 12 s in 1 recording contradict no band"
        in (about["text"])
    )
    assert "bands hold too few measurements (the" in about["text"]
    assert "should be about 1.5 times as wide" in about["text"]
    assert "could be about 0.5 times as wide" in about["text"]
    assert "All bands are 2 times as wide as the errors of the logs" in about["text"]


def test_bands_may_be_too_narrow_and_too_wide() -> None:
    """Two spreads in turn: too few in the middle, too many at the ends, or so."""
    z = 0.25 * quantiles(4000)
    z[::2] *= 12.0
    about, _ = calibrate_forecasts(judged(z[:, None]), ["q"], recorded(1), HORIZON, 4.0)
    entry = about["channels"]["q"]
    assert entry["verdict"] == "wrong shape"
    low, high = entry["ranges"]
    assert (low["direction"], high["direction"]) == ("many", "few")
    assert high["high"] == 0.99
    assert low["factor_low"] < 1.0 < high["factor_high"]


def test_picture_and_words_agree() -> None:
    z, log = forecast(np.random.default_rng(4), 8, logs=False)
    z[:, 1] = shares_wrong_in_the_middle(z[:, 1])
    about, arrays = calibrate_forecasts(
        judged(z, log), NAMES, recorded(1), HORIZON, 4.0
    )
    for name in NAMES:
        share, low, high = (
            arrays[f"calibration/{kind}/{name}"] for kind in ("share", "low", "high")
        )
        outside = np.asarray(LEVELS)[(share < low) | (share > high)]
        assert outside.tolist() == about["channels"][name]["failed_levels"]


def test_fewer_than_eight_blocks_accuse_nobody() -> None:
    z = np.stack([np.full(70, 0.01), np.full(70, 9.0)], axis=1)
    about, arrays = calibrate_forecasts(judged(z), NAMES, recorded(1), HORIZON, 4.0)
    assert about["independent"] == 7
    assert verdicts(z, np.zeros(70, int)) == ["too few to say"] * 2
    assert "q1 and q2: too few to say" in about["text"]
    assert "7 independent blocks of windows (7 stretches of about 1 s" in about["text"]
    assert not any("low" in key or "high" in key for key in arrays)
    assert arrays["calibration/share/q1"][LEVELS.index(0.9)] == 1.0


def test_a_channel_is_judged_by_its_own_blocks() -> None:
    z = np.stack([quantiles(200), quantiles(200), np.full(200, np.nan)], axis=1)
    z[40:, 1] = np.nan
    names = "whole", "short", "none"
    about, arrays = calibrate_forecasts(judged(z), names, recorded(1), HORIZON, 4.0)
    assert about["windows"] == 200
    assert list(about["channels"]) == ["whole", "short"]
    assert about["channels"]["short"]["verdict"] == "too few to say"
    assert about["channels"]["whole"]["verdict"] == "not contradicted"
    assert "calibration/share/none" not in arrays
    assert "calibration/low/whole" in arrays
    assert "calibration/low/short" not in arrays


def test_one_channel_twice_is_one_channel() -> None:
    """Signs are common to all channels: what they share is not paid for twice."""
    z, log = forecast(np.random.default_rng(5), 12, logs=True)
    one, valid = np.abs(z[:, :1]), np.ones((len(z), 1), bool)
    alone = half_widths(one, valid, log)
    twice = half_widths(np.tile(one, 2), np.tile(valid, 2), log)
    np.testing.assert_allclose(twice, np.tile(alone, (2, 1)), rtol=1e-12)
    both = half_widths(np.abs(z), np.ones(z.shape, bool), log)
    assert np.all(both[0] > alone[0])


def test_blocks_are_recordings_or_stretches_of_them() -> None:
    files = [f"{k}.csv" for k in range(9)]
    log = np.repeat(np.arange(9), [20, 30, 25, 10, 20, 20, 20, 20, 20])
    found = blocks_of(log, files, HORIZON)
    np.testing.assert_array_equal(found.of, log)
    assert (found.number, found.words) == (9, "9 recordings")
    # Pieces of a file are one recording; a long recording is no single block.
    assert blocks_of(log, ["a.csv"] * 9, HORIZON).words.endswith("in 1 recording")
    uneven = blocks_of(np.repeat(np.arange(9), [500, *[20] * 8]), files, HORIZON)
    assert uneven.number > 9
    for horizon, windows in ((0.5, 94), (0.2, 94), (0.1, 700), (2.0, 200)):
        cut = blocks_of(np.repeat([0, 1], [windows, 30]), files[:2], horizon)
        of, sizes = cut.of[:windows], np.bincount(cut.of)
        assert np.all(np.diff(cut.of) >= 0)
        assert not set(of) & set(cut.of[windows:])
        assert np.bincount(of).min() >= min(windows, 20.0 * horizon)
        assert len(sizes) == cut.number <= 17
