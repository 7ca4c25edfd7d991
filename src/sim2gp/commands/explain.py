"""Explain: what physics does the simulator of a finished run lack?

The run of an identification brings its project file and logs, that of a demo its own
transitions. Every effect of the library is scored, the best few are fitted, and the
answer is one of three: nothing, an effect, or none of these.
"""

import dataclasses
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.commands.demo import Demonstration
from sim2gp.commands.identification import Identification, project_of
from sim2gp.commands.recordings import Recordings
from sim2gp.commands.result import PROJECT, AbstractResult
from sim2gp.data.logs import Budget, Log
from sim2gp.errors import InputError, error
from sim2gp.identification.missing_physics.curves import force_arrays
from sim2gp.identification.missing_physics.data import (
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.explain import (
    find_missing_physics as search_missing,
)
from sim2gp.identification.missing_physics.score import ScoredCandidate
from sim2gp.identification.missing_physics.search import REFITS, FittedCandidate, refit
from sim2gp.identification.missing_physics.shapes import addition_of
from sim2gp.identification.missing_physics.words import (
    candidate_rows,
    candidate_table,
    force_rows,
    force_table,
    forces_text,
    missing_physics_headline,
)
from sim2gp.identification.words import bound_warnings
from sim2gp.inference.estimate import Estimate
from sim2gp.planning.tasks import MACHINES
from sim2gp.project import Project, load_project
from sim2gp.project.amend import amend
from sim2gp.project.training_windows import cut_logs
from sim2gp.runs import Progress, load_run
from sim2gp.runs.executors import AbstractExecutor, Workers, executor_of
from sim2gp.runs.provenance import provenance
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.registry import Candidate
from sim2gp.systems.effects.registry import candidates as registered
from sim2gp.types import in_float64

SHARED_SECOND = 1.0  # s of windows whose errors may be correlated


@dataclass(frozen=True, repr=False)
class MissingPhysics(AbstractResult):
    """What a simulator lacks: nothing, an effect of the library, or none of these."""

    winner: FittedCandidate | None = field(default=None)
    curves: tuple[Candidate, ...] = field(default=())

    @property
    def answer(self) -> str:
        """ "nothing missing", "missing" or "none of these"."""
        return str(self.summary["answer"])

    @property
    def best(self) -> str | None:
        """The missing effect, where the answer names one."""
        found = self.summary["best"]
        return None if found is None else str(found)

    @property
    def candidates(self) -> list[dict[str, Any]]:
        """Every effect that was scored, with its evidence gain and its size."""
        return list(self.summary["candidates"])

    def add_to(self, file: Path) -> "MissingPhysics":
        """Write the winner into a project file; the summary names the file.

        Where no effect is the answer, the forces that were found are written: those
        with a name as effects, the others as tables. The file is left alone where there
        are none.
        """
        notes = list(self.summary["warnings"])
        if self.winner is None and self.curves:
            for curve in self.curves:
                amend(file, curve, "added by sim2gp explain: a force that was found")
            return self.with_entries(added=str(file))
        if self.winner is None:
            notes.append(f"nothing was added to {file}: {self.answer}")
            return self.with_entries(warnings=notes)
        note = f"added by sim2gp explain: {self.winner.gain:.0f} nats of evidence"
        amend(file, self.winner.scored.candidate, note)
        return self.with_entries(added=str(file))


def explain(
    run: Identification | Demonstration,
    *,
    workers: Workers = 1,
    progress: Progress | None = None,
) -> MissingPhysics:
    """Search what the run's machine lacks.

    Every effect of the library is scored, the best few are fitted. With ``workers`` > 1
    the fits run in that many processes, or in those of an executor, if the project file
    has not changed since the run, else in this one. Raises `InputError` E130 for a run
    of another command, and what reading the run's logs raises.
    """
    started = time.perf_counter()
    logs = run.training_logs(alike=True) if isinstance(run, Identification) else ()
    data, fits, project = _data(run, logs), None, run.project
    executor = executor_of(workers)
    apart = executor.count > 1 and logs
    if apart and project is not None and project.can_be_loaded:
        fits = partial(_fits_in_processes, Recordings(project, logs), executor)
    with (progress or Progress()).task("explain", 3 + REFITS) as task:
        found = search_missing(data, fits=fits, on_step=task.advance)
    candidates, forces = candidate_rows(found), force_rows(found, data.system)
    none, failure = found.answer == "none of these", found.forces.failure
    gains = np.asarray([s.gain for s in found.search.scored])
    scored = np.asarray([s.candidate.name for s in found.search.scored])
    summary: dict[str, Any] = {
        "command": "explain",
        "title": f"{run.name}: what its simulator lacks",
        "headline": missing_physics_headline(found) + forces_text(forces) * none,
        "answer": found.answer,
        "best": found.effect,
        "none_of_these": none,
        "forces": forces,
        "threshold": found.search.threshold,
        "candidates": candidates,
        "misfit": None if found.best is None else found.best.as_dict(),
        "misfit_as_it_is": None if found.bare is None else found.bare.as_dict(),
        "log_evidence": float(found.search.bare.log_evidence),
        "added": None,
        "warnings": [
            *bound_warnings(run.summary.get("parameters") or {}).values(),
            *(f"no fit with {name}" for name in found.search.failed),
            *([f"no forces are drawn: {failure}"] if failure else []),
        ],
        "tables": [*force_table(forces), candidate_table(found, candidates)],
    }
    names = found.names(data.system)
    curves = [addition_of(c, names[c.name]) for c in found.drawn if c.name in names]
    return MissingPhysics(
        summary | provenance(started),
        {"explain/gain": gains, "explain/name": scored} | force_arrays(found.drawn),
        winner=found.search.best if found.effect else None,
        curves=tuple(curves),
    )


def _data(run: Identification | Demonstration, logs: Sequence[Log]) -> AbstractData:
    """The rows of a run, with their likelihood."""
    if isinstance(run, Identification):
        assert run.project is not None
        return window_data(run.project, logs, int(run.summary.get("seed", 0)))
    if isinstance(run, Demonstration):
        return _flown(run)
    raise _nothing_to_explain(getattr(run, "path", run), getattr(run, "summary", {}))


class RefitJob(NamedTuple):
    """One candidate's fit, as another process needs it; arrays are NumPy's."""

    recordings: Recordings
    seed: int
    name: str
    starts: np.ndarray
    bare: Estimate


def _fits_in_processes(
    recordings: Recordings,
    executor: AbstractExecutor,
    data: AbstractData,
    bare: Estimate,
    ranked: Sequence[ScoredCandidate],
) -> Iterator[tuple[str, FittedCandidate | None]]:
    """The fits of the best candidates, as processes are free."""
    assert isinstance(data, WindowData)
    asked = {one.candidate.name: one for one in ranked}
    sent = jax.tree.map(np.asarray, bare)  # whose numbers keep their 64 bits
    jobs = [
        RefitJob(recordings, data.seed, name, one.starts, sent)
        for name, one in asked.items()
    ]
    for job, fit in executor.spread(_refit_of, [[job] for job in jobs]):
        if fit is None:
            yield job.name, None
            continue
        fitted, *numbers = fit
        back = jax.tree.map(jnp.asarray, fitted)
        yield job.name, FittedCandidate(asked[job.name], back, *numbers)


@in_float64
def _refit_of(job: RefitJob) -> tuple[Estimate, float, float, float, float] | None:
    """A candidate's fit in its own process: a `FittedCandidate` without ``scored``."""
    data = window_data(job.recordings.project, job.recordings.logs, job.seed)
    known = {c.name: c for c in registered(data.system, windows=True)}
    candidate = known[job.name]
    system = free_parts(data.system, [candidate.effect])
    scored = ScoredCandidate(
        candidate, system, 0.0, 1.0, (), job.starts
    )  # scores are unused
    found = refit(data, jax.tree.map(jnp.asarray, job.bare), scored)
    if found is None:
        return None
    fitted = jax.tree.map(np.asarray, found.fitted)
    return fitted, found.gain, found.value, found.sd, found.inflation


def window_data(project: Project, logs: Sequence[Log], seed: int = 0) -> WindowData:
    """A project's logs as windows; those of one second may share an error."""
    windows, log = cut_logs(project, logs)
    span = max(project.window, 1e-9)
    first = np.concatenate([[0], np.flatnonzero(np.diff(log)) + 1])
    within = np.arange(len(log)) - first[np.cumsum(np.diff(log, prepend=log[0]) != 0)]
    second = within // max(1, round(SHARED_SECOND / span))
    _, cluster = np.unique(np.stack([log, second]), axis=1, return_inverse=True)

    def cut(system: Any) -> Any:
        if system is project.system:
            return windows
        return cut_logs(dataclasses.replace(project, system=system), logs)[0]

    robust = project.spec.likelihood.robust
    of = cluster.ravel(), log
    return WindowData(project.system, cut, *of, robust=robust, seed=seed)


def _flown(run: Demonstration) -> OneStepData:
    """A demo's episodes; each lacks its last state."""
    summary, x = run.summary, run.arrays
    count, dt = int(summary["episodes"]), float(summary["animation"]["dt"])
    states = np.split(np.asarray(x["animation/state"], float), count)
    inputs = np.split(np.asarray(x["animation/action"], float), count)
    episodes = [(S, A[:-1]) for S, A in zip(states, inputs, strict=True)]
    make, _ = MACHINES[summary["machine"]]
    return OneStepData(make(), episodes, dt=dt)


def load_explainable(
    folder: Path, budget: Budget | None = None, *, strict: bool = False
) -> Identification | Demonstration:
    """The run of an identification, its logs read, or of a demo (E130)."""
    stored = load_run(folder)
    if (folder / PROJECT).exists():
        project = project_of(folder, stored)
        project = dataclasses.replace(project, budget=budget or Budget())
        logs = project.load_logs(strict=strict, alike=True)
        return Identification(
            stored.summary, stored.arrays, {}, project, folder, logs=logs
        )
    if "animation/state" in stored.arrays and "machine" in stored.summary:
        return Demonstration(stored.summary, stored.arrays, {}, None, folder)
    raise _nothing_to_explain(folder, stored.summary)


def _nothing_to_explain(where: object, summary: Mapping[str, Any]) -> InputError:
    got = str(summary.get("command", "a run without data"))
    return error("nothing_to_explain", where=str(where), got=got)


def project_file(run: AbstractResult) -> Path:
    """The file to add to, unchanged since the run (E160 if there is none)."""
    where = str(run.path or run.name)
    if run.project is None:
        got = str(run.summary.get("command"))
        raise error("no_project_to_add_to", where=where, got=got)
    place = run.project.path
    if load_project(place).source.text != run.project.source.text:
        got = "another text than the run's copy"
        raise error("project_changed_since_run", where=str(place), got=got)
    return place
