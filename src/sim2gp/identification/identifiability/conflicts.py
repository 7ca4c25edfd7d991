"""Prior against data: said, never averaged away.

A parameter conflicts with its prior where its MAP lies beyond 3 prior sd, or where the
evidence prefers that prior three times as wide by more than ``log 20`` (strong evidence
on the usual scales). With ``u ~ N(m, s^2)`` the posterior of ``(tt_j - mu0_j) / sd0_j``
and ``a = 1 - 1/t^2``, widening the prior of ``u`` from 1 to ``t`` multiplies the
evidence by ``E[N(u; 0, t^2) / N(u; 0, 1)]``, which is in closed form

    log B(t) = -log t - 1/2 log(1 - a s^2) + 1/2 a m^2 / (1 - a s^2).

For a sharp posterior ``B(3) > 20`` means ``|m| > 3.04``: the two rules agree. A vague
one shrinks ``m`` towards the prior and hides the conflict; the evidence still sees it.
(Any improvement at all would ask for ``|m| > 1.6``, and cry wolf for one good prior in
nine.) The same holds for every direction that the data determine, so a conflict spread
over collinear parameters is found too.
"""

import math

import numpy as np

from sim2gp.identification.identifiability.spectrum import Spectrum
from sim2gp.identification.words import digits, weighted_sum

FAR = 3.0  # prior sd
WIDER = 3.0
STRONG = math.log(20.0)


def widening_gain(m: float, s: float, t: float = WIDER) -> float:
    """``log B(t)``, nats, of a posterior ``N(m, s^2)`` in units of the prior."""
    a = 1.0 - 1.0 / t**2
    rest = 1.0 - a * min(s, 1.0) ** 2
    return -math.log(t) - 0.5 * math.log(rest) + 0.5 * a * m**2 / rest


def conflict_of(spec: Spectrum, j: int) -> str:
    """How parameter ``j`` conflicts with its prior, in words; empty if it does not."""
    m = float((spec.mean[j] - spec.prior_mean[j]) / spec.prior_sd[j])
    return _describe_conflict(m, float(spec.sd[j] / spec.prior_sd[j]))


def prior_conflicts(spec: Spectrum) -> list[str]:
    """Every conflict of a parameter; if there is none, those of combinations."""
    found = []
    for j, name in enumerate(spec.names):
        text = conflict_of(spec, j)
        if text:
            found.append(f"{name} lies {text}.")
    if found:
        return found
    z, scale = spec.whitened()
    m = spec.directions.T @ z
    s = np.sqrt(np.sum((spec.directions.T @ scale) ** 2, axis=1))
    for k in np.flatnonzero(~spec.flat):
        text = _describe_conflict(float(m[k]), float(s[k]))
        if text:
            what = weighted_sum(combination(spec, int(k)), spec.names)
            found.append(f"{what} lies {text}, though no parameter alone does.")
    return found


def combination(spec: Spectrum, k: int) -> np.ndarray:
    """What direction ``k`` measures: weights on the parameters in their prior sd."""
    covector = np.linalg.solve(spec.prior_scale.T, spec.directions[:, k])
    return covector * spec.prior_sd


def _describe_conflict(m: float, s: float) -> str:
    gain = widening_gain(m, s)
    if abs(m) <= FAR and gain <= STRONG:
        return ""
    text = (
        f"{digits(abs(m), 2)} prior sd {'above' if m > 0 else 'below'} its prior mean"
    )
    if gain > STRONG:
        text += f", and the evidence gains {digits(gain, 2)} nats with that prior "
        text += "three times as wide"
    return text
