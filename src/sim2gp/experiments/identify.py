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

from sim2gp.data.clock import clock_lines, clock_warnings
from sim2gp.data.grid import CURVE, Grid, evaluation_windows
from sim2gp.data.logs import Log, note_lines
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import WindowsLikelihood, information_at
from sim2gp.experiments.configurations import told
from sim2gp.experiments.first_answer import FirstAnswer
from sim2gp.experiments.identified import PROJECT, physical
from sim2gp.experiments.longer import advice
from sim2gp.experiments.motion import film
from sim2gp.experiments.prediction import (
    Picture,
    channels,
    cut_places,
    drawn,
    predicted,
    recordings,
    rows_for,
    thinned,
    trace_arrays,
    units,
)
from sim2gp.experiments.record import command, provenance
from sim2gp.experiments.told_intervals import lacking_table, told_intervals
from sim2gp.experiments.unseen import Unseen, unseen
from sim2gp.identification import diagnose
from sim2gp.identification.exact_posterior.importance import check_windows
from sim2gp.identification.exact_posterior.nuts import sample_windows, sampler
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecast import Band, compile_forecast, fit_band
from sim2gp.identification.intervals.discrepancy import (
    compile_corrected,
    corrected_windows,
)
from sim2gp.identification.intervals.scatter import Corrected
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.project import Project
from sim2gp.runs import Progress, new_run
from sim2gp.runs.store import Writer
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.host import simulator_of

#: Forecasts to draw: of whom, and what and where they are.
Drawn = tuple[Gaussian, Picture, Grid]
_SHORTEST = 4  # windows: a film of fewer held-out ones is not worth watching


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
        sampler()  # before the work
    with new_run(out, "identify") as writer, progress.task("identify", 4) as task:
        windows, places = cut_places(project, logs)
        of = np.asarray([k for k, _ in places])
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
        band, own = _own_forecasts(project, fitted.posterior, grid, logs)
        known = fitted.with_measurements(project.system.parameters)
        likelihood = WindowsLikelihood(project.system, windows)
        honest = corrected_windows(likelihood, known, of)
        summary = _summarise(project, logs, likelihood, known, honest, band, seed)
        arrays = _stored(project.system.parameters, known, honest.posterior, band, seed)
        other = (
            unseen(project, logs, windows, places, grid, known) if held_out else None
        )
        said, drawings = _drawings(project, logs, own, other)
        summary, arrays = summary | said, arrays | drawings
        task.advance("forecasts")
        asked = {"quick": not held_out, "check": check, "nuts": nuts, "longer": longer}
        line = _command(project, out, seed, asked)
        summary |= _held_against(likelihood, fitted, seed, check=check, nuts=nuts)
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
    """Begin to compile what follows the fit."""
    compile_forecast(system, grid)
    compile_corrected(system, windows)


def _write(
    writer: Writer,
    project: Project,
    summary: dict[str, Any],
    arrays: dict[str, np.ndarray],
) -> None:
    from sim2gp.report import write_report

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


def _held_against(
    likelihood: WindowsLikelihood,
    fitted: Estimate,
    seed: int,
    *,
    check: bool,
    nuts: bool,
) -> dict[str, Any]:
    """What the exact posterior says of Laplace's, where it is asked."""
    names, key = likelihood.system.parameters.names, jax.random.key(seed)
    out: dict[str, Any] = {}
    if check:
        checked = check_windows(likelihood, fitted, key=jax.random.fold_in(key, 2))
        out["check"] = checked.as_dict(names)
    if nuts:
        sampled = sample_windows(likelihood, fitted, key=jax.random.fold_in(key, 3))
        out["nuts"] = sampled.as_dict(names)
    return out


