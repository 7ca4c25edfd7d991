"""What identify says once the posterior is known: forecasts, intervals, words."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from sim2gp.commands.folds import recording_of_windows
from sim2gp.commands.identification import physical_mode
from sim2gp.commands.unseen import Unseen, forecast_unseen
from sim2gp.commands.window_length import WindowFit, WindowLength
from sim2gp.data.clock import clock_warnings
from sim2gp.data.cuts import Cuts
from sim2gp.data.grid import CURVE, Grid
from sim2gp.data.logs import Log, note_lines
from sim2gp.data.windows import Windows
from sim2gp.data.windows_likelihood import (
    AnyWindows,
    WindowsLikelihood,
    information_at,
    likelihood_of,
)
from sim2gp.identification import diagnose
from sim2gp.identification.configurations import configuration_entries
from sim2gp.identification.exact_posterior.importance import check_windows
from sim2gp.identification.exact_posterior.nuts import sample_windows
from sim2gp.identification.forecasts.forecast import Band, fit_band
from sim2gp.identification.forecasts.forecast_machine import (
    ForecastMachine,
    fit_forecast_machine,
    forces_sentence,
)
from sim2gp.identification.forecasts.prediction import (
    Picture,
    channel_units,
    channels,
    forecast_grid,
    forecast_traces,
    recording_names,
    scored_rows,
    thin_windows,
    trace_arrays,
)
from sim2gp.identification.intervals.discrepancy import (
    corrected_windows,
)
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.identification.intervals.words import (
    force_entries,
    interval_entry,
    missing_forces_table,
)
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.identification.missing_physics.curves import force_arrays
from sim2gp.identification.words import bound_warnings
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.project import Project
from sim2gp.reports.motion import film
from sim2gp.systems.host import simulator_of

#: Forecasts to draw: of which machine, and what and where they are.
Drawn = tuple[ForecastMachine, Picture, Grid]
_SHORTEST = 4  # windows: a film of fewer held-out ones is not worth watching


def identification_results(
    chosen: WindowLength,
    logs: Sequence[Log],
    grid: Grid,
    seed: int,
    held_out: bool,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The run's summary and arrays."""
    project, (windows, places, _), fitted = chosen.fit
    table, of = project.system.parameters, places[:, 0]
    known = fitted.with_measurements(table)
    likelihood = likelihood_of(project.system, windows)
    recording, robust = recording_of_windows(logs, of), project.spec.likelihood.robust
    machine, honest = _with_forces(likelihood, known, of, recording, robust)
    band, own = _own_forecasts(machine, grid, logs)
    summary = _identification_summary(
        chosen, logs, likelihood, known, honest, band, seed
    )
    arrays = _stored(table, known, honest.posterior, band, seed)
    arrays |= force_arrays(honest.found) | machine.arrays()
    summary |= machine.entries() | {"window": chosen.as_dict()}
    summary["trace_note"] += forces_sentence(machine.scales)
    other = (
        forecast_unseen(project, logs, windows, places, grid, known)
        if held_out
        else None
    )
    said, drawings = _drawings(project, logs, own, other)
    return summary | said, arrays | drawings


def _with_forces(
    likelihood: AnyWindows,
    known: Estimate,
    of: Int[np.ndarray, " W"],
    recording: Int[np.ndarray, " W"],
    robust: bool,
) -> tuple[ForecastMachine, CorrectedFit]:
    """What forecasts, and the corrected posterior: both ask the same linearisation."""
    start = at_zero(likelihood, known, of)
    machine = fit_forecast_machine(start, recording, robust=robust)
    return machine, corrected_windows(start)


def _own_forecasts(
    machine: ForecastMachine, grid: Grid, logs: Sequence[Log]
) -> tuple[Band, Drawn]:
    """Of the logs that were fitted: the band made of them, and what is drawn.

    Windows that overlap say little more of the band, and a simulator on the host takes
    as long for them as for the fit.
    """
    if simulator_of(machine.system) is not None:
        grid = thin_windows(grid)
    found = forecast_grid(machine.system, machine.posterior, grid, CURVE[0])
    rows = scored_rows(CURVE[0])[1:]
    band = fit_band(found.at(rows), grid, len(set(recording_names(logs))))
    return band, (machine, forecast_traces(found, band, grid), grid)


def _stored(
    table: Parameters, fitted: Estimate, honest: Gaussian, band: Band, seed: int
) -> dict[str, np.ndarray]:
    key = jax.random.fold_in(jax.random.key(seed), 1)
    return {
        "belief/mean": np.asarray(fitted.posterior.mean),
        "belief/theta": np.asarray(physical_mode(table, fitted.posterior.mean)),
        "belief/scale": np.asarray(fitted.posterior.scale),
        "belief/prior_mean": np.asarray(fitted.prior.mean),
        "belief/prior_scale": np.asarray(fitted.prior.scale),
        "belief/information": np.asarray(fitted.information),
        "belief/noise": np.asarray(fitted.noise.sd),
        "belief/weights": np.asarray(fitted.noise.weights),
        "intervals/mean": np.asarray(honest.mean),
        "intervals/theta": np.asarray(physical_mode(table, honest.mean)),
        "intervals/scale": np.asarray(honest.scale),
        "band/start_sd": band.start_sd,
        "band/input_sd": band.input_sd,
        "band/resolution": band.resolution,
        "band/rows": band.rows,
        "band/shape": band.shape,
        "band/inflation": np.asarray(band.inflation),
        **diagnose.arrays(table, fitted.prior, honest, key=key),
    }


