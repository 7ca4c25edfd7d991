"""Do predicted bands hold the share they state? All levels are judged together.

A band of level p is central: it holds the measurement of a channel with probability p
if the forecast's spread is right. The share of windows inside it, for every p, is the
calibration curve; below the diagonal the bands are too narrow, above it too wide.

Windows overlap and share the errors of their recording, so that blocks are counted:
recordings, or of few recordings their consecutive stretches. With q_p the normal
quantile of level p, u the ranks of a channel's n standardised errors |z|, scaled to
(0, 1), and sums over the windows of block b,

    D(p) = sum_b sum_w (1[|z_w| <= q_p] - p) / n        as observed
    E_b(p) = sum_w (1[u_w <= p] - p) / n                as dependent, but calibrated

The largest |D(p)| / (s w(p)) of all channels and levels is compared with the largest
|sum_b e_b E_b(p)| / (s w(p) t): random signs e_b, the same for all channels. Here
w(p)^2 = p (1 - p), but no less than where one block in twenty, or one of fewer, is
expected outside; s is a channel's root mean square of E / w; t^2 ~ chi^2(B - 1) /
(B - 1) allows for the few blocks that s is known from (B of equal size would be worth
as much). Measured on calibrated forecasts with overlapping windows, of 8 to 100 blocks:
3 to 6 in 100 are flagged, over all levels and channels.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.data.grid import PERIOD, between_starts, steps_of
from sim2gp.data.logs import Log
from sim2gp.data.split_log import SPACING
from sim2gp.identification.forecasts.calibration_words import (
    calibration_verdict,
    describe_calibration,
)
from sim2gp.identification.forecasts.prediction import ScoredForecasts, recording_names

LEVELS = (*(round(0.05 * k, 2) for k in range(1, 20)), 0.99)
FEWEST = 8  # blocks that a verdict needs
LARGEST = 0.25  # of all windows, in a recording that is a block
MOST = 16  # stretches of few recordings: longer ones depend less on each other
ERROR = 0.05  # chance that a calibrated forecast is flagged
_FLIPS = 2000
_RARE = 0.05  # what is rarer is too skewed for its own variance
_REACH = np.asarray([NormalDist().inv_cdf(0.5 + 0.5 * p) for p in LEVELS])


class Blocks(NamedTuple):
    """The block of every window, and what the blocks are."""

    of: Int[np.ndarray, " W"]
    number: int
    words: str  # "8 recordings"


def calibrate_forecasts(
    found: ScoredForecasts,
    names: Sequence[str],
    logs: Sequence[Log],
    horizon: float,
    inflation: float,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary entry and arrays ``calibration/...`` of forecasts at the horizon.

    ``inflation``: of the variance of the forecasts' bands, for a new log (`Band`).

    ``calibration/low/NAME`` to ``high`` is the simultaneous band of a channel: of
    calibrated forecasts, 95 in 100 keep to it at all levels and in all channels. With
    fewer than eight blocks there is none, and no verdict.
    """
    at = int(np.searchsorted(found.rows, steps_of(horizon)))
    levels, valid = np.asarray(LEVELS), found.valid[:, at]
    measured = np.flatnonzero(valid.any(axis=0)).tolist()
    z = np.abs(found.error[:, at] / found.scale[:, at])
    some = valid.any(axis=1)
    apart = PERIOD * between_starts(logs)
    blocks = blocks_of(found.log[some], recording_names(logs), horizon, apart)
    half = half_widths(z[some], valid[some], blocks.of)
    arrays = {"calibration/level": levels}
    channels: dict[str, dict[str, Any]] = {}
    for c in measured:
        name, inside = names[c], z[valid[:, c], c]
        share = np.mean(inside[:, None] <= _REACH, axis=0)
        arrays[f"calibration/share/{name}"] = share
        if np.isfinite(half[c]).all():
            low, high = np.maximum(levels - half[c], 0), np.minimum(levels + half[c], 1)
            arrays[f"calibration/low/{name}"] = low
            arrays[f"calibration/high/{name}"] = high
        seen = np.unique(blocks.of[valid[some, c]])
        factor = np.quantile(inside, levels) / _REACH
        channels[name] = calibration_verdict(levels, share, half[c], factor, len(seen))
    return {
        "horizon": horizon,
        "windows": int(some.sum()),
        "independent": blocks.number,
        "blocks": blocks.words,
        "channels": channels,
        "text": describe_calibration(
            channels,
            levels,
            half[measured],
            blocks.words,
            FEWEST,
            math.sqrt(inflation),
        ),
    }, arrays


