"""For each key of a project file, two files that differ in it alone, and what sees it.

Commands make four things of a project: the machine with its priors, the logs, the
windows that are fitted, and the limits of an experiment.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from sim2gp.commands import design, explain
from sim2gp.project import load_project
from sim2gp.project.project import Project
from sim2gp.runs.progress import Progress
from tests.catalogue.bad_inputs import HEADER, ROWS, table, text

GROUP = """[[logs]]
files = ["a.csv"]
time = "t"
columns = {x = "pos", theta = "angle", voltage = "cmd"}
"""
ARM = """<mujoco><worldbody><body name="upper">
<joint name="shoulder" axis="0 1 0" damping=".05"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="1"/>
<body name="lower" pos="0 0 -.4"><joint name="elbow" axis="0 1 0" damping=".02"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/></body></body>
</worldbody><actuator><motor name="push" joint="shoulder"/></actuator></mujoco>"""


# ------------------------------------------------------------------ what is observed


def machine(project: Project, patch: pytest.MonkeyPatch) -> str:
    """Options, effects, actuators, and the table of constants with their priors."""
    return repr(project.build_system())


def logs(project: Project, patch: pytest.MonkeyPatch) -> str:
    """All that was read, and what is said of it."""
    with np.printoptions(threshold=10**6, precision=17):
        return repr(project.load_logs())


def windows(project: Project, patch: pytest.MonkeyPatch) -> str:
    """What `explain` fits to, as `identify` does."""
    found = explain.window_data(project, project.load_logs(alike=True))
    with np.printoptions(threshold=10**6, precision=17):
        leaves = [
            np.asarray(leaf) for leaf in jax.tree.leaves(found.cut(project.system))
        ]
        return repr((leaves, found.robust))


class Reached(Exception):
    """The search of `sim2gp design` would begin now."""


def experiment(project: Project, patch: pytest.MonkeyPatch) -> str:
    """What `sim2gp design` searches within."""

    def reached(experiment: Any, goal: Any, limits: Any, *_: Any, **__: Any) -> None:
        raise Reached(repr(jax.tree.leaves(limits)))

    patch.setattr(design, "search", reached)
    with pytest.raises(Reached) as found:
        design.design(project, seconds=1.0, progress=Progress(quiet=True))
    return str(found.value)


Observe = Callable[[Project, pytest.MonkeyPatch], str]
Change = tuple[str, str, Observe]


# -------------------------------------------------------------- a change of each key


def of_priors(place: str) -> dict[str, Change]:
    """Both files for each key of a prior."""
    pairs = {
        "value": ("value = 0.011", "value = 0.012"),
        "mean": ("mean = 0.011, sd = 0.002", "mean = 0.012, sd = 0.002"),
        "sd": ("mean = 0.011, sd = 0.002", "mean = 0.011, sd = 0.003"),
        "relative_sd": (
            "mean = 0.01, relative_sd = 0.1",
            "mean = 0.01, relative_sd = 0.2",
        ),
        "low": ("low = 0.001, high = 0.02", "low = 0.002, high = 0.02"),
        "high": ("low = 0.001, high = 0.02", "low = 0.001, high = 0.03"),
        "map": (
            'low = 0.001, high = 0.02, map = "bounded"',
            'low = 0.001, high = 0.02, map = "log_bounded"',
        ),
    }
    section, name = place.split("] ")
    # A delay needs an end, because the inputs before a window reach back so far.
    bounds = "low = 0.0, high = 0.1, " if name == "delay" else ""
    return {
        key: tuple(  # type: ignore[misc]
            [
                f"{section}]\n{name} = {{{bounds if 'mean' in said else ''}{said}}}\n"
                for said in pair
            ]
            + [machine]
        )
        for key, pair in pairs.items()
    }


def changed_priors() -> dict[str, Change]:
    places = {
        "parameters.*": "[parameters] cart_mass",
        "effects.*.*": "[effects.x] spring",
    }
    places |= {
        f"actuators.*.{part}": f"[actuators.voltage] {part}"
        for part in ("gain", "offset", "delay")
    }
    return {
        f"{path}.{key}": change
        for path, place in places.items()
        for key, change in of_priors(place).items()
    }


def log_with(line: str, other: str, observe: Observe = logs) -> Change:
    """Two groups of logs that differ in one line."""
    return tuple(  # type: ignore[return-value]
        [GROUP.replace('time = "t"\n', f"{said}\n") for said in (line, other)]
        + [observe]
    )


def clock_with(said: str) -> Change:
    return log_with('time = {column = "t"}', f'time = {{column = "t", {said}}}')


def column_with(said: str) -> Change:
    plain = GROUP.replace('theta = "angle"', 'theta = {column = "angle"}')
    return (
        plain,
        GROUP.replace('theta = "angle"', f'theta = {{column = "angle", {said}}}'),
        logs,
    )


def resampled(said: str, other: str) -> Change:
    stream = """[[logs]]
