"""Robots of others: are hidden constants of models from dm_control recovered?

    python benchmarks/robots.py [--models FOLDER] [--draws N] [--workers N] [--out DIR]
        [--refresh | --keep-old]

The cart-pole, acrobot and reacher (an arm) of the suite of dm_control; their files are
looked for where dm_control is installed, or in FOLDER. For each draw their constants
are drawn from the project's priors, two recordings of ten seconds are made by C MuJoCo
with noisy encoders and no velocities, and the project is fitted as `sim2gp identify`
fits it. Hidden as well: an encoder's offset (cart-pole), a delay (acrobot), motors that
are alike and three pushes that nobody recorded (reacher). Coverage of nominal 95 %, and
the median error of constants that are identified. Finished cells are kept.
"""

import argparse
import functools
import json
import sys
import tempfile
import time
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from sim2gp.commands.window_length import fit_chosen_windows
from sim2gp.data.windows_likelihood import likelihood_of
from sim2gp.errors import InputError, NotConverged, NotFinite
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.project import Project, load_project
from sim2gp.runs.cells import Cells, add_options
from sim2gp.runs.executors import Processes, cores
from sim2gp.systems import plant_of
from sim2gp.types import in_float64

SECONDS, HOLD, NOISE = 10.0, 0.1, 1e-3  # s, s, rad or m
Z = 1.96
#: A constant is identified where its sd is so small a share of the prior's.
IDENTIFIED = 0.2


@dataclass(frozen=True)
class Robot:
    """A model's file, what is open of it, and where it starts."""

    file: str
    project: str
    columns: dict[str, str]  # channel: column
    start: tuple[float, ...]
    push: float = 0.0  # of three unrecorded pushes, N m
    centred: float = 0.0  # share of the input, per m, rad and s, that keeps off stops

    @property
    def arguments(self) -> dict[str, Any]:
        """All that a cell depends on."""
        return {**vars(self), "seconds": SECONDS, "hold": HOLD, "noise": NOISE}


ROBOTS = {
    "cart-pole": Robot(
        "cartpole.xml",
        """
[parameters."joint/*/damping"]
low = 0.001
high = 0.1
[parameters."body/*/mass"]
relative_sd = 0.3
[effects.hinge_1.encoder]
mean = 0.0
sd = 0.05
""",
        {"slider": "x", "hinge_1": "theta", "slide": "u"},
        (0.0, 2.5),
        centred=0.4,
    ),
    "acrobot": Robot(
        "acrobot.xml",
        """
[parameters."joint/*/damping"]
relative_sd = 0.7
[parameters."body/lower_arm/mass"]
relative_sd = 0.3
[parameters."actuator/elbow/gear"]
relative_sd = 0.3
[actuators."elbow.control"]
delay = {low = 0.0, high = 0.04}
""",
        {"shoulder": "q1", "elbow": "q2", "elbow.control": "u"},
        (3.0, 0.3),
    ),
    "reacher": Robot(
        "reacher.xml",
        """
[parameters."joint/*/damping"]
relative_sd = 0.5
[parameters."body/hand/mass"]
relative_sd = 0.3
[parameters."actuator/*/gear"]
tie = true
relative_sd = 0.3
[likelihood]
robust = true
""",
        {
            "shoulder": "q1",
            "wrist": "q2",
            "shoulder.control": "u1",
            "wrist.control": "u2",
        },
        (0.0, 0.3),
        push=0.02,
        centred=0.3,
    ),
}


class Job(NamedTuple):
    robot: str
    draw: int
    models: Path
    out: Path

    @property
    def name(self) -> str:
        """Of its cell."""
        return f"{self.robot}_{self.draw}"

    @property
    def arguments(self) -> dict[str, Any]:
        """What its cell rests on."""
        return ROBOTS[self.robot].arguments


