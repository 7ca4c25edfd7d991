"""Identify many machines of one kind: each from its own logs and from the others.

Machines are cells. Each is fitted alone, then all are joined (`identification.fleet`).
Where a machine's logs leave something open, its own fit may have ended far from what
the others say, and a fit is linear about its end. So each is fitted again with what is
known of the kind as its prior, and all are joined again, until that moves no machine.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp.commands.fleet_summary import fleet_summary
from sim2gp.commands.folds import recording_of_windows
from sim2gp.commands.recordings import Recordings
from sim2gp.commands.result import AbstractResult
from sim2gp.commands.window_length import (
    fit_chosen_windows,
    keeps_samples,
    window_entry,
)
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import DeadParameters, NotConverged, NotFinite, error
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.fleet import Fleet, fit_fleet
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero, forces_of
from sim2gp.identification.missing_physics.reach import box_of
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.prior import ParameterPrior
from sim2gp.project import Project
from sim2gp.project.project import SHORT
from sim2gp.project.training_windows import cut_logs
from sim2gp.runs.cell_work import AbstractCell, Values, compute_cells
from sim2gp.runs.executors import Workers, executor_of
from sim2gp.runs.plain import exact, from_exact
from sim2gp.runs.progress import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.types import AnyArray, in_float64

SETTLED = 0.1  # sd: rounds end when none moves a machine's parameter further
ROUNDS = 7  # at most


@dataclass(frozen=True, repr=False)
class IdentifiedFleet(AbstractResult):
    """The posterior of each machine, and of the kind; over virtual values."""

    @cached_property
    def machines(self) -> dict[str, Gaussian]:
        """Each machine by its name, from its own logs and from those of the others."""
        x = self.arrays
        pairs = zip(x["fleet/means"], x["fleet/scales"], strict=True)
        each = (_gaussian(*pair) for pair in pairs)
        return dict(zip(self.summary["machines"], each, strict=True))

    @cached_property
    def kind(self) -> Gaussian:
        """What the machines have in common: the middle of the kind."""
        return _gaussian(self.arrays["fleet/kind"], self.arrays["fleet/kind_scale"])

    @cached_property
    def another(self) -> Gaussian:
        """A machine of the kind without logs of its own: a prior to begin with."""
        return _gaussian(
            self.arrays["fleet/another"], self.arrays["fleet/another_scale"]
        )


def identify_fleet(
    project: Project,
    machines: Mapping[str, Sequence[Log]],
    *,
    seed: int = 0,
    workers: Workers | None = None,
    progress: Progress | None = None,
) -> IdentifiedFleet:
    """Fit machines of one kind, whose logs are given by their names.

    ``seed`` draws the starts of the fits and the spreads. Machines are fitted in so
    many processes, or where an executor computes (``workers``). Raises `InputError`
    E160 for a single machine, and what a fit of one raises.
    """
    started = time.perf_counter()
    if len(machines) < 2:
        got = ", ".join(machines) or "none"
        raise error("one_machine", where=project.source.where("logs"), got=got)
    found = fit_machines(
        project, machines, seed=seed, workers=workers, progress=progress
    )
    project = found.project
    window = window_entry(project, found.said)
    summary = fleet_summary(project, machines, found.fleet, found.moved, window)
    arrays = _arrays(found.fleet)
    summary |= {"seed": seed} | provenance(started)
    return IdentifiedFleet(summary, arrays, {}, project)


class FittedFleet(NamedTuple):
    """A fleet, each machine ``alone``, and by how much each further round moved it.

    ``project`` has windows as they were fitted, ``said`` says why; ``moved`` has the
    largest change of a machine's parameter, in its sd.
    """

    project: Project
    said: str
    fleet: Fleet
    alone: list[Gaussian]
    moved: list[float]


def fit_machines(
    project: Project,
    machines: Mapping[str, Sequence[Log]],
    *,
    seed: int = 0,
    workers: Workers | None = None,
    progress: Progress | None = None,
) -> FittedFleet:
    """Machines alone, joined, then each again with the kind as its prior and joined.

    The prior of a fit is divided out again: rounds move where fits are linearised. The
    machine with most samples chooses how long windows are, if the project does not say
    it; they are short if another machine cannot be fitted with such.
    """
    shown = progress or Progress()
    how: dict[str, Any] = {"seed": seed, "workers": workers, "progress": shown}
    if not project.chooses_window:
        said = f"Windows are {project.window:g} s long."
        return _fit_machines(project, machines, said, **how)
    chosen, said = _chosen(project, machines, seed, shown)
    try:
        return _fit_machines(chosen, machines, said, **how)
    except (NotConverged, NotFinite, DeadParameters) as error:
        if chosen.window == SHORT:
            raise
        why = f"with those of {chosen.window:g} s a machine cannot be fitted ({error})"
    said = f"Windows are {SHORT:g} s long: {why}."
    return _fit_machines(project.with_window(SHORT), machines, said, **how)


def _chosen(
    project: Project,
    machines: Mapping[str, Sequence[Log]],
    seed: int,
    progress: Progress,
) -> tuple[Project, str]:
    """The project with the length of windows that one machine chooses, and why."""
    most = max(machines, key=lambda name: sum(map(len, machines[name])))
    with progress.task("windows", 1, alike=False) as task:
        key = jax.random.key(seed)
        chosen = fit_chosen_windows(project, machines[most], key=key, task=task)
        task.advance("length")
    found = chosen.fit.project
    for name, logs in machines.items():
        if not keeps_samples(found, logs):
            why = f"logs of {name} are too short for those of {found.window:g} s"
            return project.with_window(SHORT), f"Windows are {SHORT:g} s long: {why}."
    return found, f"{chosen.why} {most}, which has most samples, chose the length."


def _fit_machines(
    project: Project,
    machines: Mapping[str, Sequence[Log]],
    said: str,
    seed: int,
    workers: Workers | None,
    progress: Progress,
) -> FittedFleet:
    """With windows of the project's length, about which something is ``said``."""
    cells = _cells(project, machines, seed)
    executor = executor_of((workers or 1) if project.can_be_loaded else 1)

    def joined(
        cells: Sequence[MachineCell], label: str
    ) -> tuple[Fleet, list[Gaussian]]:
        with progress.task(label, len(cells)) as task:
            found = compute_cells(cells, None, executor, task)
        each = [from_exact(found[cell]) for cell in cells]
        fits, given = (
            [_gaussian(x[name], x[f"{name}_scale"]) for x in each]
            for name in ("posterior", "prior")
        )
        return fit_fleet(_prior(project, fits), fits, given, seed=seed), fits

    fleet, alone = joined(cells, "machines")
    moved: list[float] = []
    for number in range(2, ROUNDS + 1):
        known = np.asarray(fleet.another.mean), np.asarray(fleet.another.scale)
        again = [replace(cell, prior=known) for cell in cells]
        before, (fleet, _) = fleet, joined(again, f"machines, round {number}")
        moved.append(_moved(before, fleet))
        if moved[-1] <= SETTLED:
            break
    return FittedFleet(project, said, fleet, alone, moved)


