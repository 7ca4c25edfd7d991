"""Design: the next experiment on a machine, and what it should tell.

From a finished identification, or from a project file alone, before any log exists. The
commands keep their limits exactly; the states keep theirs for nearly all machines that
the belief still allows.
"""

import io
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.design import (
    AbstractGoal,
    AbstractSignal,
    Designed,
    Everything,
    Experiment,
    Free,
    Limits,
    Multisine,
    Named,
    Prediction,
    design,
    prediction_rows,
)
from sim2gp.diagnose.table import physical_moments
from sim2gp.diagnose.words import digits, listed
from sim2gp.errors import InputError
from sim2gp.experiments.identified import restored
from sim2gp.experiments.prediction import units
from sim2gp.experiments.record import command, provenance
from sim2gp.models.features import Encoding
from sim2gp.models.informed import informed_prior
from sim2gp.models.sim2gp import PRIOR_NOISE
from sim2gp.parameters import unknown_parameter
from sim2gp.project import Project
from sim2gp.runs import Progress, new_run
from sim2gp.systems import alone
from sim2gp.systems.base import AbstractSystem, index_of
from sim2gp.types import in_float64

FILE = "trajectory.csv"
PERIOD = 0.01  # s, of commands and samples, where no log says otherwise
WINDOW = 0.2  # s, where the likelihood has windows of one step
LOOSE = 1.0  # rad, m, rad/s or m/s: the sd of a window's start where none is stated
NARROWER = 0.05  # an experiment must narrow what is asked by this share


@dataclass(frozen=True)
class Asked:
    """What is asked of an experiment: the options of the command."""

    seconds: float
    kind: str
    about: tuple[str, ...]
    predict: float | None
    within: float
    limits: Mapping[str, tuple[float, float]]
    rates: Mapping[str, float]
    start: Mapping[str, float]
    period: float | None
    starts: int = 1
    configuration: str | None = None

    def words(self) -> str:
        """As they were typed."""
        parts = [f"--seconds {self.seconds:g}", f"--kind {self.kind}"]
        parts += [f"--about {' '.join(self.about)}"] if self.about else []
        parts += [f"--predict {self.predict:g}"] if self.predict else []
        parts += [f"--within {self.within:g}"]
        boxes = [f"{n}={low:g}:{high:g}" for n, (low, high) in self.limits.items()]
        for option, pairs in (
            ("--limit", boxes),
            ("--rate", [f"{n}={x:g}" for n, x in self.rates.items()]),
            ("--start", [f"{n}={x:g}" for n, x in self.start.items()]),
        ):
            parts += [f"{option} {' '.join(pairs)}"] if pairs else []
        parts += [f"--period {self.period:g}"] if self.period else []
        parts += [f"--starts {self.starts}"]
        if self.configuration:
            parts += [f"--configuration {self.configuration}"]
        return " ".join(parts)


def run(
    source: Project | Path, asked: Asked, *, out: Path, seed: int, progress: Progress
) -> dict[str, Any]:
    """Choose the commands and write them; returns the summary.

    Raises `InputError`: E145 for an unknown constant, E103 for an unknown channel, E150
    where the limits admit no motion, E151 for a duration shorter than a step.
    """
    started = time.perf_counter()
    with new_run(out, "design") as writer, progress.task("design", 3) as task:
        project, experiment, notes = setting(source, asked)
        stated = {
            name: (low, high) for name, (low, high) in project.spec.limits.items()
        }
        limits = Limits.of(
            experiment.system,
            stated | dict(asked.limits),
            dict(project.spec.rates) | dict(asked.rates),
            start=np.asarray(experiment.start),
        )
        if not limits.stated():
            notes.append("no limit of any position or velocity is stated")
        key = jax.random.key(seed)
        signal = signal_of(asked.kind, experiment)
        goal = goal_of(asked, experiment, limits, jax.random.fold_in(key, 1))
        task.advance("limits and goal")
        found = design(experiment, goal, limits, signal, key=key, starts=asked.starts)
        task.advance(f"{found.nats:.1f} nats")
        place = source.path if isinstance(source, Project) else source
        summary = _summarise(place, asked, experiment, goal, found, seed)
        summary["warnings"] = notes
        line = command("sim2gp", "design", place, *asked.words().split())
        line += " " + command("--seed", seed, "--out", out)
        summary |= provenance(line, started)
        arrays = _arrays(experiment, limits, found)
        from sim2gp.report import write_report

        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        writer.write_text(FILE, as_csv(experiment, found))
        writer.write_text("report.html", write_report(summary, arrays))
        task.advance("report")
    return summary


