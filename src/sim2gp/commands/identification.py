"""A finished identification, read back from its run.

A command reads a run, and logs to hold it against, before it imports its experiment.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np

from sim2gp.data.logs import Budget, Log, none_unused
from sim2gp.errors import InputError
from sim2gp.identification.forecasts.forecast import Band
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.parameters import Parameters
from sim2gp.project import Project, load_project
from sim2gp.runs import load_run
from sim2gp.runs.store import Run
from sim2gp.systems.variants import index_of
from sim2gp.types import AnyArray, in_float64

PROJECT = "project.toml"  # the file's name in a run

#: The corrected posterior has the report's intervals, the plain one is Laplace's.
Width = Literal["corrected", "plain"]
#: Arrays of a run: where its posteriors are.
_PREFIX = {"corrected": "intervals", "plain": "belief"}


class Identified(NamedTuple):
    """A finished identification, read back from its run.

    ``posterior`` is as wide as the report's intervals, which allow for errors of the
    model: it is what leaves the run. ``plain`` is Laplace's about the MAP, which
    counts the model as right: forecasts start from its mean, because the fit's errors
    are smallest there, and expected information is counted from it.
    """

    run: Path
    project: Project
    summary: dict[str, Any]
    posterior: Gaussian
    plain: Gaussian
    outputs: list[str]  # the measured channels, in the order of `noise`
    noise: list[float]
    period: float  # s, median of the logs
    band: Band

    def within(self, budget: Budget) -> "Identified":
        """The same, where reading a log may take another budget."""
        return self._replace(project=replace(self.project, budget=budget))

    def read(
        self, logs: Sequence[Path], configuration: str | None, *, strict: bool
    ) -> tuple[Log, ...]:
        """Logs of the machine in one configuration (E152 where it has several)."""
        index_of(configuration, self.project.system.variants)
        found = self.project.read_logs(logs, configuration)
        if strict:
            none_unused(found)
        return found


@in_float64
def physical(table: Parameters, tt: AnyArray) -> np.ndarray:
    """The constants at the posterior's mode, in physical units."""
    return np.asarray(table.constrain(np.asarray(tt, float)))


def _posterior(stored: Run, which: Width) -> Gaussian:
    """One of the two posteriors of an identification, over virtual values."""
    x, prefix = stored.arrays, _PREFIX[which]
    return Gaussian(jnp.asarray(x[f"{prefix}/mean"]), jnp.asarray(x[f"{prefix}/scale"]))


def modes(stored: Run, table: Parameters, which: Width) -> np.ndarray:
    """The constants at a posterior's mode, in physical units, as they were fitted.

    E170 where a run of an older version does not say them, and the model's file has
    changed since.
    """
    x, prefix = stored.arrays, _PREFIX[which]
    if f"{prefix}/theta" not in x:
        _check_fitted("the model's file", table, x)
        return np.asarray(physical(table, jnp.asarray(x[f"{prefix}/mean"])))
    return np.asarray(x[f"{prefix}/theta"])


def used(summary: Mapping[str, Any], which: Width) -> dict[str, Any]:
    """Which posterior left a run, for the summary of what it left for.

    ``which`` as asked, ``widened`` the least and the most by which the corrected sd
    exceed the plain ones, and ``why`` in a sentence where that is much.
    """
    entries = summary["parameters"].values()
    ratios = [entry["widened"] for entry in entries if entry.get("widened")]
    about = summary.get("intervals", {})
    return {
        "posterior": which,
        "widened": [min(ratios), max(ratios)] if ratios else None,
        "why": about.get("why"),
    }


def stood(run: Path, summary: dict[str, Any]) -> Path:
    """Where the project file of an identification stood."""
    about = summary.get("project", {})
    place = run / about.get("folder", "") / about.get("file", PROJECT)
    return Path(os.path.normpath(place))


def project_of(run: Path, stored: Run, model: Path | None = None) -> Project:
    """The run's own copy of its project, its model's file where it was (or another)."""
    return load_project(run / PROJECT, stood(run, stored.summary).parent, model)


@in_float64
def restored(run: Path) -> Identified:
    """What `identify.run` wrote (E130 for another folder, E184 for other constants)."""
    stored = load_run(run)
    check_identified(run, stored)
    x, noise = stored.arrays, stored.summary["noise"]
    project = project_of(run, stored)
    _check_constants(run, project, stored.summary)
    _check_fitted(project.spec.system, project.system.parameters, x)
    return Identified(
        run,
        project,
        stored.summary,
        _posterior(stored, "corrected"),
        _posterior(stored, "plain"),
        list(noise),
        [float(sd) for sd in noise.values()],
        float(f"{stored.summary['period']:.3g}"),  # clocks jitter
        Band(
            x["band/start_sd"],
            x["band/input_sd"],
            x["band/resolution"],
            x["band/rows"],
            x["band/shape"],
            float(x["band/inflation"]),
        ),
    )


def check_identified(run: Path, stored: Run) -> None:
    """E130 for a folder that `identify.run` did not write, or not with both widths."""
    found = {"belief/mean", "intervals/mean"} <= set(stored.arrays)
    if found and (run / PROJECT).exists():
        return
    raise InputError(
        "E130",
        "not an identification",
        where=str(run),
        got=str(stored.summary.get("command", "a run without a belief")),
        expected="the folder of sim2gp identify",
        fix="run sim2gp identify first (again, if an older version made the run)",
    )


def _check_constants(run: Path, project: Project, summary: dict[str, Any]) -> None:
    """The run's copy of its project still opens the constants that it holds (E184)."""
    now, fitted = project.system.parameters.names, tuple(summary["parameters"])
    if now == fitted:
        return
    raise InputError(
        "E184",
        "another set of constants than was fitted",
        where=str(run / PROJECT),
        got=", ".join(n for n in now if n not in fitted) or ", ".join(now),
        expected=", ".join(n for n in fitted if n not in now) or ", ".join(fitted),
        fix="identify again, or take back the change of the run's project file",
    )


def _check_fitted(where: str, table: Parameters, x: dict[str, np.ndarray]) -> None:
    """A model's file still has the numbers that its default priors are about (E170)."""
    now = physical(table, jnp.asarray(x["belief/mean"]))
    theta = x.get("belief/theta", now)
    for name, is_, was in zip(table.names, np.asarray(now), theta, strict=True):
        if not np.isclose(is_, was, rtol=1e-9, atol=1e-12):
            raise InputError(
                "E170",
                f"another machine than was fitted: {name}",
                where=where,
                got=f"{is_:.9g} at the posterior's mode",
                expected=f"{was:.9g}",
                fix="identify again, or take back the change of the model's file",
            )
