"""The first answer of a fit that takes its time, and what a failed one knows.

A fit on a simulator of the host reports every step. As soon as Newton's step is no
longer than a posterior sd, its posterior is handed on: plain intervals, without
forecasts. Where the fit fails, what it knows is handed on as well, marked as such.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from sim2gp.commands.identification import Identification
from sim2gp.data.logs import Log, note_lines
from sim2gp.errors import NotConverged
from sim2gp.identification import diagnose
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.host_descent import Progress as Descent
from sim2gp.project import Project
from sim2gp.runs.progress import Task

SOON = 1.0  # posterior sd that a first answer may be from its MAP


class FirstAnswer:
    """Called at each step of a fit; ``keep`` gets the answer and returns its place."""

    def __init__(
        self,
        project: Project,
        logs: Sequence[Log],
        task: Task,
        keep: Callable[[Identification], str] | None,
    ) -> None:
        self.project, self.logs, self.task, self.keep = project, logs, task, keep
        self._started, self._kept = time.perf_counter(), False

    def __call__(self, at: Descent, estimate: Callable[[], Estimate]) -> None:
        seconds = time.perf_counter() - self._started
        left = f"{at.step_sd:.2g} sd to go" if at.step_sd < 1e3 else "far to go"
        cost = float(at.at.cost)
        note = f"posterior, step {at.steps}: cost {cost:.6g}, {left}, {seconds:.0f} s"
        self.task.advance(note, 0)
        if self.keep and not self._kept and at.step_sd <= SOON:
            where = self.keep(self._answer(estimate()))
            self._kept = True
            self.task.advance(f"first answer in {where}", 0)

    @contextmanager
    def of_failures(self) -> Iterator[None]:
        """What a fit knows that does not converge is kept; its error says where."""
        try:
            yield
        except NotConverged as error:
            if self.keep and isinstance(error.known, Estimate):
                where = self.keep(self._answer(error.known, error))
                error.fix = f"{error.fix}; what it knows so far is in {where}"
            raise

    def _answer(
        self, known: Estimate, failure: NotConverged | None = None
    ) -> Identification:
        """The posterior so far, marked as not final."""
        return Identification(_summary(self.project, self.logs, known, failure))


def _summary(
    project: Project,
    logs: Sequence[Log],
    known: Estimate,
    failure: NotConverged | None,
) -> dict[str, Any]:
    table = project.system.parameters
    known = known.with_measurements(table)
    found = diagnose.summary(table, known.prior, known.posterior, known.information)
    distance = float(known.convergence.newton_step_sd)
    said = (
        f"The fit failed; this is where it stood. {failure}"
        if failure
        else f"The first answer of a fit that goes on, {distance:.2g} posterior sd "
        "from its MAP, of a part of the data where these are many; its intervals count "
        "the model as right."
    )
    return {
        "command": "identify",
        "title": f"{project.name}: {'a failed fit' if failure else 'first answer'}",
        "headline": said,
        "first_answer": True,
        "converged": False,
        "convergence": known.convergence.as_dict(),
        "warnings": [said, *note_lines(logs)],
        **found,
    }
