"""Identify: the posterior of a machine's constants from its logs.

The run keeps what a later command needs to predict with it: the project file, the
posterior over virtual values, and what the band of its forecasts is made of.
"""

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from sim2gp.commands.first_answer import FirstAnswer
from sim2gp.data.clock import clock_lines
from sim2gp.data.grid import CURVE, Grid, evaluation_windows
from sim2gp.data.logs import Log, note_lines
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.project import Project
from sim2gp.project.training_windows import cut_places
from sim2gp.runs import Progress, new_run
from sim2gp.runs.provenance import command, provenance
from sim2gp.runs.store import Writer
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import simulator_of


def run(
    project: Project,
    logs: Sequence[Log],
    *,
    out: Path,
    seed: int,
    progress: Progress,
    check: bool = False,
    nuts: bool = False,
    longer: bool = False,
    held_out: bool = True,
) -> dict[str, Any]:
    """Fit the logs of a project file and write the run; returns its summary.

    ``check`` holds Laplace's posterior against the exact one by importance sampling,
    ``nuts`` against draws of it (E135 without the extra ``mcmc``); ``longer`` asks
    what longer windows would tell; ``held_out`` fits once more without some of the
    data, and forecasts those.
    """
    started = time.perf_counter()
    if nuts:
        from sim2gp.identification.exact_posterior.nuts import sampler

        sampler()  # before the work
    with new_run(out, "identify") as writer, progress.task("identify", 4) as task:
        windows, places = cut_places(project, logs)
        task.advance(f"{len(windows)} windows")
        key, robust = jax.random.key(seed), project.spec.likelihood.robust
        grid = evaluation_windows(logs, project.system, longest=CURVE[-1])
        _compile(project.system, grid, windows)
        progress.say(_sizes(project, logs, windows))
        first = FirstAnswer(project, logs, out, task)
        with first.of_failures():
            fitted = fit_windows(
                project.system, windows, key=key, robust=robust, report=first
            )
        task.advance("posterior")
        # Late: a first answer waits for nothing that comes after it.
        from sim2gp.commands import identify_results as results
        from sim2gp.commands.longer import advice

        cuts = windows, places
        found = results.found(project, logs, cuts, grid, fitted, seed, held_out)
        summary, arrays, honest = found
        task.advance("forecasts")
        asked = {"quick": not held_out, "check": check, "nuts": nuts, "longer": longer}
        line = _command(project, out, seed, asked)
        likelihood = WindowsLikelihood(project.system, windows)
        summary |= results.held_against(likelihood, fitted, seed, check, nuts)
        if longer:
            progress.say("fitting longer windows")
        alarm = summary["misfit"]["alarm"]
        summary |= advice(project, logs, honest, alarm=alarm, key=key, asked=longer)
        summary |= provenance(line, started) | {"project": _place(project, out)}
        _write(writer, project, summary, arrays)
        task.advance("report")
    first.replaced()
    return summary


def _sizes(project: Project, logs: Sequence[Log], windows: Windows) -> str:
    """What a fit is about, and in which steps it simulates, before it begins."""
    parameters, columns = len(project.system.parameters), len(windows.outputs)
    length = project.spec.likelihood.window
    sizes = (
        f"{parameters} parameters, {len(windows)} windows of {length:g} s, "
        f"{columns} measured columns"
    )
    still = [line for line in note_lines(logs) if line.startswith("W117")]
    return "\n".join([sizes, *clock_lines(logs, project.system), *still])


def _compile(system: AbstractSystem, grid: Grid, windows: Windows) -> None:
    """Begin to compile what follows the fit, where JAX moves the machine."""
    if simulator_of(system) is not None:
        return
    from sim2gp.identification.forecasts.forecast import compile_forecast
    from sim2gp.identification.intervals.discrepancy import compile_corrected

    compile_forecast(system, grid)
    compile_corrected(system, windows)


def _write(
    writer: Writer,
    project: Project,
    summary: dict[str, Any],
    arrays: dict[str, np.ndarray],
) -> None:
    from sim2gp.commands.identification import PROJECT
    from sim2gp.reports import write_report

    writer.write_summary(summary)
    writer.write_arrays("arrays.npz", arrays)
    writer.write_text(PROJECT, project.source.text)
    writer.write_text("report.html", write_report(summary, arrays))


def _command(project: Project, out: Path, seed: int, asked: dict[str, bool]) -> str:
    """The line that makes such a run."""
    flags = [f"--{name}" * yes for name, yes in asked.items()]
    options = ["--out", out, "--seed", seed, *flags]
    return command("sim2gp", "identify", project.path, *options)


def _place(project: Project, out: Path) -> dict[str, str]:
    """Where the project file stands, seen from the run."""
    folder = Path(os.path.abspath(project.path)).parent
    place = os.path.relpath(folder, os.path.abspath(out))
    return {"file": project.path.name, "folder": place}
