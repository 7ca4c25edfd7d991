"""Explain: what physics does the simulator of a finished run lack?

The run of an identification brings its project file and logs, that of a demo its own
transitions. Every effect of the library is scored, the best few are fitted, and the
answer is one of three: nothing, an effect, or none of these.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.commands.identification import PROJECT, project_of, stood
from sim2gp.data.logs import Budget
from sim2gp.errors import InputError
from sim2gp.identification.missing_physics.data import (
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.explain import explain
from sim2gp.identification.missing_physics.words import candidate_rows, headline, table
from sim2gp.planning.tasks import MACHINES
from sim2gp.project import Project, load_project
from sim2gp.project.amend import amend
from sim2gp.project.training_windows import cut_logs
from sim2gp.runs import Progress, load_run, new_run
from sim2gp.runs.provenance import command, provenance
from sim2gp.runs.store import Run

SHARED_SECOND = 1.0  # s of windows whose errors may be correlated


def run(
    run: Path,
    *,
    add: bool,
    out: Path,
    progress: Progress,
    strict: bool = False,
    budget: Budget | None = None,
) -> dict[str, Any]:
    """Search what the run's machine lacks, write and return the summary.

    ``add`` writes the winner into the project file; ``budget`` is what reading one of
    the run's logs may take. Raises `InputError` E130 for a run
    of another command, E160 where there is no project file to add to.
    """
    started = time.perf_counter()
    stored = load_run(run)
    file = _project_file(run, stored, add)
    data = _data(run, stored, strict, budget)
    with new_run(out, "explain") as writer, progress.task("explain", 5) as task:
        found = explain(data, on_step=task.advance)
        candidates = candidate_rows(found)
        summary: dict[str, Any] = {
            "command": "explain",
            "title": f"{run.name}: what its simulator lacks",
            "headline": headline(found),
            "answer": found.answer,
            "best": found.effect,
            "none_of_these": found.answer == "none of these",
            "threshold": found.search.threshold,
            "candidates": candidates,
            "misfit": None if found.best is None else found.best.as_dict(),
            "misfit_as_it_is": None if found.bare is None else found.bare.as_dict(),
            "log_evidence": float(found.search.bare.log_evidence),
            "added": None,
            "warnings": [f"no fit with {name}" for name in found.search.failed],
            "tables": [table(found, candidates)],
        }
        line = command("sim2gp", "explain", run, "--add" * add, "--out", out)
        summary |= provenance(line, started)
        best = found.search.best
        if add and file is not None:
            if found.effect is None or best is None:
                note = f"nothing was added to {file}: {found.answer}"
                summary["warnings"].append(note)
            else:
                note = f"added by sim2gp explain: {best.gain:.0f} nats of evidence"
                amend(file, best.scored.candidate, note)
                summary["added"] = str(file)
        from sim2gp.reports import write_report

        gains = np.asarray([s.gain for s in found.search.scored])
        names = np.asarray([s.candidate.name for s in found.search.scored])
        arrays = {"explain/gain": gains, "explain/name": names}
        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        writer.write_text("report.html", write_report(summary, arrays))
    return summary


def _data(
    run: Path, stored: Run, strict: bool = False, budget: Budget | None = None
) -> AbstractData:
    """The rows of a run, with their likelihood."""
    if (run / PROJECT).exists():
        seed = int(stored.summary.get("seed", 0))
        project = dataclasses.replace(_project(run, stored), budget=budget or Budget())
        return window_data(project, seed, strict=strict)
    if "animation/state" in stored.arrays and "machine" in stored.summary:
        return _flown(stored)
    raise InputError(
        "E130",
        "nothing to explain",
        where=str(run),
        got=str(stored.summary.get("command", "a run without data")),
        expected="the folder of sim2gp identify or sim2gp demo",
        fix="run one of them first",
    )


def window_data(project: Project, seed: int = 0, *, strict: bool = False) -> WindowData:
    """A project's logs as windows; those of one second may share an error."""
    logs = project.load_logs(strict=strict, alike=True)
    windows, log = cut_logs(project, logs)
    span = max(project.spec.likelihood.window, 1e-9)
    first = np.concatenate([[0], np.flatnonzero(np.diff(log)) + 1])
    within = np.arange(len(log)) - first[np.cumsum(np.diff(log, prepend=log[0]) != 0)]
    second = within // max(1, round(SHARED_SECOND / span))
    _, cluster = np.unique(np.stack([log, second]), axis=1, return_inverse=True)

    def cut(system: Any) -> Any:
        if system is project.system:
            return windows
        return cut_logs(dataclasses.replace(project, system=system), logs)[0]

    robust = project.spec.likelihood.robust
    return WindowData(project.system, cut, cluster.ravel(), robust=robust, seed=seed)


def _flown(stored: Run) -> OneStepData:
    """A demo's episodes; each lacks its last state."""
    summary, x = stored.summary, stored.arrays
    count, dt = int(summary["episodes"]), float(summary["animation"]["dt"])
    states = np.split(np.asarray(x["animation/state"], float), count)
    inputs = np.split(np.asarray(x["animation/action"], float), count)
    episodes = [(S, A[:-1]) for S, A in zip(states, inputs, strict=True)]
    make, _ = MACHINES[summary["machine"]]
    return OneStepData(make(), episodes, dt=dt)


def _project(run: Path, stored: Run) -> Project:
    """The run's own copy of the project, its logs where the file stood."""
    return dataclasses.replace(project_of(run, stored), path=stood(run, stored.summary))


def _project_file(run: Path, stored: Run, add: bool) -> Path | None:
    """The file to add to, unchanged since the run (E130, E160 if there is none)."""
    if not add:
        return None
    if not (run / PROJECT).exists():
        raise InputError(
            "E160",
            "--add without a project file",
            where=str(run),
            got=str(stored.summary.get("command")),
            expected="the folder of sim2gp identify",
            fix="leave --add out",
        )
    place = stood(run, stored.summary)
    if load_project(place).source.text != load_project(run / PROJECT).source.text:
        raise InputError(
            "E160",
            "project file changed since the run",
            where=str(place),
            got="another text than the run's copy",
            expected="the file that was identified",
            fix="run sim2gp identify again",
        )
    return place
