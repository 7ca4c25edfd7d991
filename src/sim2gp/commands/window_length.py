"""How long windows are, where a project does not say: until the misfit tests speak.

Each window begins at an unknown start, which uses up much of the information of a short
window. A longer window leaves more for the parameters, and shows physics that is
missing: where it shows, intervals allow for it. But an unstable simulator leaves its
recording, and then tells nothing. So the first fit has short windows. While the misfit
tests find nothing, longer ones are fitted from there, as long as the simulator follows
its recordings (`benchmarks/intervals.py`, docs/intervals.md).
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int

from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import likelihood_of
from sim2gp.errors import DeadParameters, InputError, NotConverged, NotFinite
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.identification.misfit.tests import Misfit
from sim2gp.inference.estimate import Estimate
from sim2gp.project import Project
from sim2gp.project.project import SHORT
from sim2gp.project.training_windows import cut_for_fit
from sim2gp.runs.progress import Task
from sim2gp.types import Key, in_float64

#: Lengths that are tried after the short one, s; none is more than half a log.
LENGTHS = (1.0, 5.0)
#: Times the noise of shorter windows: a simulator with more does not follow for longer.
LOST = 2.0
_MANY = (
    "of so many rows longer ones are not tried; write likelihood.window = 1 or 5 in "
    "the project file if the simulator follows its recordings for so long"
)
_STATED = (
    "The misfit tests find nothing. Without likelihood.window in the project file, "
    "identify also tries longer windows, which may narrow the intervals."
)


class WindowFit(NamedTuple):
    """Windows of a project's length, the log and first row of each, and their fit."""

    project: Project
    windows: Windows | Cuts
    places: Int[np.ndarray, "W 2"]
    fitted: Estimate

    def misfit(self) -> Misfit:
        """What the residuals say of the simulator."""
        likelihood = likelihood_of(self.project.system, self.windows)
        return misfit_of_windows(likelihood, self.fitted)


class WindowLength(NamedTuple):
    """A fit with windows of a length, its misfit, and why they are as long."""

    fit: WindowFit
    misfit: Misfit
    why: str

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        project = self.fit.project
        chosen = project.chosen_window is not None
        return {"seconds": project.window, "chosen": chosen, "text": self.why}


@in_float64
def choose_window(
    short: WindowFit,
    logs: Sequence[Log],
    *,
    key: Key,
    task: Task | None = None,
) -> WindowLength:
    """From a fit of short windows the first length at which misfit tests speak.

    The longest where they never do, or where the simulator cannot follow for longer.
    Windows of a stated length stay as they are, and so do very many.
    """
    project, misfit = short.project, short.misfit()
    if not project.chooses_window:
        could = 0.0 < project.window < max(lengths(logs), default=0.0)
        return WindowLength(
            short, misfit, _STATED if could and not misfit.alarm else ""
        )
    best = short._replace(project=project.with_window(project.window))
    if isinstance(short.windows, Cuts):
        return WindowLength(best, misfit, _words(best, _MANY))
    for seconds in lengths(logs):
        if misfit.alarm:
            break
        if task is not None:
            task.advance(f"windows of {seconds:g} s", 0)
        try:
            longer = _fit_longer(best, logs, seconds, key)
            found = longer.misfit()
        except (InputError, NotConverged, NotFinite, DeadParameters) as error:
            why = f"those of {seconds:g} s cannot be fitted ({error})"
            return WindowLength(best, misfit, _words(best, why))
        if not _follows(longer.fitted, best.fitted):
            why = f"for {seconds:g} s the simulator does not follow its recordings"
            return WindowLength(best, misfit, _words(best, why))
        best, misfit = longer, found
    why = "find something in these" if misfit.alarm else "find nothing"
    return WindowLength(best, misfit, _words(best, f"the misfit tests {why}"))


def fit_chosen_windows(project: Project, logs: Sequence[Log], *, key: Key) -> WindowFit:
    """The fit of `identify`: of windows as the project states or as it chooses them."""
    windows, places = cut_for_fit(project, logs)
    robust = project.spec.likelihood.robust
    fitted = fit_windows(project.system, windows, key=key, robust=robust)
    short = WindowFit(project, windows, places, fitted)
    return choose_window(short, logs, key=key).fit


def chosen_window(project: Project, logs: Sequence[Log], *, key: Key) -> Project:
    """The project with windows as `identify` chooses them for these logs."""
    if not project.chooses_window:
        return project
    return fit_chosen_windows(project, logs, key=key).project


def lengths(logs: Sequence[Log]) -> list[float]:
    """Lengths to try after short ones, s: equal parts of the longest log, not all."""
    longest = max(float(log.time[-1] - log.time[0]) + log.period for log in logs)
    parts = [max(2, math.ceil(longest / most - 1e-6)) for most in LENGTHS]
    each = [int(1e3 * longest / n + 1e-6) / 1e3 for n in parts]
    return sorted({x for x in each if x > SHORT})


def _fit_longer(
    known: WindowFit, logs: Sequence[Log], seconds: float, key: Key
) -> WindowFit:
    """A fit of longer windows, from where shorter ones have led."""
    project = known.project.with_window(seconds)
    windows, places = cut_for_fit(project, logs)
    fitted = fit_windows(
        project.system,
        windows,
        key=key,
        robust=project.spec.likelihood.robust,
        warm_start=known.fitted.of_windows(len(windows)),
    )
    return WindowFit(project, windows, places, fitted)


def _words(best: WindowFit, why: str) -> str:
    return f"Windows are {best.project.window:g} s long: {why}."


def _follows(longer: Estimate, shorter: Estimate) -> bool:
    noise = (np.asarray(fit.noise.sd) for fit in (longer, shorter))
    return bool(np.all(next(noise) <= LOST * next(noise)))
