"""Identify: the posterior of a machine's parameters from its logs.

The result keeps what a later command needs to predict with it: the project file, the
posterior over virtual values, and what the band of its forecasts is made of.
"""

import time
from collections.abc import Callable, Sequence

import jax

from sim2gp.commands.first_answer import FirstAnswer
from sim2gp.commands.identification import Identification
from sim2gp.data.clock import clock_lines
from sim2gp.data.grid import CURVE, Grid, evaluation_windows
from sim2gp.data.logs import Log, note_lines
from sim2gp.identification.fit import fit_windows
from sim2gp.project import Project
from sim2gp.project.in_memory import Logs, project_and_logs
from sim2gp.project.training_windows import TrainingWindows, cut_for_fit
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import simulator_of


def identify(
    machine: Project | AbstractSystem,
    logs: Logs | None = None,
    *,
    seed: int = 0,
    check: bool = False,
    nuts: bool = False,
    held_out: bool = True,
    first: Callable[[Identification], str] | None = None,
    progress: Progress | None = None,
) -> Identification:
    """Fit the parameters of a machine to logs: a project's own, if None are given.

    ``seed`` draws the starts of the fit. ``check`` holds Laplace's posterior against
    the exact one by importance sampling, ``nuts`` against draws of it (E135 without the
    extra ``mcmc``); ``held_out`` fits once more without some of the data, and forecasts
    those. Where a fit takes its time, ``first`` gets a first answer, and what a failed
    one knows; it returns what to say. Raises `InputError` for logs that do not fit the
    machine, `NotConverged` E201, `DeadParameters` E146.
    """
    started = time.perf_counter()
    progress = progress or Progress()
    if nuts:
        from sim2gp.identification.exact_posterior.nuts import sampler

        sampler()  # before the work
    project, logs = project_and_logs(machine, logs)
    with progress.task("identify", 3, alike=False) as task:
        cut = cut_for_fit(project, logs, some=project.chooses_window)
        task.advance(f"{len(cut.windows)} windows")
        key, robust = jax.random.key(seed), project.spec.likelihood.robust
        grid = evaluation_windows(logs, project.system, longest=CURVE[-1])
        _compile(project, grid, cut)
        progress.say(_sizes(project, logs, cut))
        watch = FirstAnswer(project, logs, task, first)
        with watch.of_failures():
            fitted = fit_windows(
                project.system, cut.windows, key=key, robust=robust, report=watch
            )
        # Late: a first answer waits for nothing that comes after it.
        from sim2gp.commands import identify_results as results
        from sim2gp.commands.window_length import WindowFit, choose_window, fit_all

        short = WindowFit(project, cut, fitted)
        chosen = choose_window(short, logs, key=key, task=task)
        chosen = fit_all(chosen, logs, key=key, task=task)
        task.advance("posterior")
        summary, arrays = results.identification_results(
            chosen, logs, grid, seed, held_out
        )
        task.advance("forecasts")
        summary |= results.held_against(chosen.fit, seed, check, nuts)
    summary |= provenance(started)
    project = chosen.fit.project
    return Identification(summary, arrays, {}, project, logs=tuple(logs))


def _sizes(project: Project, logs: Sequence[Log], cut: TrainingWindows) -> str:
    """What a fit is about, and in which steps it simulates, before it begins."""
    parameters, columns = len(project.system.parameters), len(cut.windows.outputs)
    some = "" if cut.is_whole() else f"{len(cut.windows)} of "
    sizes = (
        f"{parameters} parameters, {some}{cut.total} windows of {project.window:g} s, "
        f"{columns} measured columns"
    )
    still = [line for line in note_lines(logs) if line.startswith("W117")]
    return "\n".join([sizes, *clock_lines(logs, project.system), *still])


def _compile(project: Project, grid: Grid, cut: TrainingWindows) -> None:
    """Begin to compile what follows the fit, where JAX moves the machine.

    What asks for windows only if they stay as long as they are.
    """
    system = project.system
    if simulator_of(system) is not None:
        return
    from sim2gp.identification.forecasts.forecast import compile_forecast
    from sim2gp.identification.intervals.discrepancy import compile_corrected

    compile_forecast(system, grid)
    if not project.chooses_window:
        compile_corrected(system, cut.windows)
