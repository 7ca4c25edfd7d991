"""Which kinds of missing force predict recordings that a fit has not seen.

In-sample evidence is no guide where residuals are coloured: it counts every sample as
new. So a kind is judged by recordings that are left out, each in turn. The data are
linear in the whitened unknowns ``z``, at the fit of the machine alone. With rows
``[A_b r_b]`` of each recording, the forces' prior sd a scale ``tau`` of their own, and
a fit of the parameters and forces to the others,

    z_b = argmin sum_{c != b} |A_c D z + r_c|^2 + |z + z_0|^2,    D = diag(1, tau),
    m_b = |A_b D z_b + r_b|^2,    gain_b = 1 - m_b(with it) / m_b(without it).

A kind is accepted if its mean gain is `WORTH` and above zero by Student's paired t test
over the recordings, at `LEVEL` for all kinds together (Bonferroni). Of those the one of
largest mean gain is first, others are tried with it. The fit counts coloured samples as
new, and so does the one that makes forecasts: this is what those would gain. To count
them less is to take a smaller scale, of which there are enough.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.special import stdtr

from sim2gp.data.windows import at_most

LEVEL = 0.05
WORTH = 0.01  # of the squared error: less is not worth a force
SCALES = tuple(10.0 ** (-0.5 * k) for k in range(6))
FEW, PARTS = 4, 10  # fewer recordings are cut, to so many parts in all or more
MOST = 100  # parts: of more recordings, successive ones are one

Places = Int[np.ndarray, " _"]
#: Rows ``[A r]`` of one recording, or a triangular factor of them.
Rows = Float[np.ndarray, "_ pr"]


def recordings_or_parts(recording: Int[np.ndarray, " W"]) -> Int[np.ndarray, " W"]:
    """The number of each window's recording, or of its part where those are few.

    Windows of one recording follow each other. Many recordings are joined.
    """
    names, count = np.unique(recording, return_counts=True)
    if len(names) >= FEW:
        return at_most(MOST, recording)
    each = -(-PARTS // len(names))
    found = np.zeros(len(recording), int)
    for k, (name, n) in enumerate(zip(names, count, strict=True)):
        found[recording == name] = each * k + np.arange(n) * each // n
    return found


@dataclass(frozen=True)
class LeaveOneOut:
    """Fits to all recordings but one, and what they predict of that one.

    ``rows`` are those of each recording, ``own`` places of the machine's parameters,
    ``at`` their values ``z_0`` at the fit, ``kinds`` places of the forces.
    """

    rows: Sequence[Rows]
    own: Places
    at: Float[np.ndarray, " o"]
    kinds: Mapping[str, Places]

    def misfit(self, scales: Mapping[str, float]) -> Float[np.ndarray, " b"]:
        """``m_b`` with forces of these kinds at these scales, all others off."""
        places = np.concatenate([self.own, *(self.kinds[kind] for kind in scales)])
        each = [np.full(len(self.kinds[kind]), tau) for kind, tau in scales.items()]
        D = np.concatenate([np.ones(len(self.own)), *each])
        prior = np.append(self.at, np.zeros(len(D) - len(self.at)))
        pairs = zip(self._parts, self._others, strict=True)
        return np.asarray([_left_out(x, rest, places, D, prior) for x, rest in pairs])

    @cached_property
    def _parts(self) -> list[Rows]:
        return [_factor([x]) for x in self.rows]

    @cached_property
    def _others(self) -> list[Rows]:
        x = self._parts
        return [_factor(x[:k] + x[k + 1 :]) for k in range(len(x))]


def helpful_kinds(data: LeaveOneOut) -> dict[str, float]:
    """The scale of each kind that lowers the error on recordings that are left out."""
    found: dict[str, float] = {}
    if len(data.rows) < 2:
        return found
    now = data.misfit(found)
    while rest := [kind for kind in data.kinds if kind not in found]:
        best = {}
        for kind in rest:
            tried = {tau: data.misfit({**found, kind: tau}) for tau in SCALES}
            tau = max(tried, key=lambda t: float(np.mean(1.0 - tried[t] / now)))
            if _is_clear(1.0 - tried[tau] / now, LEVEL / len(data.kinds)):
                best[kind] = tau, tried[tau]
        if not best:
            break
        kind = max(best, key=lambda k: float(np.mean(1.0 - best[k][1] / now)))
        found[kind], now = best[kind]
    return found


def _factor(rows: Sequence[Rows]) -> Rows:
    """The triangular factor of rows together."""
    return np.asarray(np.linalg.qr(np.concatenate(rows), mode="r"))


def _left_out(
    part: Rows,
    others: Rows,
    places: Places,
    D: Float[np.ndarray, " k"],
    prior: Float[np.ndarray, " k"],
) -> float:
    """The squared error of a part, predicted by a fit of the others."""
    A = np.concatenate([others[:, places] * D, np.eye(len(D))])
    z = np.linalg.lstsq(A, -np.append(others[:, -1], prior), rcond=None)[0]
    return float(np.sum((part[:, places] @ (D * z) + part[:, -1]) ** 2))


def _is_clear(gain: Float[np.ndarray, " b"], level: float) -> bool:
    """Whether gains are worth it, and above zero by a t test."""
    mean, n = float(np.mean(gain)), len(gain)
    error = float(np.std(gain, ddof=1)) / np.sqrt(n)
    return mean >= WORTH and float(stdtr(n - 1, -mean / max(error, 1e-300))) <= level
