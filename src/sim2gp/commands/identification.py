"""The result of `identify`: a posterior over the parameters of a machine.

It is the same object where it was just made and where `load_run` reads it back.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

from sim2gp.commands.result import PROJECT, AbstractResult
from sim2gp.data.logs import Budget, Log
from sim2gp.errors import error
from sim2gp.identification.forecasts.forecast import Band
from sim2gp.identification.forecasts.forecast_machine import (
    ForecastMachine,
    stored_forecast_machine,
)
from sim2gp.identification.words import bound_warnings
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.project import Project, load_project
from sim2gp.project.in_memory import read_logs
from sim2gp.runs import load_run
from sim2gp.runs.manifest import damaged
from sim2gp.runs.store import SUMMARY, Run
from sim2gp.systems.base import AbstractSystem
from sim2gp.types import AnyArray, in_float64

#: The corrected posterior has the report's intervals, the plain one is Laplace's.
Width = Literal["corrected", "plain"]
#: Arrays of a run: where its posteriors are.
_PREFIX = {"corrected": "intervals", "plain": "belief"}


@dataclass(frozen=True)
class IdentifiedConstant:
    """What is known of one parameter, in its physical unit.

    ``interval`` holds it with 95 % probability, allowing for errors of the model.
    """

    name: str
    unit: str
    mean: float
    sd: float
    interval: tuple[float, float]
    prior_mean: float
    prior_sd: float
    verdict: str
    meaning: str = ""


@dataclass(frozen=True, repr=False)
class Identification(AbstractResult):
    """The posterior of a machine's parameters, what it was fitted to, and the summary.

    A ``first_answer`` has a summary alone: no posterior to go on with.
    """

    logs: tuple[Log, ...] | None = None

    @property
    def machine(self) -> AbstractSystem:
        """The machine whose parameters these are."""
        return self._project.system

    @property
    def parameters(self) -> dict[str, IdentifiedConstant]:
        """Each parameter by name, in physical units."""
        fields = ("unit", "mean", "sd", "prior_mean", "prior_sd", "verdict")
        return {
            name: IdentifiedConstant(
                name=name,
                interval=(entry["q025"], entry["q975"]),
                meaning=entry.get("meaning") or "",
                **{key: entry[key] for key in fields},
            )
            for name, entry in self.summary["parameters"].items()
        }

    @cached_property
    def posterior(self) -> Gaussian:
        """As wide as the report's intervals, which allow for errors of the model.

        Over virtual values; it is what leaves the run.
        """
        return _stored_posterior(self.arrays, "corrected")

    @cached_property
    def plain(self) -> Gaussian:
        """Laplace's about the MAP, which counts the model as right.

        Forecasts start from its mean, because the fit's errors are smallest there, and
        expected information is counted from it.
        """
        return _stored_posterior(self.arrays, "plain")

    @cached_property
    def forecast_machine(self) -> ForecastMachine:
        """What forecasts are made with: ``plain``, or a fit with missing forces.

        Forces are those that predicted recordings which were left out.
        """
        if "forecast_forces" not in self.summary:
            return ForecastMachine(self.machine, self.plain)
        return stored_forecast_machine(self.machine, self.summary, self.arrays)

    @property
    def noise(self) -> dict[str, float]:
        """Standard deviation of each measured channel, in its unit."""
        return {name: float(sd) for name, sd in self.summary["noise"].items()}

    @property
    def period(self) -> float:
        """Median time between rows of the logs, s; clocks jitter."""
        return float(f"{self.summary['period']:.3g}")

    @cached_property
    def band(self) -> Band:
        """What the bands of forecasts are made of."""
        x = self.arrays
        return Band(
            x["band/start_sd"],
            x["band/input_sd"],
            x["band/resolution"],
            x["band/rows"],
            x["band/shape"],
            float(x["band/inflation"]),
        )

    @property
    def _project(self) -> Project:
        assert self.project is not None
        return self.project

    def within(self, budget: Budget) -> "Identification":
        """The same, where reading a log may take another budget."""
        return replace(self, project=replace(self._project, budget=budget))

    def read_logs(
        self,
        files: Sequence[Path | str],
        configuration: str | None = None,
        *,
        strict: bool = False,
    ) -> tuple[Log, ...]:
        """Logs of the machine in one configuration: `sim2gp.read_logs`."""
        return read_logs(files, self._project, configuration, strict=strict)

    def training_logs(
        self, *, strict: bool = False, alike: bool = False
    ) -> tuple[Log, ...]:
        """The logs of the fit: as given, or read from the files' recorded places."""
        if self.logs is not None:
            if alike:
                self._project.check_alike()
            return self.logs
        return self._project.load_logs(strict=strict, alike=alike)

    def forecast(self, logs: Sequence[Log] | Log, horizon: float = 0.2) -> Any:
        """Open-loop forecasts of logs that it has not seen: `evaluate`."""
        from sim2gp.commands.evaluate import evaluate

        return evaluate(self, logs, horizon=horizon)


@in_float64
def physical_mode(table: Parameters, tt: AnyArray) -> np.ndarray:
    """The parameters at the posterior's mode, in physical units."""
    return np.asarray(table.constrain(np.asarray(tt, float)))