def _cells(
    project: Project, machines: Mapping[str, Sequence[Log]], seed: int
) -> "list[MachineCell]":
    """Machines have as many windows each: one compiled program fits them all."""
    logs = tuple(log for own in machines.values() for log in own)
    recordings, ends = (
        Recordings(project, logs),
        np.cumsum([*map(len, machines.values())]),
    )
    of = np.searchsorted(ends, _cut(recordings).log, side="right")
    most = int(np.bincount(of).max())
    return [
        MachineCell(recordings, name, tuple(range(end - len(own), end)), most, seed)
        for (name, own), end in zip(machines.items(), ends.tolist(), strict=True)
    ]


class _Cut(NamedTuple):
    """Windows of all machines, the log of each, and forces that machines may lack."""

    windows: Windows
    log: Int[np.ndarray, " W"]
    forces: tuple[AbstractUnknownFunction, ...]


def _cut(recordings: Recordings) -> _Cut:
    project, logs = recordings.project, recordings.logs

    def cut() -> _Cut:
        windows, of = cut_logs(project, logs)
        box = box_of(project.system, windows)
        return _Cut(windows, of, forces_of(project.system, box))

    return recordings.kept("cut", "machines", cut)


@dataclass(frozen=True, eq=False)
class MachineCell(AbstractCell):
    """The fit of one machine; ``prior`` replaces the table's: its mean and scale.

    ``logs`` are the machine's among the recordings, ``count`` the windows of its fit.
    """

    recordings: Recordings
    machine: str
    logs: tuple[int, ...]
    count: int
    seed: int
    prior: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def name(self) -> str:
        """By its first log."""
        return f"machine_{self.logs[0]}"

    @property
    def note(self) -> str:
        """Which machine."""
        return self.machine

    @property
    def arguments(self) -> Values:
        """The project and its logs, by their digest."""
        about = {"recordings": self.recordings.digest, "seed": self.seed}
        prior = None if self.prior is None else [x.tolist() for x in self.prior]
        return about | {"logs": list(self.logs), "count": self.count, "prior": prior}

    @in_float64
    def compute(self, needed: Values | None) -> Values:
        """The corrected posterior, and the prior that it began with."""
        del needed
        project, system = self.recordings.project, self.recordings.project.system
        windows, recording = self._windows()
        fitted = fit_windows(
            system,
            windows,
            key=jax.random.key(self.seed),
            prior=None if self.prior is None else _gaussian(*self.prior),
            robust=project.spec.likelihood.robust,
        ).with_measurements(system.parameters)
        likelihood, forces = (
            WindowsLikelihood(system, windows),
            _cut(self.recordings).forces,
        )
        start = at_zero(likelihood, fitted, recording, forces)
        known, about = corrected_windows(start).posterior, fitted.prior
        return exact(
            {
                "posterior": np.asarray(known.mean),
                "posterior_scale": np.asarray(known.scale),
                "prior": np.asarray(about.mean),
                "prior_scale": np.asarray(about.scale),
            }
        )

    def _windows(self) -> tuple[Windows, Int[np.ndarray, " count"]]:
        """The machine's, and masked ones, of which no recording is made."""
        windows, of, _ = _cut(self.recordings)
        mine = np.flatnonzero(np.isin(of, self.logs))
        at, own = np.resize(mine, self.count), np.arange(self.count) < len(mine)
        some = windows.some(at)
        mask = np.asarray(some.mask) & own[:, None, None]
        recording = recording_of_windows(self.recordings.logs, of)[at]
        return eqx.tree_at(lambda w: w.mask, some, mask), np.where(own, recording, -1)


