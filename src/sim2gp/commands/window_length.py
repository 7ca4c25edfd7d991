"""How long windows are, where a project does not say it.

Each window begins at an unknown start, which uses up much of the information of a short
window. A longer window leaves more for the parameters, and shows physics that is
missing: where it shows, intervals allow for it. But an unstable simulator leaves its
recording, and then tells nothing. So the first fit has short windows, and longer ones
are fitted from there: of a stable simulator in any case, others as long as the misfit
tests find nothing and the simulator follows its recordings. Much longer ones are not
fitted where the tests find something, because these are too few to say how far they err
(`benchmarks/intervals.py`, docs/intervals.md). Nor are those that are hard to fit, or
that leave short logs out. Of very many windows some choose the length, and all are then
fitted with it.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from sim2gp.data.logs import Log
from sim2gp.data.windows import channel_motion
from sim2gp.data.windows_likelihood import likelihood_of, linearise_some
from sim2gp.errors import DeadParameters, InputError, NotConverged, NotFinite
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.identification.misfit.tests import Misfit
from sim2gp.inference.estimate import Estimate
from sim2gp.project import Project
from sim2gp.project.project import SHORT
from sim2gp.project.training_windows import TrainingWindows, cut_for_fit
from sim2gp.runs.progress import Task
from sim2gp.types import Key, in_float64

#: Lengths that are tried after the short one, s; none is more than half a log.
LENGTHS = (1.0, 5.0)
#: Times the noise of shorter windows: a simulator with more does not follow for longer.
LOST = 2.0
#: Times that errors of starts may grow within a window of a stable simulator (rms).
STABLE = 3.0
#: Share of the samples that longer windows must have: logs are shorter than some.
KEPT = 0.8
#: Steps of a fit. One that needs more has a cost with kinks, as of sharp friction; of a
#: part of the data it may not converge at all.
SLOW = 100
_STATED = (
    "The misfit tests find nothing. Without likelihood.window in the project file, "
    "identify also tries longer windows, which may narrow the intervals."
)


class WindowFit(NamedTuple):
    """Windows of a project's length, and their fit."""

    project: Project
    cut: TrainingWindows
    fitted: Estimate

    def misfit(self) -> Misfit:
        """What the residuals say of the simulator."""
        likelihood = likelihood_of(self.project.system, self.cut.windows)
        return misfit_of_windows(likelihood, self.fitted)


class WindowLength(NamedTuple):
    """A fit with windows of a length, its misfit, and why they are as long."""

    fit: WindowFit
    misfit: Misfit
    why: str

    def as_dict(self) -> dict[str, Any]:
        """For summary.json."""
        return window_entry(self.fit.project, self.why)


def window_entry(project: Project, text: str) -> dict[str, Any]:
    """For summary.json: how long windows are, and why."""
    chosen = project.chosen_window is not None
    return {"seconds": project.window, "chosen": chosen, "text": text}


@in_float64
def choose_window(
    short: WindowFit,
    logs: Sequence[Log],
    *,
    key: Key,
    task: Task | None = None,
) -> WindowLength:
    """How long windows are, from a fit of short ones.

    The first length at which misfit tests speak, but at least a second if the simulator
    is stable; the longest if they never do; no longer than the simulator can follow.
    Windows of a stated length stay as they are. If ``short`` has some of very many
    windows, the fit that is returned has, too (`fit_all`).
    """
    project, misfit = short.project, short.misfit()
    if not project.chooses_window:
        could = 0.0 < project.window < max(lengths(logs), default=0.0)
        return WindowLength(
            short, misfit, _STATED if could and not misfit.alarm else ""
        )
    best = short._replace(project=project.with_window(project.window))
    for seconds in lengths(logs):
        if misfit.alarm and seconds > LENGTHS[0]:
            break
        if task is not None:
            task.advance(f"windows of {seconds:g} s", 0)
        found = _followed(best, logs, seconds, key, some=True, alarm=misfit.alarm)
        if isinstance(found, str):
            return WindowLength(best, misfit, _words(best, found))
        best, misfit = found
    what = "something" if misfit.alarm else "nothing"
    why = f"the misfit tests find {what} in these"
    return WindowLength(best, misfit, _words(best, why))


@in_float64
def fit_all(
    chosen: WindowLength,
    logs: Sequence[Log],
    *,
    key: Key,
    task: Task | None = None,
) -> WindowLength:
    """A fit of all windows, where some of them have chosen the length.

    Short ones, if the simulator does not follow all recordings for so long.
    """
    fit, why = chosen.fit, chosen.why
    if fit.cut.is_whole():
        return chosen
    if task is not None:
        task.advance(f"all {fit.cut.total} windows", 0)
    if fit.project.window > SHORT:
        found = _followed(fit, logs, fit.project.window, key)
        if not isinstance(found, str):
            return WindowLength(*found, why)
        why = f"Windows are {SHORT:g} s long: {found}."
    project = fit.project.with_window(SHORT)
    fit = _fit(project, cut_for_fit(project, logs), key)
    return WindowLength(fit, fit.misfit(), why)