@in_float64
def _stored_posterior(x: Mapping[str, np.ndarray], which: Width) -> Gaussian:
    """One of the two posteriors of an identification, over virtual values."""
    prefix = _PREFIX[which]
    mean, scale = (np.asarray(x[f"{prefix}/{n}"]) for n in ("mean", "scale"))
    return Gaussian(jnp.asarray(mean), jnp.asarray(scale))


def modes(x: Mapping[str, np.ndarray], table: Parameters, which: Width) -> np.ndarray:
    """The parameters at a posterior's mode, in physical units, as they were fitted.

    ``x`` are the run's arrays. E170 where a run of an older version does not say them,
    and the model's file has changed since.
    """
    prefix = _PREFIX[which]
    if f"{prefix}/theta" not in x:
        _check_fitted("the model's file", table, x)
        return np.asarray(physical_mode(table, jnp.asarray(x[f"{prefix}/mean"])))
    return np.asarray(x[f"{prefix}/theta"])


def posterior_entries(summary: Mapping[str, Any], which: Width) -> dict[str, Any]:
    """Which posterior left a run, for the summary of what it left for.

    ``which`` as asked, ``widened`` the least and the most by which the corrected sd
    exceed the plain ones, and ``why`` in a sentence where that is much. Parameters at
    an end of their range are ``warnings``.
    """
    entries = summary["parameters"].values()
    ratios = [entry["widened"] for entry in entries if entry.get("widened")]
    about = summary.get("intervals", {})
    return {
        "posterior": which,
        "widened": [min(ratios), max(ratios)] if ratios else None,
        "why": about.get("why"),
        "warnings": list(bound_warnings(summary["parameters"]).values()),
    }


def recorded_project_path(run: Path, summary: dict[str, Any]) -> Path:
    """Where the project file of an identification was."""
    about = summary.get("project", {})
    place = run / about.get("folder", "") / about.get("file", PROJECT)
    return Path(os.path.normpath(place))


def project_of(
    run: Path,
    stored: Run,
    *,
    model: Path | None = None,
    machine: AbstractSystem | None = None,
) -> Project:
    """The run's own copy of its project; its logs and model's file in their old places.

    ``model`` is another file of the model, ``machine`` one of the user's own.
    """
    place = recorded_project_path(run, stored.summary)
    found = load_project(run / PROJECT, place.parent, model, system=machine)
    # The copy's folder is the run's: what was moved is the copy alone.
    return replace(
        found,
        path=place,
        own=model is not None or machine is not None,
        chosen_window=_chosen_window(run, stored.summary),
    )


def _chosen_window(run: Path, summary: dict[str, Any]) -> float | None:
    """The length of windows that the fit has chosen, s."""
    about = summary.get("window")
    if not isinstance(about, dict) or not about.get("chosen"):
        return None
    seconds = about.get("seconds")
    if isinstance(seconds, int | float) and 0.0 < seconds < math.inf:
        return float(seconds)
    raise damaged(run, SUMMARY, f"window.seconds is {seconds!r}")


@in_float64
def restore_identification(
    run: Path, machine: AbstractSystem | None = None
) -> Identification:
    """What `identify` saved.

    E130 for another folder, E183 for forces that it cannot have found, E184 for other
    parameters.
    """
    stored = load_run(run)
    check_identified(run, stored)
    project = project_of(run, stored, machine=machine)
    _check_constants(run, project, stored.summary)
    _check_fitted(project.spec.system, project.system.parameters, stored.arrays)
    found = Identification(stored.summary, stored.arrays, {}, project, run)
    try:
        _ = found.forecast_machine
    except (ValueError, TypeError, AttributeError) as error:
        raise damaged(run, SUMMARY, str(error)) from error
    return found


def check_identified(run: Path, stored: Run) -> None:
    """E130 for a folder that `identify` did not save, or not with both widths."""
    found = {"belief/mean", "intervals/mean"} <= set(stored.arrays)
    if found and (run / PROJECT).exists():
        return
    got = str(stored.summary.get("command", "a run without a belief"))
    raise error("not_an_identification", where=str(run), got=got)


def _check_constants(run: Path, project: Project, summary: dict[str, Any]) -> None:
    """The run's copy of its project still opens the run's parameters (E184)."""
    now, fitted = project.system.parameters.names, tuple(summary["parameters"])
    if now == fitted:
        return
    got = ", ".join(n for n in now if n not in fitted) or ", ".join(now)
    expected = ", ".join(n for n in fitted if n not in now) or ", ".join(fitted)
    where = str(run / PROJECT)
    raise error("other_parameters_than_fitted", where=where, got=got, expected=expected)


def _check_fitted(where: str, table: Parameters, x: Mapping[str, np.ndarray]) -> None:
    """A model's file still has the numbers that its default priors are about (E170)."""
    now = physical_mode(table, jnp.asarray(x["belief/mean"]))
    theta = x.get("belief/theta", now)
    for name, is_, was in zip(table.names, np.asarray(now), theta, strict=True):
        if not np.isclose(is_, was, rtol=1e-9, atol=1e-12):
            raise error(
                "another_machine_than_fitted",
                where=where,
                got=f"{is_:.9g} at the posterior's mode",
                expected=f"{was:.9g}",
                name=name,
            )