def blocks_of(
    log: Int[np.ndarray, " W"],
    files: Sequence[str],
    horizon: float,
    apart: float = SPACING,
) -> Blocks:
    """Blocks of windows in the order of time, from the log of each.

    ``files`` is the recording of each log, windows start ``apart`` s. Eight recordings
    or more are a block each, unless one holds most of the windows. Else all are cut
    into stretches of at least two horizons, which keeps the overlap of two blocks'
    windows small, and of at least a sixteenth of all windows.
    """
    order = list(dict.fromkeys(files))
    recording = np.asarray([order.index(file) for file in files])[log]
    present, counts = np.unique(recording, return_counts=True)
    if len(present) >= FEWEST and counts.max() <= LARGEST * len(log):
        place = np.searchsorted(present, recording)
        return Blocks(place, len(present), f"{len(present)} recordings")
    least = math.ceil(2.0 * horizon / apart - 1e-9)
    length = max(1, least, math.ceil(len(log) / MOST))
    of, count = np.zeros(len(log), int), 0
    for each, windows in zip(present, counts, strict=True):
        pieces = max(1, windows // length)
        of[recording == each] = count + np.arange(windows) * pieces // windows
        count += int(pieces)
    unit = "recording" if len(present) == 1 else "recordings"
    mean = apart * len(log) / count
    stretch = f"stretch{'' if count == 1 else 'es'} of about {mean:.2g} s"
    return Blocks(of, count, f"{count} {stretch} in {len(present)} {unit}")


def half_widths(
    z: Float[np.ndarray, "W c"],
    valid: Bool[np.ndarray, "W c"],
    of: Int[np.ndarray, " W"],
) -> Float[np.ndarray, "c L"]:
    """Half-widths of the simultaneous band about all levels; infinite: too few blocks.

    ``z`` are the standardised errors' magnitudes, ``of`` each window's block.
    """
    levels = np.asarray(LEVELS)
    out = np.full((z.shape[1], len(levels)), np.inf)
    sums, worth = [], []
    for c, rows in enumerate(valid.T):
        sizes = np.bincount(of[rows], minlength=of.max() + 1)
        if np.count_nonzero(sizes) < FEWEST:
            continue
        B = float(sizes.sum() ** 2 / np.sum(sizes**2))
        least = max(_RARE, 1.0 / B)
        w = np.sqrt(np.maximum(levels * (1.0 - levels), least * (1.0 - least)))
        rank = np.argsort(np.argsort(z[rows, c], kind="stable"), kind="stable")
        uniform = (rank + 0.5) / len(rank)
        E = np.zeros((len(sizes), len(levels)))
        np.add.at(E, of[rows], (uniform[:, None] <= levels) - levels)
        s = np.sqrt(np.mean(np.sum((E / w) ** 2, axis=0)))
        sums.append(E / (w * s))
        # As ranks are uniform over all blocks together, their sums vary too little.
        out[c] = w * s / len(rank) * math.sqrt(B / (B - 1.0))
        worth.append(B)
    if not sums:
        return out
    rng, freedom = np.random.default_rng(0), min(worth) - 1.0
    signs = rng.choice([-1.0, 1.0], (_FLIPS, of.max() + 1))
    t = np.sqrt(rng.chisquare(freedom, _FLIPS) / freedom)
    largest = np.max(np.abs(signs @ np.concatenate(sums, axis=1)), axis=1) / t
    return out * np.quantile(largest, 1.0 - ERROR)