@in_float64
def work(job: Job) -> dict[str, Any]:
    """One hidden robot: errors and sds in virtual values, and the constants."""
    robot, rng = ROBOTS[job.robot], np.random.default_rng(job.draw)
    project = loaded(job.robot, job.models)
    with tempfile.TemporaryDirectory() as folder:
        table = project.system.parameters
        prior = table.prior()
        tt = np.asarray(prior.mean) + np.asarray(prior.scale) @ rng.standard_normal(
            len(table)
        )
        step = plant_of(project.system).engine.model.opt.timestep
        late = {n: step * rng.integers(1, 4) for n in table.names if "delay" in n}
        at = [table.names.index(name) for name in late]
        tt[at] = [table[name].unconstrain(late[name]) for name in late]
        truth = {k: float(v) for k, v in table.values(jax.numpy.asarray(tt)).items()}
        for k in range(2):
            record(robot, project.system, truth, rng, Path(folder, f"{k}.csv"))
        started = time.perf_counter()
        logs = project.read_logs(sorted(Path(folder).iterdir()))
        key = jax.random.key(job.draw)
        try:
            chosen = fit_chosen_windows(project, logs, key=key)
        except (NotConverged, NotFinite) as error:
            return {"failed": str(error)}
        used, (windows, places, _), belief = chosen.fit
        likelihood = likelihood_of(project.system, windows)
        mine = corrected_windows(at_zero(likelihood, belief, places[:, 0])).posterior
        seconds = time.perf_counter() - started
    found = table.values(mine.mean)
    return {
        "names": list(table.names),
        "window": used.window,
        "seconds": seconds,
        "prior_sd": np.asarray(prior.sd()).tolist(),
        "error": (np.asarray(belief.posterior.mean) - tt).tolist(),
        "sd": np.asarray(belief.posterior.sd()).tolist(),
        "error_corrected": (np.asarray(mine.mean) - tt).tolist(),
        "sd_corrected": np.asarray(mine.sd()).tolist(),
        "truth": [truth[n] for n in table.names],
        "found": [float(found[n]) for n in table.names],
    }


@functools.cache
def loaded(robot: str, models: Path) -> Project:
    """The project of a robot; one simulator is one compiled program."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "robot.toml")
        path.write_text(project_text(ROBOTS[robot], models))
        return load_project(path)


def project_text(robot: Robot, models: Path) -> str:
    """The project file of a robot."""
    columns = "\n".join(f'"{name}" = "{c}"' for name, c in robot.columns.items())
    return (
        f'system = "{models / robot.file}"\n{robot.project}'
        f'[[logs]]\nfiles = ["*.csv"]\n[logs.columns]\n{columns}\n'
    )


def record(
    robot: Robot, system: Any, truth: dict[str, float], rng: Any, path: Path
) -> None:
    """Ten seconds of C MuJoCo with these constants, as a file."""
    import mujoco

    inner = plant_of(system)
    model = inner.engine.with_values(np.array([truth[n] for n in inner.names]))
    data = mujoco.MjData(model)
    data.qpos[:] = robot.start + 0.3 * rng.standard_normal(model.nq)
    step, count = model.opt.timestep, round(SECONDS / model.opt.timestep)
    every = round(HOLD / step)
    low, high = model.actuator_ctrlrange.T
    held = rng.uniform(low, high, (count // every + 1, model.nu))
    command = np.repeat(held, every, axis=0)
    delay = [round(truth.get(f"{c.name}.delay", 0.0) / step) for c in system.actions]
    zero = np.array([truth.get(f"{c.name}.encoder", 0.0) for c in system.states])
    pushed = rng.integers(0, count, 3) if robot.push else []
    rows = []
    for k in range(count):
        seen = data.qpos - zero[: model.nq] + NOISE * rng.standard_normal(model.nq)
        away = (data.qpos + data.qvel)[: model.nu]
        command[k] = np.clip(command[k] - robot.centred * away, low, high)
        rows.append([data.time, *seen, *command[k]])
        for i, d in enumerate(delay):
            data.ctrl[i] = command[max(k - d, 0), i]
        near = any(0 <= k - p < round(0.06 / step) for p in pushed)
        data.qfrc_applied[0] = robot.push * near
        mujoco.mj_step(model, data)
    names = [
        n for c, n in robot.columns.items() if c in [s.name for s in system.states]
    ]
    inputs = [robot.columns[c.name] for c in system.actions]
    header = ",".join(["time", *names, *inputs])
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.12g")


def table(cells: list[dict[str, Any]]) -> dict[str, Any]:
    """Of each constant: coverage, share of draws that identify it, median error."""
    fitted = [cell for cell in cells if "failed" not in cell]
    get = {key: np.array([cell[key] for cell in fitted]) for key in fitted[0]}
    out = {}
    for j, name in enumerate(fitted[0]["names"]):
        known = get["sd_corrected"][:, j] <= IDENTIFIED * get["prior_sd"][:, j]
        truth, found = get["truth"][:, j], get["found"][:, j]
        error = np.abs(found - truth) / np.abs(truth)
        out[name] = {
            "coverage": _inside(get, "_corrected", j),
            "coverage_plain": _inside(get, "", j),
            "identified": float(known.mean()),
            "median_error": float(np.median(error[known])) if known.any() else None,
        }
    seconds = float(np.median(get["seconds"]))
    lengths, counts = np.unique(get["window"], return_counts=True)
    return {
        "constants": out,
        "windows": dict(zip(map(str, lengths), counts.tolist(), strict=True)),
        "seconds": seconds,
        "failed": len(cells) - len(fitted),
    }


def _inside(get: dict[str, np.ndarray], which: str, j: int) -> float:
    error, sd = get[f"error{which}"][:, j], get[f"sd{which}"][:, j]
    return float(np.mean(np.abs(error) <= Z * sd))


def models_of_dm_control() -> Path:
    """The folder of the suite's files."""
    spec = find_spec("dm_control")
    if spec is None or spec.origin is None:
        fix = "pip install dm_control, or give --models"
        raise InputError("E135", "dm_control is not installed", fix=fix)
    return Path(spec.origin).parent / "suite"


