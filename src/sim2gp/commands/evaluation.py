"""An evaluation: what it is, and what every one of them needs."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sim2gp.commands.result import AbstractResult, numeric_entries
from sim2gp.data.grid import CURVE, Grid, evaluation_windows, steps_of
from sim2gp.data.logs import Log
from sim2gp.errors import error
from sim2gp.identification.forecasts.baselines import forecast_sentence
from sim2gp.identification.forecasts.forecast_machine import forces_sentence
from sim2gp.identification.forecasts.prediction import channel_units
from sim2gp.project import Project
from sim2gp.runs.provenance import provenance


@dataclass(frozen=True, repr=False)
class Evaluation(AbstractResult):
    """How well logs were forecast that a fit had not seen, at one horizon (s)."""

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square error of open-loop forecasts, by channel in its unit."""
        return numeric_entries(self.summary["open_loop_rmse"])

    @property
    def hold_rmse(self) -> dict[str, float]:
        """The same of the measured start, predicted to stay."""
        return numeric_entries(self.summary["hold_rmse"])

    @property
    def regression_rmse(self) -> dict[str, float]:
        """The same of a linear regression; empty if it had too few windows."""
        return numeric_entries(self.summary.get("regression_rmse"))

    @property
    def coverage90(self) -> dict[str, float]:
        """The share of samples inside 90 % bands, by channel."""
        return numeric_entries(self.summary["coverage90"])


def windows_for(
    logs: Sequence[Log], project: Project, longest: float, horizon: float
) -> Grid:
    """Evaluation windows; E116 where no log is as long as the horizon."""
    if max(log.duration for log in logs) > horizon + CURVE[0]:
        grid = evaluation_windows(logs, project.system, longest=longest)
        if np.asarray(grid.windows.mask)[:, steps_of(horizon)].any():
            return grid
    got = f"{max(log.duration for log in logs):.3g} s"
    raise error("no_window_to_predict", got=got, horizon=f"{horizon:g}")


def check_horizon(horizon: float) -> None:
    """E160 for a horizon that is not some seconds."""
    if not 0.0 < horizon <= 60.0:
        raise error("horizon_out_of_range", where="--horizon", got=f"{horizon:g} s")


def evaluation_of(
    summary: dict[str, Any],
    arrays: dict[str, np.ndarray],
    project: Project,
    started: float,
    kinds: Iterable[str],
) -> Evaluation:
    """The result with its headline; forecasts have missing forces of these kinds."""
    unit = channel_units(project.system)
    summary["headline"] = forecast_sentence(
        f"Open-loop error at {summary['horizon']:g} s",
        summary["open_loop_rmse"],
        summary["trivial"],
        unit,
        summary["coverage90"],
    )
    if summary["losses"]:
        summary["headline"] += f" {summary['losses']}"
    summary["headline"] += forces_sentence(kinds)
    summary["units"] = unit
    summary["trace_note"] = (
        "Forecasts of half a second from causal starts, of logs that the fit has not "
        "seen; they know the recorded inputs and nothing else of the future."
    )
    return Evaluation(summary | provenance(started), arrays)
