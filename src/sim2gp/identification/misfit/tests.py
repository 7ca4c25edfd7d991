"""Does the model fit the data at all? Four tests of what it leaves over.

A posterior is only as good as its model: with dry friction of a size that reduced
chi-squared does not see, intervals of the damping never cover the truth. Each test
looks at the residuals ``e = (I - P) r``, where ``P`` projects on what the fit could
move: the columns of the Jacobian, and of the nuisances of each group (start states).
In a linear model with Gaussian noise ``e`` then has noise alone, for any prior.

    chi2        sum e^2 / dof against 1, where the noise is known; where it was
                estimated from the same residuals the test says nothing, and says so
    ljung_box   correlation of e from row to row over `LAGS` lags, inside a group
                (Ljung and Box 1978)
    f_test      do features of the inputs, random but fixed, explain e?
    split_half  would two halves of the data give other parameters? Early against late
                rows, and gentle against vigorous ones (Chow 1960)

All but the first are free of the noise's scale; F and split-half tests are exact in the
linear case. With several channels, or two ways to split, the smallest p value counts as
often as there were chances. Each test alone is at `LEVEL`; all four together raise a
false alarm in at most 4 cases of 1,000.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import chdtrc, gammaincc

from sim2gp import checks
from sim2gp.identification.misfit.projection import SPARE, ProjectedResiduals
from sim2gp.identification.misfit.words import Finding, make_finding, misfit_verdict

LEVEL = 1e-3
LAGS = 20
FEATURES = 12  # random ones, and one for each input
FEATURE_SEED = 0  # names one set of functions; the same data get the same verdict
PAIRS = 50  # a lag with fewer pairs of rows is left out


@dataclass(frozen=True)
class Misfit:
    """Four findings and what they mean together.

    ``tests`` are keyed chi2, ljung_box, f_test and split_half.
    """

    tests: dict[str, Finding]
    verdict: str
    rows: int

    @property
    def alarm(self) -> bool:
        """Whether any test speaks against the model."""
        return any(finding.alarm for finding in self.tests.values())

    def as_dict(self) -> dict[str, object]:
        """For summary.json; a statistic or p value that does not exist is None."""
        tests = {name: finding.as_dict() for name, finding in self.tests.items()}
        return {"verdict": self.verdict, "alarm": self.alarm, "tests": tests}


def misfit(
    residuals: Float[np.ndarray, "N d"],
    inputs: Float[np.ndarray, "N k"],
    *,
    jacobian: Float[np.ndarray, "N d p"] | None = None,
    nuisance: Float[np.ndarray, "N d n"] | None = None,
    past: Float[np.ndarray, "N l"] | None = None,
    group: Int[np.ndarray, " N"] | None = None,
    mask: Bool[np.ndarray, "N *d"] | None = None,
    noise_known: bool = False,
    channels: Sequence[str] = (),
    rows: str = "transitions",
) -> Misfit:
    """The four tests on residuals at a fit, in units of their noise.

    ``inputs`` are what the residuals might depend on (states and inputs, angles as sine
    and cosine), in any unit. ``jacobian`` is that of the residuals in the fitted
    unknowns, ``nuisance`` in those of each group. ``past`` are further columns that are
    tried as they are: past inputs find a delay. ``group`` numbers the episodes or
    windows; rows of one follow each other, and only those are tested for correlation.
    Rows or entries with a false ``mask`` do not count. ``noise_known`` says that the
    noise was not estimated from these residuals. ``channels`` and ``rows`` are words.
    Raises `NotFinite` E203 on a residual, Jacobian or input that is not a number.
    """
    N, d = residuals.shape
    valid = np.ones((N, d), bool) if mask is None else np.asarray(mask, bool)
    valid = np.broadcast_to(valid[:, None] if valid.ndim == 1 else valid, (N, d))
    run = np.zeros(N, int) if group is None else _run_numbers(np.asarray(group))
    empty = np.zeros((N, d, 0))
    columns = [empty if A is None else np.asarray(A) for A in (nuisance, jacobian)]
    own, J, r = (
        np.where(valid[..., None], A, 0.0) for A in (*columns, residuals[..., None])
    )
    extra = np.zeros((N, 0)) if past is None else np.asarray(past)
    used = np.asarray(valid.any(axis=1))
    x, extra = (np.where(used[:, None], A, 0.0) for A in (inputs, extra))
    named = {"residuals": (r,), "Jacobian": (J, own), "inputs": (x, extra)}
    for what, arrays in named.items():
        for A in arrays:
            checks.finite_results("the misfit tests", what, A)
    x, extra = _standardised(x, used), _standardised(extra, used)
    names = list(channels) or [f"channel {c + 1}" for c in range(d)]

    stated = ProjectedResiduals(r, J, own, run, valid)
    scaled = stated.in_units_of(stated.rms())
    tests = {
        "chi2": make_finding("chi2", *_chi2_test(stated, noise_known), LEVEL),
        "ljung_box": make_finding("ljung_box", *_ljung_box_test(scaled, names), LEVEL),
        "f_test": make_finding("f_test", *_f_test(scaled, x, extra, names), LEVEL),
        "split_half": make_finding("split_half", *_split_half(scaled, x), LEVEL),
    }
    count = int(used.sum())
    return Misfit(tests, misfit_verdict(tests, count, rows), count)


#: Statistic, its degrees of freedom, p value, and what it is about.
Result = tuple[float, int, float, dict[str, object]]
NOTHING = np.nan, 0, np.nan


def _likeliest(chances: list[Result]) -> Result:
    """The smallest of several p values, times their number (Bonferroni)."""
    tested = [result for result in chances if not np.isnan(result[2])]
    if not tested:
        return *NOTHING, {}
    statistic, freedom, p, about = min(tested, key=lambda result: result[2])
    return statistic, freedom, min(1.0, len(tested) * p), about


def _chi2_test(data: ProjectedResiduals, known: bool) -> Result:
    about: dict[str, object] = {"known": known}
    if not known or data.freedom < 1:
        return *NOTHING, about
    total, freedom = float(np.sum(data.e**2)), data.freedom
    return total / freedom, freedom, float(chdtrc(freedom, total)), about


def _ljung_box_test(data: ProjectedResiduals, names: Sequence[str]) -> Result:
    chances: list[Result] = []
    for c, name in enumerate(names):
        Q, lags, first = ljung_box(
            data.e[:, c], data.run, data.valid[:, c], data.hat[:, c]
        )
        p = ljung_box_tail(Q, lags, int(data.valid[:, c].sum())) if lags else np.nan
        chances.append((Q, lags, p, {"channel": name, "first": first, "lags": lags}))
    return _likeliest(chances)


def ljung_box(
    e: Float[np.ndarray, " N"],
    run: Int[np.ndarray, " N"],
    valid: Bool[np.ndarray, " N"],
    hat: Float[np.ndarray, "N h"],
) -> tuple[float, int, float]:
    """Statistic, number of lags, and the correlation at the first one.

    Only pairs of rows of one run count, and at each lag the number of pairs takes the
    place of ``N - k``. The projection alone leaves ``-h_t h_s`` in the mean of a
    product, in units of the noise before it: it is taken off. With one run, no mask and
    no ``hat`` this is the textbook's statistic.
    """
    N = int(valid.sum())
    noise = max(float(np.sum(e[valid] ** 2)) / max(N, 1), 0.25)
    left = max(N - float(np.sum(hat[valid] ** 2)), 1.0) / max(N, 1)
    total, lags, first = 0.0, 0, 0.0
    for k in range(1, min(LAGS, len(e) - 1) + 1):
        pair = (run[k:] == run[:-k]) & valid[k:] & valid[:-k]
        pairs = int(pair.sum())
        if pairs < PAIRS:
            continue
        product = float(np.sum((e[k:] * e[:-k])[pair]))
        bias = -noise / left * float(np.sum((hat[k:] * hat[:-k])[pair]))
        total += ((product - bias) / noise) ** 2 / pairs
        first = product / noise / pairs if k == 1 else first
        lags += 1
    return total * (N + 2.0) / max(N, 1), lags, first


def ljung_box_tail(Q: float, lags: int, N: int) -> float:
    """Chance of so large a statistic for white noise: chi-squared for large ``N``.

    Products of the same residuals depend on each other: at 250 rows and 20 lags the
    chi-squared of `lags` exceeds its level of 1e-3 in 2.7 cases of 1,000. A gamma
    variable with the statistic's own variance and skewness (fitted to simulated white
    noise, 60 to 2,000 rows, 5 and 20 lags) takes its place.
    """
    share = lags / N
    sd = math.sqrt(2.0 * lags * (1.0 + 1.7 * share))
    skewness = math.sqrt(8.0 / lags) * (1.0 + 5.0 * share)
    shape = 4.0 / skewness**2
    x = shape + math.sqrt(shape) * (Q - lags) / sd
    return float(gammaincc(shape, max(x, 0.0)))


def _f_test(
    data: ProjectedResiduals,
    x: Float[np.ndarray, "N k"],
    past: Float[np.ndarray, "N l"],
    names: Sequence[str],
) -> Result:
    """Of features of the inputs, a constant, and the past.

    ``tanh`` of each standardised input and of random sums of them. Steps and
    saturations are what simulators leave out, and what these can follow. Random sums
    alone needed luck to follow dry friction: its power at 2,000 rows was .75 to .98 by
    their seed, with the inputs one by one .99 and more.
    """
    draw, k = np.random.default_rng(FEATURE_SEED), x.shape[1]
    room = data.freedom // (2 * SPARE) - k - past.shape[1]
    sums = min(FEATURES, max(room, 0))
    mixed = draw.standard_normal((k, sums)) / np.sqrt(max(k, 1))
    W = np.concatenate([np.eye(k), mixed], axis=1).T
    b = np.concatenate([np.zeros(k), draw.standard_normal(sums)])

    def feature(j: int) -> Float[np.ndarray, " N"]:
        if j < len(W):
            return np.asarray(np.tanh(2.0 * x @ W[j] + b[j]))
        return np.ones(len(x)) if j == len(W) else past[:, j - len(W) - 1]

    chances: list[Result] = []
    for c, name in enumerate(names):

        def column(j: int, c: int = c) -> Float[np.ndarray, "N d"]:
            found = np.zeros(data.valid.shape)
            found[:, c] = feature(j)
            return found

        found = data.explains(len(W) + 1 + past.shape[1], column)
        chances.append((*found, {"channel": name}))
    return _likeliest(chances)


def _split_half(data: ProjectedResiduals, x: Float[np.ndarray, "N k"]) -> Result:
    """Would parameters of their own for each half explain the residuals?

    The columns are those of the Jacobian with the sign turned in one half. In
    the linear case the squares they explain are the squared Mahalanobis distance of
    the halves' estimates. Directions that the prior holds (singular values below 1,
    for a Jacobian per prior sd) are no part of it.
    """
    N, d = data.valid.shape
    used = data.valid.any(axis=1)
    informed = data.basis[:, data.size > 1.0].reshape(N, d, -1)
    size = np.linalg.norm(x, axis=1)
    splits = {
        "late": np.cumsum(used) > 0.5 * used.sum(),
        "vigorous": size > np.median(size[used]) if used.any() else used,
    }
    chances: list[Result] = []
    for name, half in splits.items():
        sign = np.where(half, 1.0, -1.0)[:, None]

        def column(j: int, sign: np.ndarray = sign) -> Float[np.ndarray, "N d"]:
            return np.asarray(sign * informed[..., j])

        ratio, q, p = data.explains(informed.shape[2], column)
        about: dict[str, object] = {"split": name, "times": math.sqrt(ratio)}
        chances.append((ratio * q, q, p, about))
    return _likeliest(chances)


def _run_numbers(group: Int[np.ndarray, " N"]) -> Int[np.ndarray, " N"]:
    """0, 1, 2, ... for successive stretches of one number."""
    return np.cumsum(np.diff(group, prepend=group[:1]) != 0)


def _standardised(
    x: Float[np.ndarray, "N k"], used: Bool[np.ndarray, " N"]
) -> Float[np.ndarray, "N _"]:
    """Mean 0 and sd 1 over the used rows; constant columns and unused rows are 0."""
    if not used.any():
        return np.zeros((len(x), 0))
    middle, spread = x[used].mean(axis=0), x[used].std(axis=0)
    live = ~(spread <= 1e-9 * (np.abs(middle) + spread))
    z = (x[:, live] - middle[live]) / spread[live]
    return np.where(used[:, None], z, 0.0)