def _identification_summary(
    chosen: WindowLength,
    logs: Sequence[Log],
    likelihood: AnyWindows,
    fitted: Estimate,
    honest: CorrectedFit,
    band: Band,
    seed: int,
) -> dict[str, Any]:
    system, windows = chosen.fit.project.system, likelihood.windows
    inputs = [channel.name for channel in system.actions]
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
    listed = configuration_entries(system, logs, found["parameters"])
    tables = [*missing_forces_table(honest), *listed.get("tables", ())]
    return {
        "command": "identify",
        "title": f"{chosen.fit.project.name}: what {_count_of_logs(logs)}",
        "headline": identified_headline(found["parameters"]),
        "seed": seed,
        "converged": True,
        "convergence": fitted.convergence.as_dict(),
        "noise": noise,
        "intervals": interval_entry(honest, found["parameters"], len(windows)),
        "forces": force_entries(honest),
        "misfit": {
            **chosen.misfit.as_dict(),
            "noise": _noise_words(names, noise, windows, channel_units(system)),
        },
        "log_evidence": float(fitted.log_evidence),
        "n_rows": rows,
        "period": float(np.median(np.concatenate([np.diff(x.time) for x in logs]))),
        "n_logs": len(set(recording_names(logs))),
        "n_transitions": rows - len(logs),
        "n_windows": len(windows),
        "units": channel_units(system),
        "band": {
            "input_sd": dict(zip(inputs, band.input_sd.tolist(), strict=True)),
            "inflation": band.inflation,
        },
        "warnings": [
            *bound_warnings(found["parameters"]).values(),
            *note_lines(logs),
            *clock_warnings(logs, system),
        ],
        "trace_note": "Forecasts of half a second from causal starts, of the logs that "
        "were fitted; they know the recorded inputs and nothing else of the future.",
        **listed,
        "tables": tables,
        **found,
    }


def identified_headline(parameters: dict[str, dict[str, Any]]) -> str:
    """How many parameters the logs determine, and which they do not."""
    sure = [n for n, entry in parameters.items() if entry["verdict"] == "identified"]
    ends = [n for n, entry in parameters.items() if entry["verdict"] == "at_bound"]
    rest = [n for n in parameters if n not in {*sure, *ends}]
    text = f"{len(sure)} of {len(parameters)} parameters are identified"
    if sure:
        text += f" ({', '.join(sure)})"
    if ends:
        text += f"; at an end of its range: {', '.join(ends)}"
    if rest:
        text += f"; not by these logs alone: {', '.join(rest)}"
    return f"{text}."


def _count_of_logs(logs: Sequence[Log]) -> str:
    count = len(set(recording_names(logs)))
    return "one log determines" if count == 1 else f"{count} logs determine"


def _noise_words(
    names: Sequence[str],
    noise: dict[str, float],
    windows: Windows | Cuts,
    unit: dict[str, str],
) -> list[str]:
    """What the window noise contains in addition to the sensor's own."""
    out = []
    for name, floor in zip(names, np.asarray(windows.floor), strict=True):
        times = noise[name] / float(floor)
        out.append(
            f"The noise of {name}, {noise[name]:.2g} {unit[name]}, is {times:.0f} "
            "times the rounding of its recorded numbers: noise of the sensor, or "
            "errors of the model. Errors of the model are alike in neighbouring "
            "samples; the plain posterior is too narrow then."
            if times > 3.0
            else f"The noise of {name}, {noise[name]:.2g} {unit[name]}, is that of "
            "the rounding of its recorded numbers: these windows show no other error."
        )
    return out


def _drawings(
    project: Project,
    logs: Sequence[Log],
    own: Drawn,
    other: Unseen | None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Forecasts of the fitted logs and of held-out data, and a film of the latter."""
    machine, picture, shown = own
    names = channels(project.system, shown.windows)
    arrays, data = trace_arrays(picture, shown, logs, names), "fitted"
    summary: dict[str, Any] = {}
    if other is not None:
        summary["held_out"] = other.summary
        arrays |= other.arrays
        if other.fold is not None and len(other.picture["which"][0]) >= _SHORTEST:
            picture, data = other.picture, "held-out"
            machine, shown = other.fold.machine, other.fold.tested
    title = f"Forecasts of {data} data over what was recorded"
    about, moves = film(machine.system, machine.posterior, picture, shown, logs, title)
    return summary | ({"animation": about} if about else {}), arrays | moves


def held_against(fit: WindowFit, seed: int, check: bool, nuts: bool) -> dict[str, Any]:
    """What the exact posterior says of Laplace's, where it is asked."""
    out: dict[str, Any] = {}
    if not check and not nuts:
        return out
    system, fitted = fit.project.system, fit.fitted
    names, key = system.parameters.names, jax.random.key(seed)
    likelihood = WindowsLikelihood(system, fit.cut.windows.whole())
    if check:
        checked = check_windows(likelihood, fitted, key=jax.random.fold_in(key, 2))
        out["check"] = checked.as_dict(names)
    if nuts:
        sampled = sample_windows(likelihood, fitted, key=jax.random.fold_in(key, 3))
        out["nuts"] = sampled.as_dict(names)
    return out
