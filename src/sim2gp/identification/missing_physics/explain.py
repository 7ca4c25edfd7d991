"""One of three answers: nothing is missing, this effect is, or none of these.

An effect is missing when its evidence makes "nothing" improbable (`search_candidates`);
whether the library holds the truth is asked of what the best fit leaves over
(`misfit`). Evidence alone would always name somebody: the least bad candidate of a
library that does not hold the truth gains as much as a true one.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from sim2gp.identification.misfit.tests import Misfit
from sim2gp.identification.missing_physics.data import AbstractData
from sim2gp.identification.missing_physics.search import (
    REFITS,
    CandidateSearch,
    Fits,
    search_candidates,
)
from sim2gp.systems.effects.registry import Candidate

Answer = Literal["nothing missing", "missing", "none of these"]


@dataclass(frozen=True)
class Explanation:
    """A search for missing physics and its answer.

    ``misfit`` is that of the ``bare`` machine and of the ``best`` fit (the bare one
    where no effect gains enough); None where the data have no such test.
    """

    search: CandidateSearch
    bare: Misfit | None
    best: Misfit | None

    @property
    def answer(self) -> Answer:
        """What to do about the simulator."""
        if self.best is not None and self.best.alarm:
            return "none of these"
        return "nothing missing" if self.search.best is None else "missing"

    @property
    def effect(self) -> str | None:
        """The missing effect, if the answer names one."""
        best = self.search.best
        named = self.answer == "missing" and best is not None
        return best.scored.candidate.name if named and best is not None else None


def find_missing_physics(
    data: AbstractData,
    candidates: Sequence[Candidate] | None = None,
    *,
    refits: int = REFITS,
    fits: Fits | None = None,
    on_step: Callable[[str], None] = lambda _: None,
) -> Explanation:
    """Search the library of the data's machine, and test what is left over.

    ``candidates`` take the library's place, ``fits`` that of the loop over fits. Raises
    what the bare machine's fit raises.
    """
    found = search_candidates(
        data, candidates, refits=refits, fits=fits, on_step=on_step
    )
    best = bare = data.misfit(data.system, found.bare)
    if found.best is not None:
        best = data.misfit(found.best.scored.system, found.best.fitted)
    return Explanation(found, bare, best)