def _drawings(
    project: Project,
    logs: Sequence[Log],
    own: Drawn,
    other: Unseen | None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Forecasts of the fitted logs and of held-out data, and a film of the latter."""
    posterior, picture, shown = own
    names = channels(project.system, shown.windows)
    arrays, data = trace_arrays(picture, shown, logs, names), "fitted"
    summary: dict[str, Any] = {}
    if other is not None:
        summary["held_out"] = other.summary
        arrays |= other.arrays
        if other.fold is not None and len(other.picture["which"][0]) >= _SHORTEST:
            picture, data = other.picture, "held-out"
            posterior, shown = other.fold.posterior, other.fold.tested
    title = f"Forecasts of {data} data over what was recorded"
    about, moves = film(project.system, posterior, picture, shown, logs, title)
    return summary | ({"animation": about} if about else {}), arrays | moves


def _own_forecasts(
    project: Project, posterior: Gaussian, grid: Grid, logs: Sequence[Log]
) -> tuple[Band, Drawn]:
    """Of the logs that were fitted: the band made of them, and what is drawn.

    Windows that overlap say little more of the band, and a simulator on the host takes
    as long for them as for the fit.
    """
    if simulator_of(project.system) is not None:
        grid = thinned(grid)
    found = predicted(project.system, posterior, grid, CURVE[0])
    rows = rows_for(CURVE[0])[1:]
    band = fit_band(found.at(rows), grid, len(set(recordings(logs))))
    return band, (posterior, drawn(found, band, grid), grid)


def _stored(
    table: Parameters, fitted: Estimate, honest: Gaussian, band: Band, seed: int
) -> dict[str, np.ndarray]:
    key = jax.random.fold_in(jax.random.key(seed), 1)
    return {
        "belief/mean": np.asarray(fitted.posterior.mean),
        "belief/theta": np.asarray(physical(table, fitted.posterior.mean)),
        "belief/scale": np.asarray(fitted.posterior.scale),
        "belief/prior_mean": np.asarray(fitted.prior.mean),
        "belief/prior_scale": np.asarray(fitted.prior.scale),
        "belief/information": np.asarray(fitted.information),
        "belief/noise": np.asarray(fitted.noise.sd),
        "belief/weights": np.asarray(fitted.noise.weights),
        "intervals/mean": np.asarray(honest.mean),
        "intervals/theta": np.asarray(physical(table, honest.mean)),
        "intervals/scale": np.asarray(honest.scale),
        "band/start_sd": band.start_sd,
        "band/input_sd": band.input_sd,
        "band/resolution": band.resolution,
        "band/rows": band.rows,
        "band/shape": band.shape,
        "band/inflation": np.asarray(band.inflation),
        **diagnose.arrays(table, fitted.prior, honest, key=key),
    }


def _summarise(
    project: Project,
    logs: Sequence[Log],
    likelihood: WindowsLikelihood,
    fitted: Estimate,
    honest: Corrected,
    band: Band,
    seed: int,
) -> dict[str, Any]:
    system, windows = project.system, likelihood.windows
    names = channels(system, windows)
    found = diagnose.summary(
        system.parameters,
        fitted.prior,
        fitted.posterior,
        fitted.information,
        fisher_at=information_at(likelihood, fitted),
        corrected=honest.posterior,
    )
    noise = dict(zip(names, np.asarray(fitted.noise.sd).tolist(), strict=True))
    rows = sum(len(log) for log in logs)
    actions = [channel.name for channel in system.actions]
    about = told_intervals(system, honest, found["parameters"], len(windows))
    listed = told(system, logs, found["parameters"])
    listed["tables"] = [*lacking_table(about), *listed.get("tables", ())]
    return {
        "command": "identify",
        "title": f"{project.name}: what {_count(logs)}",
        "headline": headline(found["parameters"]),
        "seed": seed,
        "converged": True,
        "convergence": fitted.convergence.as_dict(),
        "noise": noise,
        "intervals": about,
        "misfit": {
            **misfit_of_windows(likelihood, fitted).as_dict(),
            "noise": _noise_words(names, noise, windows, units(system)),
        },
        "log_evidence": float(fitted.log_evidence),
        "n_rows": rows,
        "period": float(np.median(np.concatenate([np.diff(x.time) for x in logs]))),
        "n_logs": len(set(recordings(logs))),
        "n_transitions": rows - len(logs),
        "n_windows": len(windows),
        "units": units(system),
        "band": {
            "input_sd": dict(zip(actions, band.input_sd.tolist(), strict=True)),
            "inflation": band.inflation,
        },
        "warnings": [*note_lines(logs), *clock_warnings(logs, system)],
        "trace_note": "Forecasts of half a second from causal starts, of the logs that "
        "were fitted; they know the recorded inputs and nothing else of the future.",
        **listed,
        **found,
    }


def headline(parameters: dict[str, dict[str, Any]]) -> str:
    """How many constants the logs determine, and which they do not."""
    sure = [n for n, entry in parameters.items() if entry["verdict"] == "identified"]
    rest = [n for n in parameters if n not in sure]
    text = f"{len(sure)} of {len(parameters)} constants are identified"
    if sure:
        text += f" ({', '.join(sure)})"
    return (
        f"{text}; not by these logs alone: {', '.join(rest)}." if rest else f"{text}."
    )


def _count(logs: Sequence[Log]) -> str:
    count = len(set(recordings(logs)))
    return "one log determines" if count == 1 else f"{count} logs determine"


def _noise_words(
    names: Sequence[str],
    noise: dict[str, float],
    windows: Windows,
    unit: dict[str, str],
) -> list[str]:
    """What the window noise holds beside the sensor's own."""
    out = []
    for name, floor in zip(names, np.asarray(windows.floor), strict=True):
        times = noise[name] / float(floor)
        out.append(
            f"The noise of {name}, {noise[name]:.2g} {unit[name]}, is {times:.0f} "
            "times the rounding of its sensor: the rest is error of the start and of "
            "the model, which is not independent from sample to sample: the plain "
            "posterior, which takes it for that, is narrower than it should be."
            if times > 3.0
            else f"The noise of {name}, {noise[name]:.2g} {unit[name]}, is that of "
            "its sensor's rounding: these windows show no other error."
        )
    return out
