"""One of three answers: nothing is missing, this effect is, or none of these.

An effect is missing when its evidence makes "nothing" improbable (`search_candidates`);
whether the library holds the truth is asked of what the best fit leaves over
(`misfit`). Evidence alone would always name somebody: the least bad candidate of a
library that does not hold the truth gains as much as a true one.

Where the answer is a force, or no effect of the library, all forces are asked for at
once (`find_forces`) and drawn. The search decides what is said: a named force is drawn
under the search's name, and forces get names of their own (`name_of`) only where no
effect of the library is the answer.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

from sim2gp.identification.misfit.tests import Misfit
from sim2gp.identification.missing_physics.curves import Curve
from sim2gp.identification.missing_physics.data import AbstractData
from sim2gp.identification.missing_physics.forces import FoundForces, find_forces
from sim2gp.identification.missing_physics.search import (
    REFITS,
    CandidateSearch,
    Fits,
    FittedCandidate,
    search_candidates,
)
from sim2gp.identification.missing_physics.shapes import Name, name_of
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.base import AbstractInputEffect, AbstractJointForce
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
    forces: FoundForces = field(default_factory=FoundForces)

    @property
    def drawn(self) -> tuple[Curve, ...]:
        """The forces to draw: that of the answer, or all where no effect is one."""
        if self.answer == "none of these":
            return self.forces.found
        place = _place(self.search.best) if self.effect else None
        return tuple(c for c in self.forces.found if (c.where, c.of) == place)

    def names(self, system: AbstractSystem) -> dict[str, Name | None]:
        """Of drawn forces, where no effect of the library is the answer: shapes that
        fit within the band."""
        if self.answer != "none of these":
            return {}
        return {c.name: name_of(c, system) for c in self.drawn}

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
    answer = Explanation(found, bare, best)
    if answer.answer == "none of these" or _place(found.best) is not None:
        forces = find_forces(data, found.bare)
        on_step("forces")
        return Explanation(found, bare, best, forces)
    return answer


def _place(best: FittedCandidate | None) -> tuple[str, str] | None:
    """Where a force acts and of what it is a function; None for what is no force."""
    if best is None:
        return None
    effect = best.scored.candidate.effect
    if isinstance(effect, AbstractInputEffect):
        return effect.where, effect.where
    if not isinstance(effect, AbstractJointForce):
        return None
    by_position = effect.powers[0] > 0
    return effect.where, effect.where if by_position else f"{effect.where}.velocity"
