"""Design: the next experiment on a machine, and what it should teach.

From a finished identification, or from a project file alone, before any log exists. The
commands keep their limits exactly; the states keep theirs for nearly all machines that
are plausible: after an identification, for those of its corrected posterior.
Information is counted from the plain one, because data do not reduce a model's errors.
"""

import io
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp.commands.identification import Identification, posterior_entries
from sim2gp.commands.result import AbstractResult
from sim2gp.errors import error
from sim2gp.experiment_design import (
    AbstractCommandSignal,
    AbstractGoal,
    DesignResult,
    DOptimal,
    Experiment,
    FreeCommands,
    LimitBox,
    MultisineCommands,
    SubsetDOptimal,
    VOptimal,
    prediction_rows,
)
from sim2gp.experiment_design import optimise_commands as search
from sim2gp.experiment_design.forces import forces_shown, forces_table, not_excited
from sim2gp.experiment_design.limits import SLOW, servo_rates
from sim2gp.experiment_design.verdict import (
    DesignOptions,
    Limits,
    expected_table,
    experiment_verdict,
    prediction_verdict,
)
from sim2gp.identification.forecasts.prediction import channel_units
from sim2gp.identification.identifiability.table import physical_moments
from sim2gp.inference.parameters import unknown_parameter
from sim2gp.inference.prior import ParameterPrior
from sim2gp.models.features import Encoding
from sim2gp.models.sim2gp import PRIOR_NOISE
from sim2gp.project import Project
from sim2gp.project.project import SHORT
from sim2gp.runs import Progress
from sim2gp.runs.provenance import provenance
from sim2gp.systems import one_variant
from sim2gp.systems.base import AbstractSystem, index_of
from sim2gp.types import in_float64

FILE = "trajectory.csv"
PERIOD = 0.01  # s, of commands and samples, where no log says otherwise
LOOSE = 1.0  # rad, m, rad/s or m/s: the sd of a window's start where none is stated


@dataclass(frozen=True, repr=False)
class NextExperiment(AbstractResult):
    """Commands for the machine, the motion to expect, and what it should teach.

    ``save("next.csv")`` writes the commands alone.
    """

    @property
    def commands(self) -> dict[str, np.ndarray]:
        """``time`` (s) and each input, in its unit, a number for each period."""
        start = "design/command/"
        named = {
            name.removeprefix(start): values
            for name, values in self.arrays.items()
            if name.startswith(start)
        }
        return {"time": self.arrays["design/time"][:-1], **named}

    @property
    def expected_sd(self) -> dict[str, float]:
        """Expected sd of each parameter after the experiment, in its unit (plain)."""
        table = self.summary["expected_sd"]
        return {name: float(entry["expected_sd"]) for name, entry in table.items()}

    @property
    def worth_running(self) -> bool:
        """Whether it should narrow what is asked enough to be worth the time."""
        return bool(self.summary["worth_running"])


