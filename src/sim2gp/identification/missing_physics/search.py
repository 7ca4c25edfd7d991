"""What physics is missing: every effect of a library scored, the best few fitted.

The score tests (`score_candidates`) rank by one linearisation; then the best are
fitted. An effect whose column lies in the span of the machine's own parameters can
never be separated from them and is not ranked.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.identification.missing_physics.data import FREE, AbstractData
from sim2gp.identification.missing_physics.score import (
    ScoredCandidate,
    sandwich_inflation,
    score_candidates,
    sd_widening,
    tempered_gain,
)
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.registry import Candidate
from sim2gp.systems.effects.registry import candidates as registered
from sim2gp.types import in_float64

REFITS = 3
ODDS = 19.0  # "nothing missing" must be as improbable as 1 in 20


@dataclass(frozen=True)
class FittedCandidate:
    """A candidate fitted in earnest; ``gain`` in nats, ``value`` and ``sd`` physical.

    ``inflation`` is how much larger the variance of the magnitude is when errors may be
    correlated within clusters of windows; the data's part of the gain is divided by it.
    """

    scored: ScoredCandidate
    fitted: Estimate
    gain: float
    value: float
    sd: float
    inflation: float

    @property
    def physical(self) -> bool:
        """Whether the sign is one that the effect can have."""
        return self.scored.candidate.sign * self.value >= 0.0


@dataclass(frozen=True)
class CandidateSearch:
    """Everything that was tried; refits by falling gain."""

    bare: Estimate
    scored: tuple[ScoredCandidate, ...]
    refitted: tuple[FittedCandidate, ...]
    failed: tuple[str, ...] = field(default=())

    @property
    def threshold(self) -> float:
        """Gain from which "nothing" is improbable; the library shares half the odds."""
        ranked = sum(not s.alias for s in self.scored)
        return math.log(ODDS * max(ranked, 1))

    @property
    def best(self) -> FittedCandidate | None:
        """The best candidate that gains enough and has a possible sign."""
        for refit in self.refitted:
            if refit.gain > self.threshold and refit.physical:
                return refit
        return None

    @property
    def tied(self) -> tuple[FittedCandidate, ...]:
        """Candidates that the evidence does not put behind the best (20 to 1)."""
        best = self.best
        if best is None:
            return ()
        least = best.gain - math.log(ODDS)
        return tuple(
            r for r in self.refitted if r is not best and r.physical and r.gain > least
        )


#: How the best candidates are fitted: the name of each, and its fit or None.
Fits = Callable[
    [AbstractData, Estimate, Sequence[ScoredCandidate]],
    Iterable[tuple[str, FittedCandidate | None]],
]


@in_float64
def search_candidates(
    data: AbstractData,
    candidates: Sequence[Candidate] | None = None,
    *,
    refits: int = REFITS,
    fits: Fits | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> CandidateSearch:
    """Fit the bare machine, score every candidate, fit the best few.

    ``fits`` replaces the loop over these, as processes do. Raises what the fit of the
    bare machine raises; a candidate's failure is kept in ``failed``.
    """
    if candidates is None:
        candidates = registered(data.system, windows=not data.period)
    bare = data.fit()
    on_step("the machine as it is")
    scored = score_candidates(data, bare, candidates)
    ranked = sorted((s for s in scored if not s.alias), key=lambda s: -s.gain)
    on_step(f"{len(scored)} effects scored")
    found, failed = [], []
    for name, fit in (fits or _in_turn)(data, bare, ranked[:refits]):
        if fit is None:
            failed.append(name)
        else:
            found.append(fit)
        on_step(f"no fit with {name}" if fit is None else f"fitted with {name}")
    rank = {one.candidate.name: k for k, one in enumerate(ranked)}  # not who was first
    failed.sort(key=lambda name: rank[name])
    found.sort(key=lambda fit: (-fit.gain, rank[fit.scored.candidate.name]))
    return CandidateSearch(bare, tuple(scored), tuple(found), tuple(failed))


def _in_turn(
    data: AbstractData, bare: Estimate, ranked: Sequence[ScoredCandidate]
) -> Iterator[tuple[str, "FittedCandidate | None"]]:
    for one in ranked:
        yield one.candidate.name, refit(data, bare, one)


def refit(
    data: AbstractData, bare: Estimate, scored: ScoredCandidate
) -> FittedCandidate | None:
    """A candidate fitted in earnest; None where that does not converge."""
    try:
        return _refit(data, bare, scored)
    except (NotConverged, NotFinite):
        return None


def _refit(
    data: AbstractData, bare: Estimate, scored: ScoredCandidate
) -> FittedCandidate:
    fitted = data.refit(scored.system, scored.starts, bare)
    table, name = scored.system.parameters, scored.candidate.name
    j = table.names.index(name)
    inflation = _inflation(data, fitted, j)
    raw = float(fitted.log_evidence - bare.log_evidence)
    relative = float(fitted.posterior.sd()[j]) / table[name].sd
    gain = tempered_gain(raw, inflation, relative)
    sized, wide = fitted, table[name].sd
    if table[name].map == "identity":
        sized, wide = _with_free_size(data, scored.system, fitted, j), wide / FREE
    mean, sd = sized.posterior.mean, float(sized.posterior.sd()[j])
    middle = table[name].constrain(float(mean[j]))
    ends = [table[name].constrain(float(mean[j]) + k * sd) for k in (-1.0, 1.0)]
    widening = sd_widening(_inflation(data, sized, j), sd / wide)
    half = 0.5 * (ends[1] - ends[0]) * widening
    return FittedCandidate(scored, fitted, gain, middle, half, inflation)


def _inflation(data: AbstractData, fitted: Estimate, j: int) -> float:
    """That of the variance of parameter ``j`` of a fit."""
    white = np.linalg.solve(fitted.prior.scale, fitted.posterior.scale)
    return sandwich_inflation(
        np.asarray(fitted.scores), data.cluster, white @ white[j], j
    )


def _with_free_size(
    data: AbstractData, system: AbstractSystem, fitted: Estimate, j: int
) -> Estimate:
    """The fit where the effect may be of any size.

    Evidence needs a prior of the size, and that prior draws the effect to zero. Where
    masses and motor are unknown, too, it draws them along, and data do not resist.
    """
    about = fitted.prior
    wide = Gaussian(about.mean, about.scale.at[j, j].divide(FREE))
    start = np.asarray(wide.whitened(fitted.posterior.mean))[None]
    return data.refit(system, start, fitted, wide)
