"""The first answer of a fit that takes its time, and what a failed one knows.

A fit on a simulator of the host reports every step. As soon as Newton's step is no
longer than a posterior sd, its posterior is written as the run ``NAME-first``: plain
intervals, without forecasts. The whole run replaces it; where the fit fails, the folder
stays, says so, and names the parameters along which it does not converge.
"""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sim2gp.data.logs import Log, note_lines
from sim2gp.errors import NotConverged
from sim2gp.identification import diagnose
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.host_descent import Progress as Descent
from sim2gp.project import Project
from sim2gp.runs import new_run
from sim2gp.runs.progress import Task
from sim2gp.runs.store import check_target

SOON = 1.0  # posterior sd that a first answer may be from its MAP


class FirstAnswer:
    """Told of each step of a fit; ``folder`` is where it writes."""

    def __init__(
        self, project: Project, logs: Sequence[Log], out: Path, task: Task
    ) -> None:
        self.project, self.logs, self.task = project, logs, task
        self.folder = out.parent / f"{out.name}-first"
        check_target(self.folder)
        self._started, self._written = time.perf_counter(), False

    def __call__(self, at: Descent, estimate: Callable[[], Estimate]) -> None:
        seconds = time.perf_counter() - self._started
        left = f"{at.step_sd:.2g} sd to go" if at.step_sd < 1e3 else "far to go"
        cost = float(at.at.cost)
        note = f"posterior, step {at.steps}: cost {cost:.6g}, {left}, {seconds:.0f} s"
        self.task.advance(note, 0)
        if not self._written and at.step_sd <= SOON:
            self.write(estimate())
            self.task.advance(f"first answer in {self.folder}", 0)

    def write(self, known: Estimate, failure: NotConverged | None = None) -> None:
        """The posterior as it stands, marked as no final one."""
        from sim2gp.reports import write_report

        summary = _summary(self.project, self.logs, known, failure)
        with new_run(self.folder, "identify") as writer:
            writer.write_summary(summary)
            writer.write_text("report.html", write_report(summary, {}))
        self._written = True

    @contextmanager
    def of_failures(self) -> Iterator[None]:
        """What a fit knows that does not converge is written; its error says where."""
        try:
            yield
        except NotConverged as error:
            if isinstance(error.known, Estimate):
                self.write(error.known, error)
                error.fix = f"{error.fix}; what it knows so far is in {self.folder}"
            raise

    def replaced(self) -> None:
        """The whole run stands: the first answer goes."""
        if self._written:
            shutil.rmtree(self.folder, ignore_errors=True)


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