files = ["a.mcap"]
resample = {%s}
columns = {theta = "/arm/q", voltage = "/cmd/u"}
"""
    return stream % said, stream % other, logs


def with_group(before: str, after: str, observe: Observe) -> Change:
    return before + GROUP, after + GROUP, observe


TWO = GROUP.replace("[[logs]]\n", '[[logs]]\nname = "one"\n')
WEIGHED = """[[weighed]]
of = ["cart_mass", "pole_mass"]
weights = [1.0, 2.0]
value = 0.7
sd = 0.01
"""
CHANGES: dict[str, Change] = {
    "system": ("", 'system = "furuta"\n', machine),
    "options": ("", "[options]\ngravity = 9.0\n", machine),
    "parameters.*": ("", "[parameters]\ncart_mass = 0.4\n", machine),
    "parameters.*.tie": (
        'system = "arm.xml"\n[parameters."joint/*/damping"]\n',
        'system = "arm.xml"\n[parameters."joint/*/damping"]\ntie = true\n',
        machine,
    ),
    "effects.*.*": ("", "[effects.x]\nspring = 1.0\n", machine),
    "effects.*.*.width": (
        "[effects.x.coulomb]\nmean = 0.0\nsd = 1.0\n",
        "[effects.x.coulomb]\nmean = 0.0\nsd = 1.0\nwidth = 0.2\n",
        machine,
    ),
    "effects.*.*.speed": (
        "[effects.x.stribeck]\nmean = 0.0\nsd = 1.0\n",
        "[effects.x.stribeck]\nmean = 0.0\nsd = 1.0\nspeed = 0.2\n",
        machine,
    ),
    "effects.*.*.points": (
        "[effects.x.position_table]\npoints = [[-1.0, 0.0], [1.0, 0.0]]\n",
        "[effects.x.position_table]\npoints = [[-1.0, 2.0], [1.0, -2.0]]\n",
        machine,
    ),
    "effects.*.*.smoothing": (
        "[effects.voltage.dead_zone]\nmean = 0.0\nsd = 1.0\n",
        "[effects.voltage.dead_zone]\nmean = 0.0\nsd = 1.0\nsmoothing = 0.2\n",
        machine,
    ),
    "weighed.of": (
        WEIGHED,
        WEIGHED.replace('cart_mass"', 'pole_half_length"'),
        machine,
    ),
    "weighed.weights": (WEIGHED, WEIGHED.replace("2.0", "3.0"), machine),
    "weighed.value": (WEIGHED, WEIGHED.replace("0.7", "0.8"), machine),
    "weighed.sd": (WEIGHED, WEIGHED.replace("0.01", "0.02"), machine),
    "logs.files": (GROUP, GROUP.replace("a.csv", "b.csv"), logs),
    "logs.name": (
        TWO + TWO.replace("a.csv", "b.csv"),
        TWO + TWO.replace("a.csv", "b.csv").replace("one", "two"),
        logs,
    ),
    "logs.time": log_with('time = "t"', 'time = "t_odd"'),
    "logs.time.column": log_with('time = {column = "t"}', 'time = {column = "t_odd"}'),
    "logs.time.unit": clock_with('unit = "ms"'),
    "logs.time.sign": (
        *log_with('time = {column = "down", sign = -1}', 'time = "t"')[:2],
        logs,
    ),
    "logs.time.scale": clock_with("scale = 2.0"),
    "logs.time.offset": clock_with("offset = 1.0"),
    "logs.period": log_with("period = 0.01", "period = 0.02"),
    "logs.episode": log_with('time = "t"', 'time = "t"\nepisode = "run"'),
    "logs.resample.method": resampled('method = "linear"', 'method = "hold"'),
    "logs.resample.period": resampled("period = 0.01", "period = 0.02"),
    "logs.resample.stamps": resampled('stamps = "/arm"', 'stamps = "/cmd"'),
    "logs.keep_first": (
        GROUP.replace("a.csv", "twice.csv"),
        GROUP.replace('["a.csv"]', '["twice.csv"]\nkeep_first = true'),
        logs,
    ),
    "logs.exclude": log_with('time = "t"', 'time = "t"\nexclude = [[1.0, 1.5]]'),
    "logs.columns.*": (GROUP, GROUP.replace('"cmd"', "1.5"), logs),
    "logs.columns.*.column": (
        GROUP.replace('voltage = "cmd"', 'voltage = {column = "cmd"}'),
        GROUP.replace('voltage = "cmd"', 'voltage = {column = "run"}'),
        logs,
    ),
    "logs.columns.*.unit": column_with('unit = "deg"'),
    "logs.columns.*.sign": column_with("sign = -1"),
    "logs.columns.*.scale": column_with("scale = 2.0"),
    "logs.columns.*.offset": column_with("offset = 0.1"),
    "logs.columns.*.saturation": column_with("saturation = [-0.5, 0.5]"),
    "logs.fixed.*": log_with(
        'time = "t"\nfixed = {cart_mass = 0.3}',
        'time = "t"\nfixed = {cart_mass = 0.4}',
        machine,
    ),
    "logs.free": log_with('time = "t"', 'time = "t"\nfree = ["cart_mass"]', machine),
    "logs.drop_nonfinite": (
        GROUP.replace("a.csv", "holes.csv"),
        GROUP.replace('["a.csv"]', '["holes.csv"]\ndrop_nonfinite = true'),
        logs,
    ),
    "actuators.*.gain": ("", "[actuators.voltage]\ngain = 0.9\n", machine),
    "actuators.*.offset": ("", "[actuators.voltage]\noffset = 0.1\n", machine),
    "actuators.*.delay": ("", '[actuators.voltage]\ndelay = "free"\n', machine),
    "actuators.*.tie": (
        'system = "two_link"\n[actuators."torque*"]\ndelay = "free"\n',
        'system = "two_link"\n[actuators."torque*"]\ndelay = "free"\ntie = true\n',
        machine,
    ),
    "likelihood.window": with_group("", "[likelihood]\nwindow = 0.1\n", windows),
    "likelihood.start": with_group("", '[likelihood]\nstart = "causal"\n', windows),
    "likelihood.robust": with_group("", "[likelihood]\nrobust = true\n", windows),
    "likelihood.start_sd": with_group("", "[likelihood]\nstart_sd = 0.5\n", windows),
    "likelihood.start_sd.*": with_group(
        "[likelihood]\nstart_sd = {x = 0.5}\n",
        "[likelihood]\nstart_sd = {x = 0.6}\n",
        windows,
    ),
    "likelihood.noise_floor": with_group(
        "", "[likelihood]\nnoise_floor = 0.5\n", windows
    ),
    "likelihood.noise_floor.*": with_group(
        "[likelihood]\nnoise_floor = {x = 0.5}\n",
        "[likelihood]\nnoise_floor = {x = 0.6}\n",
        windows,
    ),
    "limits.*": with_group("", "[limits]\nx = [-0.1, 0.1]\n", logs),
    "rates.*": with_group("", "[rates]\nvoltage = 3.0\n", experiment),
    **changed_priors(),
}
#: Of an input, limits are the experiment's.
ALSO: dict[str, Change] = {
    "limits of an input": with_group(
        "", "[limits]\nvoltage = [-1.0, 2.0]\n", experiment
    ),
    "a column of the commands": (
        GROUP.replace('"cmd"', '{column = "cmd"}'),
        GROUP.replace('"cmd"', '{column = "cmd", saturation = [-0.5, 0.5]}'),
        logs,
    ),
}
#: A clock is a column as well, but for this.
REFUSED = {"logs.time.saturation": clock_with("saturation = [0.0, 9.0]")[1]}


def write_files(folder: Path) -> None:
    """Logs of each kind, and a model."""
    rows = table()
    run = np.repeat([0.0, 1.0], ROWS // 2)
    odd = rows[:, 0] + 0.001 * np.sin(rows[:, 0])
    more = np.column_stack([rows, run, odd, -rows[:, 0]])
    header = f"{HEADER},run,t_odd,down"
    (folder / "a.csv").write_text(text(more, header))
    (folder / "b.csv").write_text(text(more[:200], header))
    twice = more.copy()
    twice[100, 0] = twice[99, 0]
    (folder / "twice.csv").write_text(text(twice, header))
    holes = more.copy()
    holes[100, 3] = np.nan
    (folder / "holes.csv").write_text(text(holes, header))
    (folder / "arm.xml").write_text(ARM)


def loaded(folder: Path, said: str) -> Project:
    path = folder / "project.toml"
    plain = "" if said.startswith("system") else 'system = "cartpole"\n'
    path.write_text(plain + said)
    return load_project(path)
