"""Forecasts of data that a fit has not seen, for the report of `identify`.

The parameters of a run are fitted to all of its logs. Here they are fitted once more
without the last recording (or the end of the only one), which is then forecast.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Int

from sim2gp.commands.folds import Fold, fit_fold, split_held_out
from sim2gp.data.cuts import Cuts
from sim2gp.data.grid import CURVE, Grid, steps_of
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.errors import DeadParameters, NotConverged, NotFinite
from sim2gp.identification.forecasts.baselines import forecast_sentence
from sim2gp.identification.forecasts.calibration import calibrate_forecasts
from sim2gp.identification.forecasts.forecast_machine import forces_sentence
from sim2gp.identification.forecasts.prediction import (
    TRACE,
    Picture,
    channel_units,
    channels,
    forecast_scores,
    forecast_traces,
    trace_arrays,
)
from sim2gp.inference.estimate import Estimate
from sim2gp.project import Project

PREFIX = "unseen"  # of the traces


class Unseen(NamedTuple):
    """What is said of held-out data, what is drawn, and the windows of a film."""

    summary: dict[str, Any]
    arrays: dict[str, np.ndarray]
    fold: Fold | None
    picture: Picture


def forecast_unseen(
    project: Project,
    logs: Sequence[Log],
    windows: Windows | Cuts,
    places: Int[np.ndarray, "W 2"],
    grid: Grid,
    whole: Estimate,
) -> Unseen:
    """A second fit, of a part of the windows, and its forecasts of the rest.

    It begins at the parameters, starts and noise of the ``whole`` logs, and has as many
    starts to choose from as that fit: the two share their compilation.
    """
    part = split_held_out(logs, windows, places, grid)
    if part is None:
        return _none("too little was recorded to hold some of it out.")
    horizon = _horizon(grid, part.test)
    try:
        key = jax.random.key(0)  # of starts that it does not draw
        found = fit_fold(
            project, windows, grid, part, horizon, key=key, starts=2, warm_start=whole
        )
    except (NotConverged, NotFinite, DeadParameters) as error:
        return _none(f"a fit without {part.words} failed ({error}).")
    names = channels(project.system, windows)
    summary, arrays = forecast_scores(found.judged, names, logs, horizon)
    summary["calibration"], shares = calibrate_forecasts(
        found.judged, names, logs, horizon, found.band.inflation
    )
    del summary["tables"]
    picture = forecast_traces(found.forecast, found.band, found.tested)
    traces = trace_arrays(picture, found.tested, logs, names, PREFIX)
    summary["left_out"] = part.words
    summary["headline"] = forecast_sentence(
        f"A fit without {part.words} predicts it {horizon:g} s ahead, "
        "root mean square errors",
        summary["open_loop_rmse"],
        summary["trivial"],
        channel_units(project.system),
    )
    if found.machine.scales:
        summary["forecast_forces"] = dict(found.machine.scales)
    summary["text"] = (
        f"The parameters were fitted once more without {part.words}, which that fit "
        "then forecast, knowing its inputs. The other sections rest on all of the data."
        f"{forces_sentence(found.machine.scales)}"
    )
    if part.recordings == 1:
        summary["text"] += (
            " One recording does not show how much others differ. So the bands are "
            "twice as wide as this recording needs, and hold more than their share."
        )
    return Unseen(summary, arrays | shares | traces, found, picture)


def _none(why: str) -> Unseen:
    return Unseen({"text": f"No forecasts of unseen data: {why}"}, {}, None, {})


def _horizon(grid: Grid, test: np.ndarray) -> float:
    """Half a second, or as long as a held-out window is."""
    measured = np.asarray(grid.windows.mask)[test].any(axis=(0, 2))
    whole = [h for h in CURVE if h <= TRACE and measured[steps_of(h)]]
    return max(whole, default=CURVE[0])