def design(
    source: Identification | Project,
    *,
    limits: Limits | None = None,
    seconds: float = 10.0,
    kind: Literal["free", "multisine"] = "free",
    about: Sequence[str] = (),
    predict: float | None = None,
    within: float = 2.0,
    start: Mapping[str, float] | None = None,
    period: float | None = None,
    starts: int = 1,
    configuration: str | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> NextExperiment:
    """The next experiment on a machine: its commands, and what it should teach.

    source: what is known, or a project file's priors, where there is no log yet.
    limits: of inputs, states and rates, in addition to the project's.
    seconds: the duration; kind: the family of the commands.
    about: parameters to learn, all if none; predict: learn what predictions so many s
        ahead depend on; within: percent that is known well enough.
    start: where the machine rests before (0); period: of commands, s (the logs').
    starts: random motions that are improved; seed: draws machines and motions.

    Raises `InputError`: E145 for an unknown parameter, E103 for an unknown channel,
    E150 where the limits admit no motion, E151 for a duration shorter than a step.
    """
    began = time.perf_counter()
    asked = DesignOptions(
        seconds, kind, tuple(about), predict, within, limits or Limits(),
        start or {}, period, starts, configuration,
    )  # fmt: skip
    with (progress or Progress()).task("design", 3, alike=False) as task:
        project, experiment, notes = setting(source, asked)
        box = _limit_box(project, experiment, asked.limits, notes)
        key = jax.random.key(seed)
        signal = signal_of(asked.kind, experiment)
        goal = goal_of(asked, experiment, box, jax.random.fold_in(key, 1))
        task.advance("limits and goal")
        found = search(experiment, goal, box, signal, key=key, starts=asked.starts)
        task.advance(f"{found.nats:.1f} nats")
        shown = forces_shown(experiment, found)
        task.advance("forces that may be missing")
    name = source.name
    summary = _design_summary(name, asked, experiment, goal, found, seed)
    if isinstance(source, Identification):
        summary |= widths(source)
    summary |= {"forces_shown": shown}
    summary["tables"] += [forces_table(shown)] if shown else []
    summary["warnings"] = [*notes, *not_excited(shown), *summary.get("warnings", ())]
    return NextExperiment(
        summary | provenance(began),
        _design_arrays(experiment, box, found),
        {FILE: as_csv(experiment, found)},
    )


def _limit_box(
    project: Project, experiment: Experiment, limits: Limits, notes: list[str]
) -> LimitBox:
    """The project's limits and those asked for; ``notes`` gets what is not stated."""
    stated = {name: (low, high) for name, (low, high) in project.spec.limits.items()}
    rates = dict(project.spec.rates) | limits.rates
    slow = servo_rates(experiment.system)
    if slow.keys() - rates.keys():
        notes.append(
            f"no rate is stated of some targets of servos: they cross their range "
            f"in {SLOW:g} s or more"
        )
    box = LimitBox.of(
        experiment.system,
        stated | limits.boxes,
        slow | rates,
        start=np.asarray(experiment.start),
    )
    if not box.stated():
        notes.append("no limit of any position or velocity is stated")
    return box


@in_float64
def setting(
    source: Project | Identification, asked: DesignOptions
) -> tuple[Project, Experiment, list[str]]:
    """The machine and what is believed of it; what the user should know of both."""
    notes: list[str] = []
    corrected = None
    if isinstance(source, Project):
        project, joint = source, source.system
        prior = ParameterPrior(joint.parameters.prior(), joint.parameters)
        belief, names = prior.at_mode(), _measured_channels_of(project)
        noise, period = _stated_noise(project, names), PERIOD
        notes.append("no log was used: what is believed is the project's priors")
    else:
        assert source.project is not None
        project, joint, belief = source.project, source.machine, source.plain
        names, noise = list(source.noise), list(source.noise.values())
        period = source.period
        _, corrected = one_variant(joint, source.posterior, asked.configuration)
    system, belief = one_variant(joint, belief, asked.configuration)
    states = [channel.name for channel in system.physical_states]
    period = asked.period or period
    steps = round(asked.seconds / period)
    if steps < 2:
        got, least = f"{asked.seconds:g} s", f"{period:g}"
        raise error("experiment_too_short", where="--seconds", got=got, period=least)
    stated = project.spec.likelihood
    window = max(2, round((project.window or SHORT) / period))
    sd = stated.start_sd
    each = sd if isinstance(sd, dict) else dict.fromkeys(states, sd or LOOSE)
    experiment = Experiment(
        system,
        belief,
        jnp.asarray(noise, float),
        _start_state(asked.start, system),
        jnp.asarray([each.get(name, LOOSE) for name in states], float),
        tuple(states.index(name) for name in names),
        period,
        steps,
        min(window, steps),
        system.window_substep,
        corrected=corrected,
    )
    return project, experiment, notes


def widths(fit: Identification) -> dict[str, Any]:
    """Which of an identification's two posteriors was used for what."""
    return posterior_entries(fit.summary, "corrected") | {
        "posterior": "Limits of the states and the expected motion are those of the "
        "corrected posterior, information and expected sd those of the plain one"
    }


def signal_of(kind: str, experiment: Experiment) -> AbstractCommandSignal:
    """The family that the commands are chosen from."""
    family = {"multisine": MultisineCommands, "free": FreeCommands}[kind]
    return family(experiment.period, experiment.steps)


def goal_of(
    asked: DesignOptions, experiment: Experiment, limits: LimitBox, key: jax.Array
) -> AbstractGoal:
    """What the experiment is for: all parameters, some, or a prediction."""
    names = experiment.system.parameters.names
    for name in asked.about:
        if name not in names:
            raise unknown_parameter(name, names)
    if asked.predict:
        return VOptimal(prediction_rows(experiment, limits, asked.predict, key))
    if asked.about:
        return SubsetDOptimal(tuple(names.index(name) for name in asked.about))
    return DOptimal()


def _measured_channels_of(project: Project) -> list[str]:
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


def _start_state(given: Mapping[str, float], system: AbstractSystem) -> Any:
    states = system.physical_states
    for name in given:
        index_of(name, states, where="--start")
    return jnp.asarray([given.get(c.name, 0.0) for c in states], float)


@in_float64
def expectation(
    experiment: Experiment, found: DesignResult
) -> dict[str, dict[str, Any]]:
    """Of each parameter: unit, mean and sd now, sd expected after, and their ratio.

    All plain but ``corrected_sd``, today's with the model's errors allowed for.
    """
    table, belief = experiment.system.parameters, experiment.belief
    mean = np.asarray(belief.mean)
    before = physical_moments(table, mean, np.asarray(belief.sd()))
    wide = experiment.plausible
    wider = physical_moments(table, np.asarray(wide.mean), np.asarray(wide.sd()))
    sd = np.sqrt(np.sum(found.scale**2, axis=1))
    after = physical_moments(table, mean, sd)
    return {
        p.name: {
            "unit": p.unit,
            "mean": float(before["mean"][j]),
            "sd": float(before["sd"][j]),
            "corrected_sd": float(wider["sd"][j]),
            "expected_sd": float(after["sd"][j]),
            "of_before": float(after["sd"][j] / before["sd"][j]),
        }
        for j, p in enumerate(table.free)
    }


@in_float64
def _design_summary(
    name: str,
    asked: DesignOptions,
    experiment: Experiment,
    goal: AbstractGoal,
    found: DesignResult,
    seed: int,
) -> dict[str, Any]:
    expected = expectation(experiment, found)
    ahead: dict[str, float] = {}
    if not isinstance(goal, VOptimal):
        worth, reason = experiment_verdict(asked, expected, found.nats)
    else:
        before, after = experiment.belief.scale, jnp.asarray(found.scale)
        ahead = {
            "before": float(goal.deviation(before)),
            "after": float(goal.deviation(after)),
            "corrected": float(goal.deviation(experiment.plausible.scale)),
        }
        worth, reason = prediction_verdict(asked, ahead, found.nats)
    return {
        "command": "design",
        "title": f"{name}: the next experiment",
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
        "units": channel_units(experiment.system),
        "tables": [expected_table(expected)],
    }


def _design_arrays(
    experiment: Experiment, limits: LimitBox, found: DesignResult
) -> dict[str, np.ndarray]:
    system = experiment.system
    arrays = {
        "design/time": experiment.period * np.arange(experiment.steps + 1),
        "design/scale": found.scale,
        "belief/mean": np.asarray(experiment.belief.mean),
    }
    for i, channel in enumerate(system.actions):
        arrays[f"design/command/{channel.name}"] = found.commands[:, i]
        arrays[f"design/limit/{channel.name}"] = _column_bounds(
            limits.low, limits.high, i
        )
    for i, channel in enumerate(system.physical_states):
        for name, values in (
            ("state", found.states),
            ("low", found.low),
            ("high", found.high),
        ):
            arrays[f"design/{name}/{channel.name}"] = values[:, i]
        box = _column_bounds(limits.state_low, limits.state_high, i)
        arrays[f"design/limit/{channel.name}"] = box
    return arrays


def _column_bounds(low: np.ndarray, high: np.ndarray, i: int) -> np.ndarray:
    return np.asarray([low[i], high[i]], float)


def as_csv(experiment: Experiment, found: DesignResult) -> str:
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
