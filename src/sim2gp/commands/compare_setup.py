"""What a comparison of models is made of: windows, one-step data, and its folds."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim2gp.commands.evaluation import windows_for
from sim2gp.data.grid import CURVE, PERIOD, Grid
from sim2gp.data.logs import Log
from sim2gp.data.one_step_log import (
    Samples,
    Steps,
    samples_of,
    steps_of_grid,
    stride_of,
)
from sim2gp.data.split_log import measured_states
from sim2gp.data.windows import Windows
from sim2gp.errors import error
from sim2gp.identification.forecasts.prediction import recording_names
from sim2gp.project import Project
from sim2gp.project.training_windows import cut_logs
from sim2gp.systems.assemble import carrying_inputs
from sim2gp.systems.base import AbstractSystem

STEP = 0.02  # s, the period of one-step models where the log's own is shorter
MOST_FOLDS = 6  # more recordings are left out in groups
LAST = 0.25  # of a single recording is left out
REACH = 1.2  # half-width of a state without limits, in the largest seen


@dataclass(frozen=True)
class Setup:
    """Everything of a comparison that is the same in all folds."""

    project: Project
    logs: tuple[Log, ...]
    windows: Windows  # to fit the simulator
    of: np.ndarray  # log of each of these
    grid: Grid
    period: float
    samples: Samples  # to train what is learned
    steps: Steps  # to be judged by
    horizons: tuple[float, ...]  # s, in whole periods
    reach: dict[str, float]


def prepare_comparison(
    project: Project, logs: Sequence[Log], horizons: Sequence[float]
) -> tuple[Setup, list[list[int]]]:
    """Windows, one-step data and folds (each the indices of the logs left out)."""
    system = project.system
    logs, folds = _folds(logs)
    recorded = float(np.median([log.period for log in logs]))
    period = PERIOD * stride_of(max(recorded, STEP))
    horizons = [period * max(1, round(h / period)) for h in sorted(set(horizons))]
    longest = max(horizons)
    grid = windows_for(logs, project, longest, longest)
    windows, of = cut_logs(project, logs)
    stepper = carrying_inputs(system, period)
    samples = samples_of(logs, stepper, period)
    row_log = samples.step_log()
    curve = {round(h / period) for h in (*horizons, *CURVE) if h <= longest + 1e-9}
    steps = steps_of_grid(grid, logs, stepper, period, sorted(curve - {0}))
    for left in folds:
        trained = int(np.sum(~np.isin(row_log, left)))
        tested = int(np.sum(steps.valid[np.isin(steps.log, left)][:, -1]))
        if not trained or not tested:
            got = f"{trained} smoothed steps without it, {tested} windows in it"
            raise error(
                "nothing_to_compare",
                where=logs[left[0]].source,
                got=got,
                horizon=f"{longest:g}",
            )
    reach = _reach(stepper, samples)
    return Setup(
        project,
        logs,
        windows,
        of,
        grid,
        period,
        samples,
        steps,
        tuple(horizons),
        reach,
    ), folds


def _folds(logs: Sequence[Log]) -> tuple[tuple[Log, ...], list[list[int]]]:
    """The logs, and which of them each fold leaves out.

    Pieces of one recording go together. A single recording is split in time, and its
    last quarter is the only one left out.
    """
    files = list(dict.fromkeys(recording_names(logs)))
    if len(files) == 1:
        first, last = logs[0].time[0], logs[-1].time[-1]
        split = last - LAST * (last - first)
        before = [_piece(log, log.time < split, "") for log in logs]
        after = [_piece(log, log.time >= split, ", last quarter") for log in logs]
        kept = tuple(log for log in (*before, *after) if len(log) > 1)
        return kept, [[k for k, log in enumerate(kept) if log.time[0] >= split]]
    count = min(MOST_FOLDS, len(files))
    groups = [files[k::count] for k in range(count)]
    return tuple(logs), [
        [k for k, log in enumerate(logs) if log.source in group] for group in groups
    ]


def _piece(log: Log, rows: np.ndarray, word: str) -> Log:
    """Some rows of a log, as a recording of its own."""

    def some(table: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {name: values[rows] for name, values in table.items()}

    return replace(
        log,
        name=log.name + word,
        source=log.source + word,
        time=log.time[rows],
        channels=some(log.channels),
        inputs=some(log.inputs),
        mask=some(log.mask),
    )


def check_measured(logs: Sequence[Log], project: Project) -> None:
    """One-step models need every state, or the position whose rate it is (E103)."""
    system = project.system
    measured = measured_states(logs, system)
    names = [channel.name for channel in system.physical_states]
    missing = [
        name
        for name in names
        if name not in measured and name.removesuffix(".velocity") not in measured
    ]
    if missing:
        raise error(
            "unmeasured_position",
            where=project.source.where("logs", 0, "columns"),
            got=", ".join(measured),
            position=missing[0].removesuffix(".velocity"),
        )


def _reach(stepper: AbstractSystem, samples: Samples) -> dict[str, float]:
    """Half-widths of the box of states and inputs that have no limits, from the data.

    Angles keep their circle.
    """
    past = samples.held[:, ::-1].reshape(len(samples.held), -1)
    # Newest first: the action itself, then what the state carries of the past.
    m = len(stepper.actions)
    largest = [
        *np.max(np.abs(samples.rough), axis=0),
        *np.max(np.abs(past[:, m:]), axis=0),
        *np.max(np.abs(past[:, :m]), axis=0),
    ]
    return {
        c.name: REACH * float(half)
        for c, half in zip((*stepper.states, *stepper.actions), largest, strict=True)
        if not (c.angle or math.isfinite(c.high - c.low)) and half > 0.0
    }
