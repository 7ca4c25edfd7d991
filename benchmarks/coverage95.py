"""Nominal 95 % intervals: half-width in sd, and what a coverage says of itself."""

from scipy.stats import beta

Z = 1.959963984540054


def binomial_interval(k: int, n: int) -> list[float]:
    """The 95 % interval of a share of which k of n hold (Clopper and Pearson 1934)."""
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return [low, high]
