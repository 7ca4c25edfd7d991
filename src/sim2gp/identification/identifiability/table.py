"""The table of parameters: moments in physical units, a verdict, and a note in words.

Verdicts, the first that holds. ``sd`` are virtual, ``w`` and ``tie`` as in `spectrum`:

    dead             the data do not depend on it
    at_bound         |tt| > 4 of a boxed parameter: within 2 % of an end of its box
    traded_off       w_j > .05 and tie_ij > .05 for another i, which is named
    prior_dominated  sd > .5 prior sd
    identified       sd <= .2 prior sd and w_j < .01
    weak             else

A parameter whose remaining variance is mostly that of a structurally null direction is
never `identified`, however narrow a partner's prior makes it: no more of the same data
would help.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.identification.identifiability.conflicts import conflict_of
from sim2gp.identification.identifiability.spectrum import (
    DOMINATED,
    IDENTIFIED,
    Spectrum,
)
from sim2gp.identification.words import (
    descending_order,
    digits,
    finite_or_none,
    join_names,
    quantity,
)
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.types import in_float64

BOUND = 4.0
SHARE = 0.05
CLEAN = 0.01
_NODES, _SPAN = 4001, 12.0
_UPPER = 1.959963984540054  # standard normal quantile of .975


def parameter_entries(spec: Spectrum) -> dict[str, dict[str, Any]]:
    """One entry per free parameter, as summary.json and the report want it."""
    table = spec.parameters
    prior = physical_moments(table, spec.prior_mean, spec.prior_sd)
    after = physical_moments(table, spec.mean, spec.sd)
    words = verdicts(spec)
    entries: dict[str, dict[str, Any]] = {}
    for j, p in enumerate(table.free):
        verdict, partners = words[j]
        entries[p.name] = {
            "unit": p.unit,
            "meaning": p.meaning,
            "prior_mean": float(prior["mean"][j]),
            "prior_sd": float(prior["sd"][j]),
            **{key: float(values[j]) for key, values in after.items()},
            "low": finite_or_none(p.low),
            "high": finite_or_none(p.high),
            "verdict": verdict,
            "note": _note(spec, j, verdict, partners),
        }
        if partners:
            entries[p.name]["partners"] = list(partners)
    return entries


def add_plain(
    entries: dict[str, dict[str, Any]], parameters: Parameters, posterior: Gaussian
) -> None:
    """Add the intervals of the plain posterior, which counts every sample."""
    mean, sd = np.asarray(posterior.mean), np.asarray(posterior.scale)
    moments = physical_moments(parameters, mean, np.linalg.norm(sd, axis=1))
    for j, entry in enumerate(entries.values()):
        entry["plain"] = {key: float(values[j]) for key, values in moments.items()}
        sd_before = entry["plain"]["sd"]
        entry["widened"] = entry["sd"] / sd_before if sd_before > 0.0 else None


@in_float64
def physical_moments(
    parameters: Parameters, mean: Float[np.ndarray, " p"], sd: Float[np.ndarray, " p"]
) -> dict[str, Float[np.ndarray, " p"]]:
    """Mean, sd and 95 % interval of ``theta`` where ``tt_j ~ N(mean_j, sd_j^2)``.

    Moments by the trapezoidal rule, which converges exponentially here; quantiles by
    the map, which is monotone.
    """
    # A log-normal's second moment sits at z = 2 sd, so its grid must reach past that.
    log = np.asarray([p.map == "log" for p in parameters.free], bool)
    span = _SPAN + np.where(log, 2.0 * sd, 0.0)
    z = np.linspace(-1.0, 1.0, _NODES)[:, None] * span[None]
    weight = np.exp(-0.5 * z**2)
    weight /= weight.sum(axis=0)
    ends = np.outer([-_UPPER, _UPPER], sd)
    values = mean + np.concatenate([sd * z, ends])
    theta = parameters.constrain(np.asarray(values, float))
    theta, (low, high) = theta[:-2], theta[-2:]
    first = np.sum(weight * theta, axis=0)
    second = np.sum(weight * (theta - first[None]) ** 2, axis=0)
    return {"mean": first, "sd": np.sqrt(second), "q025": low, "q975": high}


def verdicts(spec: Spectrum) -> list[tuple[str, tuple[str, ...]]]:
    """The verdict of every parameter, and whom it is traded off with."""
    P = spec.projection(spec.flat)
    left = spec.sd / spec.prior_sd
    # Along null directions the posterior keeps the prior's variance.
    blind = np.diag(spec.projection(spec.null)) > 0.5 * left**2
    out: list[tuple[str, tuple[str, ...]]] = []
    for j, p in enumerate(spec.parameters.free):
        partners = _partners(spec, P, j)
        if spec.dead[j]:
            out.append(("dead", ()))
        elif p.map in ("bounded", "log_bounded") and abs(spec.at[j]) > BOUND:
            out.append(("at_bound", ()))
        elif P[j, j] > SHARE and partners:
            out.append(("traded_off", partners))
        elif left[j] > DOMINATED:
            out.append(("prior_dominated", ()))
        elif left[j] <= IDENTIFIED and P[j, j] < CLEAN and not blind[j]:
            out.append(("identified", ()))
        else:
            out.append(("weak", ()))
    return out


def _partners(spec: Spectrum, P: Float[np.ndarray, "p p"], j: int) -> tuple[str, ...]:
    """The others in the flat direction that moves ``j`` most, the strongest first."""
    if P[j, j] <= 0.0:
        return ()
    tie = P[:, j] ** 2 / P[j, j]
    order = [i for i in descending_order(tie) if i != j and tie[i] > SHARE]
    return tuple(spec.names[i] for i in order)


def _note(spec: Spectrum, j: int, verdict: str, partners: tuple[str, ...]) -> str:
    p = spec.parameters.free[j]
    left = f"{digits(100.0 * spec.sd[j] / spec.prior_sd[j], 2)} %"
    if verdict == "dead":
        text = "the data do not depend on it: what is shown is the prior"
    elif verdict == "at_bound":
        end, bound = ("upper", p.high) if spec.at[j] > 0 else ("lower", p.low)
        text = f"pressed against its {end} bound of {quantity(bound, p.unit)}"
        if abs(spec.prior_mean[j]) > BOUND:
            text += ", where its prior already put it"
        elif bound == 0.0:
            text = "zero, as far as the data show"
    elif verdict == "traded_off":
        text = f"only together with {join_names(partners)}: see the combinations"
    elif verdict == "prior_dominated":
        text = f"{left} of the prior's spread is left: mostly what was assumed"
    else:
        text = f"{left} of the prior's spread is left"
        behind = _leans_on(spec, j) if verdict == "weak" else ()
        if behind:
            text += f", and only through the prior of {join_names(behind)}"
    conflict = conflict_of(spec, j)
    return f"{text}; against its prior: {conflict}" if conflict else text


def _leans_on(spec: Spectrum, j: int) -> tuple[str, ...]:
    """Whose prior holds a parameter that a structurally null direction touches."""
    P = spec.projection(spec.null)
    if P[j, j] <= 0.5 * (spec.sd[j] / spec.prior_sd[j]) ** 2:
        return ()
    return _partners(spec, P, j)