@in_float64
def setting(
    source: Project | Path, asked: Asked
) -> tuple[Project, Experiment, list[str]]:
    """The machine and what is believed of it; what the user should know of both."""
    notes: list[str] = []
    if isinstance(source, Project):
        project, system = source, source.system
        belief, names = informed_prior(system.parameters), _measured(project)
        noise, period = _stated_noise(project, names), PERIOD
        notes.append("no log was used: what is believed is the project's priors")
    else:
        found = restored(source)
        project, system, belief = found.project, found.project.system, found.posterior
        names, noise, period = found.outputs, found.noise, found.period
    system, belief = alone(system, belief, asked.configuration)
    states = [channel.name for channel in system.physical_states]
    period = asked.period or period
    steps = round(asked.seconds / period)
    if steps < 2:
        raise InputError(
            "E151",
            "experiment shorter than its steps",
            where="--seconds",
            got=f"{asked.seconds:g} s",
            expected=f"at least two periods of {period:g} s",
            fix="design some seconds",
        )
    stated = project.spec.likelihood
    window = max(2, round((stated.window or WINDOW) / period))
    sd = stated.start_sd
    each = sd if isinstance(sd, dict) else dict.fromkeys(states, sd or LOOSE)
    experiment = Experiment(
        system,
        belief,
        jnp.asarray(noise, float),
        _start(asked.start, system),
        jnp.asarray([each.get(name, LOOSE) for name in states], float),
        tuple(states.index(name) for name in names),
        period,
        steps,
        min(window, steps),
    )
    return project, experiment, notes


def signal_of(kind: str, experiment: Experiment) -> AbstractSignal:
    """The family that the commands are chosen from."""
    family = {"multisine": Multisine, "free": Free}[kind]
    return family(experiment.period, experiment.steps)


def goal_of(
    asked: Asked, experiment: Experiment, limits: Limits, key: jax.Array
) -> AbstractGoal:
    """What is asked about: all constants, some, or a prediction."""
    names = experiment.system.parameters.names
    for name in asked.about:
        if name not in names:
            raise unknown_parameter(name, names)
    if asked.predict:
        return Prediction(prediction_rows(experiment, limits, asked.predict, key))
    if asked.about:
        return Named(tuple(names.index(name) for name in asked.about))
    return Everything()


def _measured(project: Project) -> list[str]:
    """Channels that the logs of a project measure; all positions where it has none."""
    states = [channel.name for channel in project.system.physical_states]
    named = {name for group in project.spec.logs for name in group.columns}
    measured = [name for name in states if name in named]
    return measured or [name for name in states if not name.endswith(".velocity")]


def _stated_noise(project: Project, names: list[str]) -> list[float]:
    """As the project states it, or a thousandth of half of each channel's box."""
    system, floor = project.system, project.spec.likelihood.noise_floor
    half = np.asarray(Encoding.of(system, {}).half_widths()).tolist()
    states = [channel.name for channel in system.physical_states]
    guess = {n: PRIOR_NOISE * h for n, h in zip(states, half, strict=True)}
    each = floor if isinstance(floor, dict) else {n: floor or guess[n] for n in names}
    return [each.get(name, guess[name]) for name in names]


def _start(given: Mapping[str, float], system: AbstractSystem) -> Any:
    states = system.physical_states
    for name in given:
        index_of(name, states, where="--start")
    return jnp.asarray([given.get(c.name, 0.0) for c in states], float)


@in_float64
def expectation(experiment: Experiment, found: Designed) -> dict[str, dict[str, Any]]:
    """Of each constant: unit, mean and sd now, sd expected after, and their ratio."""
    table, belief = experiment.system.parameters, experiment.belief
    mean = np.asarray(belief.mean)
    before = physical_moments(table, mean, np.asarray(belief.sd()))
    sd = np.sqrt(np.sum(found.scale**2, axis=1))
    after = physical_moments(table, mean, sd)
    return {
        p.name: {
            "unit": p.unit,
            "mean": float(before["mean"][j]),
            "sd": float(before["sd"][j]),
            "expected_sd": float(after["sd"][j]),
            "of_before": float(after["sd"][j] / before["sd"][j]),
        }
        for j, p in enumerate(table.free)
    }


@in_float64
def _summarise(
    place: Path,
    asked: Asked,
    experiment: Experiment,
    goal: AbstractGoal,
    found: Designed,
    seed: int,
) -> dict[str, Any]:
    expected = expectation(experiment, found)
    ahead: dict[str, float] = {}
    if not isinstance(goal, Prediction):
        worth, reason = verdict(asked, expected, found.nats)
    else:
        before, after = experiment.belief.scale, jnp.asarray(found.scale)
        ahead = {
            "before": float(goal.deviation(before)),
            "after": float(goal.deviation(after)),
        }
        worth, reason = foretold(asked, ahead["before"], ahead["after"], found.nats)
    return {
        "command": "design",
        "title": f"{place.stem}: the next experiment",
        "headline": reason,
        "seed": seed,
        "trajectory": FILE,
        "seconds": experiment.period * experiment.steps,
        "period": experiment.period,
        "information_nats": found.nats,
        "worth_running": worth,
        "expected_sd": expected,
        "prediction_sd": ahead,
        "violations": found.violations,
        "draws_checked": found.checked,
        "units": units(experiment.system),
        "tables": [_table(expected)],
    }


