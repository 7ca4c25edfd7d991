"""Scores of forecasts with a spread, and which model they support.

CRPS (Gneiting & Raftery 2007) is the expected absolute error of a draw less half the
expected distance of two draws: in the channel's unit, the absolute error where there is
no spread, and best for a calibrated spread. Of a Gaussian with sd ``s`` and error
``e``,

    CRPS = s [z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi)],     z = e / s

Models are compared pair by pair on the same windows. What replicates is the recording,
so that a bootstrap draws recordings, not windows.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

from sim2gp.inference.gaussian import LOG_2PI

Values = Float[np.ndarray, "..."]

RESAMPLES = 4000
LEVEL = 0.95  # of the intervals
MATTERS = 0.01  # a smaller relative change of CRPS is a tie


def crps(error: Values, sd: Values) -> Values:
    """Of a Gaussian forecast; the absolute error where ``sd`` is 0."""
    some = sd > 0.0
    s = np.where(some, sd, 1.0)
    z = error / s
    density = np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    inside = scipy.special.erf(z / math.sqrt(2.0))
    value = s * (z * inside + 2.0 * density - 1.0 / math.sqrt(math.pi))
    return np.asarray(np.where(some, value, np.abs(error)))


def nll(error: Values, sd: Values) -> Values:
    """Minus the log density of a Gaussian forecast, nats."""
    return np.asarray(0.5 * (error / sd) ** 2 + np.log(sd) + 0.5 * LOG_2PI)


def predicted_spread(
    error: Float[np.ndarray, "W R c"],
    draws: Float[np.ndarray, "D W R c"],
    counts: Bool[np.ndarray, "W R c"],
    resolution: Float[np.ndarray, " c"],
    inflation: float,
) -> Float[np.ndarray, "W R c"]:
    """Predicted sd of every window: that of the draws, scaled to the known errors.

    At each step and channel the variance is scaled to the mean square error of the
    windows that ``counts`` (those of the training logs), then raised by ``inflation``.
    """
    variance = np.var(draws, axis=0, ddof=1) + resolution**2
    ratio = np.where(counts, error**2 / variance, 0.0).sum(axis=0)
    scale = ratio / np.maximum(counts.sum(axis=0), 1)
    return np.asarray(np.sqrt(variance * scale * inflation))


@dataclass(frozen=True)
class PairedComparison:
    """One model against another: relative change of CRPS, its interval, and wins."""

    change: float
    low: float
    high: float
    better: int
    units: int

    @property
    def wins(self) -> bool:
        """Better beyond doubt, and by enough to matter."""
        return self.change < -MATTERS and self.high < 0.0


def crps_by_unit(
    score: Float[np.ndarray, "models W R c"],
    valid: Bool[np.ndarray, "W R c"],
    unit: Int[np.ndarray, " W"],
) -> Float[np.ndarray, "models units"]:
    """Sums of each model's CRPS by unit, every step and channel with equal weight.

    A step and channel is measured in the first model's mean CRPS there.
    """
    reference = masked_mean(score[0], valid)
    relative = np.where(valid, score / np.where(reference > 0.0, reference, 1.0), 0.0)
    weight = 1.0 / np.maximum(valid.sum(axis=0), 1)
    per_window = np.sum(relative * weight, axis=(2, 3))
    units = np.unique(unit)
    return np.stack([per_window[:, unit == u].sum(axis=1) for u in units], axis=1)


def compare_paired(
    new: Float[np.ndarray, " units"],
    old: Float[np.ndarray, " units"],
    rng: np.random.Generator,
) -> PairedComparison:
    """Two models' sums by unit; the interval resamples units (percentile bootstrap).

    A model that is not finite somewhere loses.
    """
    count = len(old)
    if not np.all(np.isfinite(new)):
        return PairedComparison(math.inf, math.inf, math.inf, 0, count)
    picked = rng.integers(0, count, (RESAMPLES, count))
    changes = new[picked].sum(axis=1) / old[picked].sum(axis=1) - 1.0
    low, high = np.quantile(changes, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2])
    change = float(new.sum() / old.sum() - 1.0)
    better = int(np.sum(new < old))
    return PairedComparison(change, float(low), float(high), better, count)


def select_model(
    sums: Float[np.ndarray, "models units"], rng: np.random.Generator
) -> int:
    """The model to keep, of models from simple to complex: a tie keeps the simpler."""
    kept = 0
    for k in range(1, len(sums)):
        if compare_paired(sums[k], sums[kept], rng).wins:
            kept = k
    return kept


def format_change(found: PairedComparison) -> str:
    """``-4.1 % [-7.2, -1.0]``."""
    if not math.isfinite(found.change):
        return "ran away"
    low, high = 100 * found.low, 100 * found.high
    return f"{100 * found.change:+.1f} % [{low:+.1f}, {high:+.1f}]"


def selection_sentence(
    what: Mapping[str, str], against: Sequence[PairedComparison], kept: int, unit: str
) -> str:
    """What the logs support, in a sentence for the user of the machine.

    ``what`` gives each model in words, by name. ``against`` holds each against the
    first, the simulator alone.
    """
    names = list(what)
    if kept:
        found = against[kept]
        return (
            f"The logs support {what[names[kept]]} ({names[kept]}): on data left out "
            f"it is better than the simulator alone in {found.better} of "
            f"{found.units} {unit}, CRPS {format_change(found)}. The simulator's "
            "equations lack something that these logs show again and again."
        )
    best = min(range(1, len(names)), key=lambda k: against[k].change)
    found = against[best]
    said = f"{names[best]}: CRPS {format_change(found)}"
    if found.change < math.inf:
        said += f", better in {found.better} of {found.units} {unit}"
    if found.change >= 0.0:
        return (
            "The logs support the simulator alone: on data left out every learned "
            f"model is worse, the nearest is {said}."
        )
    return (
        "The logs support the simulator alone: on data left out no learned model is "
        f"better beyond doubt, and a tie goes to the simpler (the nearest is {said})."
    )


def masked_mean(x: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """The mean over windows of the valid entries; 0 where there is none."""
    total = np.sum(np.where(valid, x, 0.0), axis=0)
    return np.asarray(total / np.maximum(valid.sum(axis=0), 1))