def fit_chosen_windows(
    project: Project, logs: Sequence[Log], *, key: Key, task: Task | None = None
) -> WindowLength:
    """The fit of `identify`: of windows as the project states or as it chooses them."""
    cut = cut_for_fit(project, logs, some=project.chooses_window)
    short = _fit(project, cut, key)
    chosen = choose_window(short, logs, key=key, task=task)
    return fit_all(chosen, logs, key=key, task=task)


def chosen_window(project: Project, logs: Sequence[Log], *, key: Key) -> Project:
    """The project with windows as `identify` chooses them for these logs."""
    if not project.chooses_window:
        return project
    return fit_chosen_windows(project, logs, key=key).fit.project


def keeps_samples(project: Project, logs: Sequence[Log]) -> bool:
    """Whether windows of its length have most samples of logs that may be short."""
    short = cut_for_fit(project.with_window(SHORT), logs)
    try:
        return _samples(cut_for_fit(project, logs)) >= KEPT * _samples(short)
    except InputError:  # they have none
        return False


def lengths(logs: Sequence[Log]) -> list[float]:
    """Lengths to try after short ones, s: equal parts of the longest log, not all."""
    longest = max(float(log.time[-1] - log.time[0]) + log.period for log in logs)
    parts = [max(2, math.ceil(longest / most - 1e-6)) for most in LENGTHS]
    each = [int(1e3 * longest / n + 1e-6) / 1e3 for n in parts]
    return sorted({x for x in each if x > SHORT})


def _samples(cut: TrainingWindows) -> float:
    """Of all windows; of very many, as some have them."""
    each = np.asarray(cut.windows.counts).sum(axis=1)
    return float(each.mean() * cut.total)


def _followed(
    known: WindowFit,
    logs: Sequence[Log],
    seconds: float,
    key: Key,
    *,
    some: bool = False,
    alarm: bool = False,
) -> tuple[WindowFit, Misfit] | str:
    """A fit of longer windows, or why they are not taken.

    ``alarm``: the misfit tests find something in the shorter ones.
    """
    project = known.project.with_window(seconds)
    try:
        cut = cut_for_fit(project, logs, some=some)
        if _samples(cut) < KEPT * _samples(known.cut):
            return f"logs are too short for those of {seconds:g} s"
        longer = _fit(project, cut, key, start=known.fitted)
        steps = int(longer.fitted.convergence.steps)
        if steps > SLOW:
            return f"a fit of those of {seconds:g} s takes {steps} steps"
        found = longer.misfit()
        lost = _noise_grows(longer.fitted, known.fitted)
        if not (alarm or lost):
            return longer, found
        grown = start_growth(longer) if seconds <= LENGTHS[0] else math.inf
    except (InputError, NotConverged, NotFinite, DeadParameters) as error:
        return f"those of {seconds:g} s cannot be fitted ({error})"
    if grown <= STABLE:
        return longer, found
    if lost:
        return f"for {seconds:g} s the simulator does not follow its recordings"
    return f"in {seconds:g} s errors of their starts grow {grown:.2g} times"


def _noise_grows(longer: Estimate, shorter: Estimate) -> bool:
    noise, before = (np.asarray(fit.noise.sd) for fit in (longer, shorter))
    return not bool(np.all(noise <= LOST * before))


@in_float64
def start_growth(fit: WindowFit) -> float:
    """How many times errors of starts grow: most within each window, rms over windows.

    Of measured channels, each in units of its motion.
    """
    likelihood = likelihood_of(fit.project.system, fit.cut.windows)
    cut, fitted, found = linearise_some(likelihood, fit.fitted)
    starts, outputs = slice(fitted.prior.mean.size, None), list(cut.outputs)
    J = np.asarray(found.jacobian)[..., starts][..., outputs]
    if not np.isfinite(J).all():
        return math.inf
    slope = J / np.asarray(cut.start_sd)[:, None, None, outputs]
    measured = np.maximum(np.asarray(cut.mask).any(axis=1).sum(axis=0), 1)
    noise = np.asarray(fitted.noise.sd)
    size = np.sqrt(channel_motion(cut).sum(axis=0) / measured + noise**2)
    each = np.linalg.norm(slope * size / size[:, None], ord=2, axis=(2, 3))
    return float(np.sqrt(np.mean(each.max(axis=1) ** 2)))


def _fit(
    project: Project,
    cut: TrainingWindows,
    key: Key,
    *,
    start: Estimate | None = None,
) -> WindowFit:
    """A fit of the project's windows, from one of windows of another length."""
    fitted = fit_windows(
        project.system,
        cut.windows,
        key=key,
        robust=project.spec.likelihood.robust,
        warm_start=start and start.of_windows(len(cut.windows)),
    )
    return WindowFit(project, cut, fitted)


def _words(best: WindowFit, why: str) -> str:
    cut, by = best.cut, ""
    if not cut.is_whole():
        by = f", chosen by a fit of {len(cut.windows)} of {cut.total}"
    return f"Windows are {best.project.window:g} s long{by}: {why}."