def verdict(
    asked: Asked, expected: Mapping[str, Mapping[str, Any]], nats: float
) -> tuple[bool, str]:
    """Whether it is worth the robot's time, and why.

    What such an experiment cannot narrow is no reason to run it.
    """
    names = asked.about or tuple(expected)
    told = [n for n in names if expected[n]["of_before"] <= 1.0 - NARROWER]
    if not told:
        return False, (
            "Not worth running: within these limits nothing narrows "
            f"{listed(names)} by more than {100.0 * NARROWER:.0f} %."
        )
    share = {n: 100.0 * expected[n]["sd"] / abs(expected[n]["mean"]) for n in told}
    poor = [n for n in told if share[n] > asked.within]
    untold = [n for n in names if n not in told]
    rest = f" It tells next to nothing of {listed(untold)}." if untold else ""
    if not poor:
        return False, (
            f"Not worth running: {listed(told)} known within {asked.within:g} % "
            f"already.{rest}"
        )
    worst = max(poor, key=lambda n: share[n])
    after = share[worst] * expected[worst]["of_before"]
    text = f"Worth running: {nats:.1f} nats. {worst}, known within"
    text += f" {digits(share[worst], 2)} % now, should be within {digits(after, 2)} %"
    return True, f"{text} after.{rest}"


def foretold(
    asked: Asked, before: float, after: float, nats: float
) -> tuple[bool, str]:
    """The same of a prediction, its sd in those of the sensors' noise.

    Nobody can see that it is better than the sensors.
    """
    what = f"what is predicted {asked.predict:g} s ahead"
    now = f"{digits(before, 2)} sd of the sensors' noise"
    if before <= 1.0:
        return False, f"Not worth running: {what} is known within {now} already."
    if after > (1.0 - NARROWER) * before:
        return False, (
            f"Not worth running: within these limits nothing narrows {what} by more "
            f"than {100.0 * NARROWER:.0f} %; it is known within {now}."
        )
    return True, (
        f"Worth running: {nats:.1f} nats; {what}, known within {now} now, should be "
        f"within {digits(after, 2)} after."
    )


def _table(expected: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    rows = [
        [
            name,
            f"{e['mean']:.4g} {e['unit']}",
            f"{e['sd']:.2g}",
            f"{e['expected_sd']:.2g}",
            f"{digits(100.0 * e['of_before'], 2)} %",
        ]
        for name, e in expected.items()
    ]
    return {
        "title": "What the experiment should tell",
        "columns": ["constant", "believed", "sd now", "sd after", "left"],
        "rows": rows,
        "note": "Expected where the machine is as believed and its noise independent.",
    }


def _arrays(
    experiment: Experiment, limits: Limits, found: Designed
) -> dict[str, np.ndarray]:
    system = experiment.system
    arrays = {
        "design/time": experiment.period * np.arange(experiment.steps + 1),
        "design/scale": found.scale,
        "belief/mean": np.asarray(experiment.belief.mean),
    }
    for i, channel in enumerate(system.actions):
        arrays[f"design/command/{channel.name}"] = found.commands[:, i]
        arrays[f"design/limit/{channel.name}"] = _pair(limits.low, limits.high, i)
    for i, channel in enumerate(system.physical_states):
        for name, values in (
            ("state", found.states),
            ("low", found.low),
            ("high", found.high),
        ):
            arrays[f"design/{name}/{channel.name}"] = values[:, i]
        box = _pair(limits.state_low, limits.state_high, i)
        arrays[f"design/limit/{channel.name}"] = box
    return arrays


def _pair(low: np.ndarray, high: np.ndarray, i: int) -> np.ndarray:
    return np.asarray([low[i], high[i]], float)


def as_csv(experiment: Experiment, found: Designed) -> str:
    """A row for each period: its time, its commands, and the states expected then.

    Numbers are written in full: what is read back keeps the limits as well.
    """
    system = experiment.system
    inputs = [channel.name for channel in system.actions]
    states = [f"expected.{channel.name}" for channel in system.physical_states]
    text = io.StringIO()
    text.write(",".join(["time", *inputs, *states]) + "\n")
    for k in range(experiment.steps):
        row = [experiment.period * k, *found.commands[k], *found.states[k]]
        text.write(",".join(repr(float(x)) for x in row) + "\n")
    return text.getvalue()