def lines(summary: dict[str, Any]) -> list[str]:
    """The table of docs/mujoco.md."""
    out = []
    for robot, entry in summary["robots"].items():
        lengths = entry["windows"].items()
        out += [
            "",
            f"{robot}: {summary['draws']} draws, {entry['seconds']:.0f} s a fit; "
            + ", ".join(f"{n} with windows of {s} s" for s, n in lengths),
        ]
        head = f"{'':32s}{'coverage':>9s}{'plain':>7s}{'identified':>11s}{'error':>8s}"
        out.append(head)
        for name, x in entry["constants"].items():
            error = "-" if x["median_error"] is None else f"{x['median_error']:.2%}"
            out.append(
                f"{name:32s}{x['coverage']:9.3f}{x['coverage_plain']:7.3f}"
                f"{x['identified']:11.0%}{error:>8s}"
            )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=Path, default=None)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("--out", type=Path, default=Path("results/robots"))
    add_options(parser)
    options = parser.parse_args()
    models = (options.models or models_of_dm_control()).resolve()
    draws = range(options.draws)
    cells, groups = Cells(options.out, __file__, options.old), []
    found: dict[Job, dict[str, Any]] = {}
    every = [Job(name, d, models, options.out) for name in ROBOTS for d in draws]
    cells.check(named := [(job.name, job.arguments) for job in every])
    for name in ROBOTS:
        jobs = [job for job in every if job.robot == name]
        done = {job: cells.load(job.name, job.arguments) for job in jobs}
        found |= {job: values for job, values in done.items() if values is not None}
        groups.append([job for job in jobs if done[job] is None])
    for job, values in Processes(options.workers).spread(work, groups):
        found[job] = cells.save(job.name, job.arguments, values)
        print(f"{len(found)}/{len(every)}", end="\r", file=sys.stderr)
    summary: dict[str, Any] = {"draws": options.draws, **cells.summary(named)}
    summary["robots"] = {
        name: table([found[job] for job in every if job.robot == name])
        for name in ROBOTS
    }
    text = "\n".join(lines(summary))
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.txt").write_text(text.lstrip() + "\n")
    (options.out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")


if __name__ == "__main__":
    main()