@in_float64
def _prior(project: Project, fits: Sequence[Gaussian]) -> Gaussian:
    """The table's, with its measured sums: linear about the middle of the machines."""
    table = project.system.parameters
    about = ParameterPrior(table.prior(), table)
    middle = np.mean([np.asarray(fit.mean) for fit in fits], axis=0)
    return (
        about.linearised(jnp.asarray(middle)) if table.measurements else about.gaussian
    )


@in_float64
def _moved(before: Fleet, fleet: Fleet) -> float:
    """The most that joining again has moved a machine's parameter, in its sd."""
    pairs = zip(before.machines, fleet.machines, strict=True)
    return max(
        float(np.max(np.abs(np.asarray(b.mean - a.mean)) / np.asarray(b.sd())))
        for a, b in pairs
    )


def _arrays(fleet: Fleet) -> dict[str, np.ndarray]:
    return {
        "fleet/kind": np.asarray(fleet.kind.mean),
        "fleet/kind_scale": np.asarray(fleet.kind.scale),
        "fleet/another": np.asarray(fleet.another.mean),
        "fleet/another_scale": np.asarray(fleet.another.scale),
        "fleet/means": np.stack([np.asarray(g.mean) for g in fleet.machines]),
        "fleet/scales": np.stack([np.asarray(g.scale) for g in fleet.machines]),
        "fleet/spread": fleet.spread,
    }


@in_float64
def _gaussian(mean: AnyArray, scale: AnyArray) -> Gaussian:
    return Gaussian(jnp.asarray(mean), jnp.asarray(scale))
