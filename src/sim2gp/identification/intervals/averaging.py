"""The average over which forces a simulator lacks, and how strong they are.

Standard normal unknowns ``c`` and data ``|root c - data|^2 / 2``; of a group that is on
the prior sd is a scale ``tau``, of one that is off it is zero. With ``D`` the sd,

    [root D; I] = Q T,   mean = D T^-1 Q_1^T d,   log p(d) = 1/2 |Q_1^T d|^2 - log |T|.

There are more sets of groups than can be tried. From none on, one group at a time and
each of its scales are tried, the best is kept, and others are tried with it, as long as
the posterior probability grows; all that was tried is averaged (Madigan and Raftery
1994, JASA 89: Occam's window).
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from sim2gp.inference.gaussian import of_mixture

#: Places of the unknowns of each group, by its name.
Groups = Mapping[str, Int[np.ndarray, " _"]]
Scales = Mapping[str, float]  # of the groups that are on
NONE = ""  # no group at all
#: Prior probability that nothing is missing; and of one group more, relative.
NOTHING, MORE = 0.5, 0.5
SHARES = tuple(10.0 ** (-0.4 * k) for k in range(6))  # scales, alike
MOST = 4  # groups


class _Found(NamedTuple):
    scales: Scales
    log_probability: float
    mean: Float[np.ndarray, " p"]
    scale: Float[np.ndarray, "p p"]


def averaged(
    root: Float[np.ndarray, "q p"],
    data: Float[np.ndarray, " q"],
    groups: Groups,
    alone: tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]] | None = None,
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"], dict[str, float]]:
    """Mean and scale of the unknowns; the probability of each group, and of `NONE`.

    ``alone`` are mean and scale without any group, where they are known better than
    from ``root``.
    """
    best = _posterior(root, data, groups, {})
    found = [best]
    while len(best.scales) < min(MOST, len(groups)):
        tried = [_posterior(root, data, groups, s) for s in _more(best.scales, groups)]
        found += tried
        top = max(tried, key=lambda f: f.log_probability)
        if not top.log_probability > best.log_probability:
            break
        best = top
    logs = np.asarray([f.log_probability for f in found])
    weights = np.exp(logs - logs.max())
    weights = weights / weights.sum()
    if alone is not None:
        found[0] = found[0]._replace(mean=alone[0], scale=alone[1])
    means, scales = np.stack([f.mean for f in found]), [f.scale for f in found]
    mean, scale = of_mixture(weights, means, np.stack(scales))
    of = {name: [name in f.scales for f in found] for name in groups}
    each = {name: float(weights @ np.asarray(on, float)) for name, on in of.items()}
    return mean, scale, {NONE: float(weights[0])} | each


def _more(scales: Scales, groups: Groups) -> Iterator[Scales]:
    """One group more, at each scale."""
    for name in groups:
        if name not in scales:
            for share in SHARES:
                yield {**scales, name: share}


def _posterior(
    root: Float[np.ndarray, "q p"],
    data: Float[np.ndarray, " q"],
    groups: Groups,
    scales: Scales,
) -> _Found:
    q, p = root.shape
    D = np.ones(p)
    for name, places in groups.items():
        D[places] = scales.get(name, 0.0)
    Q, T = np.linalg.qr(np.concatenate([root * D, np.eye(p)]))
    onto = Q[:q].T @ data
    mean = D * np.linalg.solve(T, onto)
    scale = np.linalg.solve(T.T, np.diag(D)).T
    log_det = float(np.sum(np.log(np.abs(np.diag(T)))))
    evidence = 0.5 * float(onto @ onto) - log_det
    return _Found(scales, evidence + _log_prior(len(scales), len(groups)), mean, scale)


def _log_prior(on: int, groups: int) -> float:
    """Of one set of so many groups, at one scale of each."""
    if not groups:
        return 0.0
    if not on:
        return math.log(NOTHING)
    sizes = sum(MORE**k for k in range(1, min(MOST, groups) + 1))
    of_size = (1.0 - NOTHING) * MORE**on / sizes
    return math.log(of_size / math.comb(groups, on)) - on * math.log(len(SHARES))
