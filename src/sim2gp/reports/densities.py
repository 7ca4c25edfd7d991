"""Smooth densities of draws, for the prior-to-posterior drawings.

A Gaussian kernel on binned draws, reflected at the bounds so that mass does not leak
out of the box (Silverman 1986, sections 2.10 and 3.4.2).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

_BINS = 400
_POINTS = 140
_DECADES_FOR_LOG = 1.5

Draws = Float[np.ndarray, " S"]


@dataclass(frozen=True)
class View:
    """How a parameter's axis is drawn: range, bounds, and linear or in decades."""

    low: float
    high: float
    log: bool
    bounds: tuple[float | None, float | None]


def _finite(draws: np.ndarray) -> np.ndarray:
    flat = np.ravel(np.asarray(draws, dtype=float))
    return flat[np.isfinite(flat)]


def _bound(value: object) -> float | None:
    if isinstance(value, int | float) and np.isfinite(value):
        return float(value)
    return None


def view(
    clouds: list[np.ndarray], low: object, high: object, truth: float | None
) -> View | None:
    """The axis that shows the bulk of all clouds of draws and the truth."""
    kept = [cloud for cloud in map(_finite, clouds) if cloud.size > 1]
    if not kept:
        return None
    quantiles = np.array([np.quantile(cloud, [0.004, 0.996]) for cloud in kept])
    a, b = float(quantiles[:, 0].min()), float(quantiles[:, 1].max())
    if truth is not None:
        a, b = min(a, truth), max(b, truth)
    lower, upper = _bound(low), _bound(high)
    # A box that spans decades was given in decades; without one, the draws decide.
    ends = (a if lower is None else lower), (b if upper is None else upper)
    log = min(a, ends[0]) > 0 and np.log10(ends[1] / ends[0]) >= _DECADES_FOR_LOG
    if not b > a:
        pad = 0.05 * abs(a) or 1.0
        return View(a - pad, b + pad, False, (lower, upper))
    if log:
        pad = 0.04 * np.log10(b / a)
        a, b = a * 10**-pad, b * 10**pad
    else:
        pad = 0.04 * (b - a)
        a, b = a - pad, b + pad
    # A bound near the edge of the bulk is the natural end of the axis.
    a = a if lower is None else max(a, lower)
    b = b if upper is None else min(b, upper)
    return View(float(a), float(b), bool(log), (lower, upper))


def curve(draws: np.ndarray, axis: View) -> tuple[np.ndarray, np.ndarray]:
    """Places and heights of the density of the draws; the peak has height one."""
    cloud = _finite(draws)
    bounds = axis.bounds
    if axis.log:
        cloud = np.log10(cloud[cloud > 0])
        bounds = tuple(  # type: ignore[assignment]
            np.log10(b) if b is not None and b > 0 else None for b in bounds
        )
    low, high = bounds
    quartiles = np.quantile(cloud, [0.25, 0.75])
    spread = min(cloud.std(), (quartiles[1] - quartiles[0]) / 1.349) or cloud.std()
    centre = float(np.median(cloud))
    width = max(0.9 * spread * cloud.size**-0.2, 1e-9 * max(abs(centre), 1e-12))
    a, b = cloud.min() - 3 * width, cloud.max() + 3 * width
    counts, edges = np.histogram(cloud, bins=_BINS, range=(a, b))
    bins = 0.5 * (edges[1:] + edges[:-1])
    start = a if low is None else max(a, low)
    stop = b if high is None else min(b, high)
    at = np.linspace(start, stop, _POINTS)

    def kernel(places: np.ndarray) -> np.ndarray:
        gap = (at[:, None] - places[None, :]) / width
        return np.exp(-0.5 * gap**2) @ counts

    height = kernel(bins)
    if low is not None:
        height = height + kernel(2 * low - bins)
    if high is not None:
        height = height + kernel(2 * high - bins)
    return (10.0**at if axis.log else at), height / height.max()
