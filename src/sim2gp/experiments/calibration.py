"""Do predicted bands hold what they promise? Shares inside them, level by level.

A band of level p is central: it holds the measurement of a channel with probability p
if the forecast's spread is right. The share of windows inside it, for every p, is the
calibration curve; below the diagonal the bands are too narrow, above it too wide.
"""

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np

from sim2gp.experiments.prediction import Judged
from sim2gp.models.cutting import SPACING
from sim2gp.models.grid import steps_of

LEVELS = (*(round(0.05 * k, 2) for k in range(1, 20)), 0.99)
SCATTER = NormalDist().inv_cdf(0.95)  # standard errors to each side


def calibration(
    found: Judged, names: Sequence[str], horizon: float
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary entry and arrays ``calibration/...`` of forecasts at the horizon.

    Windows overlap: only those apart by the horizon count as independent in the words,
    and in the zone ``calibration/low`` to ``high`` that nine in ten right curves keep
    to at a level.
    """
    at = int(np.searchsorted(found.rows, steps_of(horizon)))
    levels = np.asarray(LEVELS)
    reach = np.asarray([NormalDist().inv_cdf(0.5 + 0.5 * p) for p in LEVELS])
    valid = found.valid[:, at]
    z = np.abs(found.error[:, at] / found.scale[:, at])
    windows = int(valid.any(axis=1).sum())
    apart = max(1.0, windows * min(1.0, SPACING / horizon))
    half = SCATTER * np.sqrt(levels * (1.0 - levels) / apart)
    arrays = {
        "calibration/level": levels,
        "calibration/low": np.maximum(levels - half, 0.0),
        "calibration/high": np.minimum(levels + half, 1.0),
    }
    texts = []
    for c, name in enumerate(names):
        if not valid[:, c].any():
            continue
        share = np.mean(z[valid[:, c], c, None] <= reach, axis=0)
        arrays[f"calibration/share/{name}"] = share
        texts.append(_words(name, float(np.interp(0.9, levels, share)), apart))
    return {
        "horizon": horizon,
        "windows": windows,
        "independent": math.floor(apart),
        "text": " ".join(texts),
    }, arrays


def _words(name: str, share: float, apart: float) -> str:
    """What the 90 % band of one channel held."""
    inside = f"The 90 % band of {name} held {100.0 * share:.0f} % of the measurements"
    half = SCATTER * math.sqrt(0.9 * 0.1 / apart)
    if share < 0.9 - half:
        return f"{inside}: it is too narrow, expect larger errors than it says."
    if share > 0.9 + half:
        return f"{inside}: it is wider than it need be."
    return f"{inside}, as it should within the scatter of so many windows."
