"""Claims of a study, each with its verdict and the figure it rests on.

Seeds are paired: learners of a seed meet the same machine under the same noise, so
differences are taken per seed and their means are bootstrapped over seeds.
"""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

RESAMPLES = 4000
LEVEL = 0.95
SAMPLING_PAYS = "posterior sampling is better than its point estimate in some cell"


def claim(holds: bool, figure: str, text: str) -> dict[str, Any]:
    """One entry of a summary's claims."""
    return {"holds": bool(holds), "figure": figure, "text": text}


def bootstrap_weights(
    seeds: int, rng: np.random.Generator
) -> Float[np.ndarray, "resamples seeds"]:
    """How often each seed is drawn, in `RESAMPLES` draws of as many as there are."""
    share = np.full(seeds, 1.0 / seeds)
    return rng.multinomial(seeds, share, size=RESAMPLES).astype(float)


def bootstrap_interval(
    difference: Float[np.ndarray, " seeds"],
    rng: np.random.Generator,
    level: float = LEVEL,
) -> tuple[float, float]:
    """Central share ``level`` of the bootstrap distribution of a mean over seeds."""
    means = bootstrap_weights(len(difference), rng) @ difference / len(difference)
    return central(means, level)


def central(
    values: Float[np.ndarray, " resamples"],
    level: float = LEVEL,
    method: Literal["linear", "nearest"] = "linear",
) -> tuple[float, float]:
    """The two quantiles that ``level`` of the values lie between."""
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(values, [tail, 1.0 - tail], method=method)
    return float(low), float(high)


def bootstrap_median(
    each: Float[np.ndarray, " seeds"], rng: np.random.Generator
) -> tuple[float, float, float]:
    """The median over seeds, and the central share `LEVEL` of its bootstrap.

    A seed may be infinite, for never: the ends are medians that were drawn.
    """
    weights = bootstrap_weights(len(each), rng).astype(int)
    medians = np.asarray([np.median(np.repeat(each, w)) for w in weights])
    return float(np.median(each)), *central(medians, method="nearest")


def difference_in_words(
    difference: Float[np.ndarray, " seeds"], low: float, high: float
) -> str:
    """A mean difference with its interval, in words."""
    return f"{difference.mean():+.3f} [{low:+.3f}, {high:+.3f}]"


def at_least_as_good(
    name: str,
    scores: Mapping[str, Float[np.ndarray, " seeds"]],
    rng: np.random.Generator,
    text: str,
) -> dict[str, Any]:
    """No other learner is better than ``name`` by more than chance explains.

    A score that is not finite is a seed that was lost: one lost by ``name`` alone is
    enough not to hold, one lost by another learner does not count for that one.
    """
    worst, figure = np.inf, ""
    for other, score in scores.items():
        kept = np.isfinite(score)
        lost = int(np.sum(kept & ~np.isfinite(scores[name])))
        if lost:
            return claim(False, f"no score on {lost} seeds, {other} has one", text)
        if other != name and kept.any():
            difference = scores[name][kept] - score[kept]
            low, high = bootstrap_interval(difference, rng)
            if high < worst:
                worst, figure = (
                    high,
                    f"{difference_in_words(difference, low, high)} to {other}",
                )
    return claim(figure != "" and worst >= 0.0, figure, text)


def better_somewhere(
    pairs: Mapping[
        str, tuple[Float[np.ndarray, " seeds"], Float[np.ndarray, " seeds"]]
    ],
    rng: np.random.Generator,
    text: str,
) -> dict[str, Any]:
    """The first of a pair beats the second in some place; its best place is shown.

    Who looks in many places finds something by chance: the intervals are as much wider
    as there are places (Bonferroni).
    """
    best, figure = -np.inf, ""
    level = 1.0 - (1.0 - LEVEL) / len(pairs)
    for place, (one, other) in pairs.items():
        difference = one - other
        low, high = bootstrap_interval(difference, rng, level)
        if low > best:
            best, figure = low, f"{place}: {difference_in_words(difference, low, high)}"
    return claim(best > 0.0, figure, text)
