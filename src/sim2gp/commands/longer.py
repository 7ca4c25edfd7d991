"""A second fit: would longer windows teach more, and is the simulator right so long?

Each window begins at an unknown start, which uses up much of the information of a short
window. A longer window leaves more for the parameters, but the simulator must be right
for longer: the misfit tests of such a fit find physics that is too slow to show in a
short window (`benchmarks/intervals.py`, docs/intervals.md).
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from sim2gp.data.logs import Log
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import DeadParameters, InputError, NotConverged, NotFinite
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.identification.words import digits
from sim2gp.project import Project
from sim2gp.project.training_windows import cut_logs
from sim2gp.types import Key, in_float64

TIMES = 5.0  # as long as the project's
_UNASKED = (
    "The misfit tests find nothing: longer windows may narrow the intervals (--longer)."
)
WORTH = 0.8  # of the present sd: some parameter's sd must fall to this


class Longer(NamedTuple):
    """What windows of ``seconds`` say; ``ratio`` of the sd to the present ones.

    ``refused`` is why they say nothing, where they do.
    """

    seconds: float
    ratio: Mapping[str, float]
    refused: str = ""

    def as_dict(self, now: float) -> dict[str, Any]:
        """For summary.json; ``now`` is the present window's length, s."""
        return {
            "seconds": self.seconds,
            "advised": self.advised,
            "ratio": dict(self.ratio),
            "text": self.words(now),
        }

    @property
    def advised(self) -> bool:
        """They are possible, and worth a line."""
        return not self.refused and min(self.ratio.values()) <= WORTH

    def words(self, now: float) -> str:
        """What to do, in a sentence."""
        seconds = f"{self.seconds:g} s instead of {now:g} s"
        if now == 0.0:
            return "There are no windows to lengthen: likelihood.window is 0."
        if self.refused:
            return f"Windows of {seconds} are no way to know more: {self.refused}."
        if not self.advised:
            return f"Windows of {seconds} would tell hardly more."
        few, most = min(self.ratio.values()), max(self.ratio.values())
        return (
            f"Windows of {seconds} leave the misfit tests silent, too, and their "
            f"intervals are {digits(few, 2)} to {digits(most, 2)} times as wide as "
            f"these: likelihood.window = {self.seconds:g} makes them the run's."
        )


def advice(
    project: Project,
    logs: Sequence[Log],
    honest: CorrectedFit,
    *,
    alarm: bool,
    key: Key,
    asked: bool,
) -> dict[str, Any]:
    """The entry "longer" of a summary; where it was not ``asked`` for, a word of it."""
    window = project.spec.likelihood.window
    if asked:
        found = fit_longer_windows(project, logs, honest, alarm=alarm, key=key)
        return {"longer": found.as_dict(window)}
    if alarm or window == 0.0:
        return {}
    unasked = {"seconds": TIMES * window, "advised": None, "text": _UNASKED}
    return {"longer": {**unasked, "ratio": {}}}


def fit_longer_windows(
    project: Project,
    logs: Sequence[Log],
    honest: CorrectedFit,
    *,
    alarm: bool,
    key: Key,
) -> Longer:
    """Fit windows five times as long, unless the misfit tests ``alarm`` already."""
    stated = project.spec.likelihood
    seconds = TIMES * stated.window

    def no(refused: str) -> Longer:
        return Longer(seconds, {}, refused)

    if stated.window == 0.0:
        return no("one row is predicted from the last")
    if alarm:
        return no("the misfit tests find something in these windows already")
    try:  # the run is done, even if this fails
        windows, of = cut_logs(project, logs, TIMES)
        system = project.system
        fitted = fit_windows(system, windows, key=key, robust=stated.robust)
        likelihood = WindowsLikelihood(system, windows)
        alarm = misfit_of_windows(likelihood, fitted).alarm
        fitted = fitted.with_measurements(system.parameters)
        found = corrected_windows(at_zero(likelihood, fitted, of))
    except (InputError, NotConverged, NotFinite, DeadParameters) as error:
        return no(f"they cannot be fitted ({error})")
    if not found.enough:
        return no("the logs have too few of them to say how far they err")
    if alarm:
        return no(
            "the misfit tests then find something, physics that is missing or coloured "
            "noise, too slow to show in these. To look for it make likelihood.window "
            f"= {seconds:g}, run identify, and sim2gp explain on its run"
        )
    return Longer(seconds, _ratios(system.parameters.names, found, honest))


@in_float64
def _ratios(
    names: tuple[str, ...], found: CorrectedFit, honest: CorrectedFit
) -> dict[str, float]:
    ratio = np.asarray(found.posterior.sd()) / np.asarray(honest.posterior.sd())
    return dict(zip(names, ratio.tolist(), strict=True))
