"""Project files: what they say is built; what is wrong is named with its line."""

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import payload_arm
from sim2gp.errors import InputError
from sim2gp.inference.parameters import BOX_SD
from sim2gp.project import Project, load_project
from sim2gp.project.source import read_source
from sim2gp.systems.effects.registry import candidates
from sim2gp.systems.machine import Machine
from sim2gp.systems.plants.two_link import TwoLink

BASE = """system = "two_link"

[options]
gravity = 9.81

[parameters.m2]
mean = 0.5
sd = 0.1

[[logs]]
files = ["logs/*.csv"]
time = "time"
exclude = [[12.0, 13.5]]

[logs.columns]
q1 = "pos_meas1"
q2 = {column = "pos_meas2", unit = "rad", sign = 1, offset = 0.0}
torque1 = {column = "tau_con1", scale = 1.0}
torque2 = "tau_con2"

[actuators.torque1]
delay = {low = 0.0, high = 0.02}

[likelihood]
window = 0.2

[limits]
"""


def load(folder: Path, text: str) -> Project:
    path = folder / "arm.toml"
    path.write_text(text)
    return load_project(path)


def refused(folder: Path, text: str) -> str:
    with pytest.raises(InputError) as caught:
        load(folder, text)
    line = str(caught.value)
    assert "\n" not in line
    assert "Fix: " in line
    return line


def with_lines(*lines: str, after: str = "[options]") -> str:
    return BASE.replace(f"{after}\n", "\n".join([after, *lines, ""]))


def test_the_agreed_shape_is_accepted(tmp_path: Path) -> None:
    project = load(tmp_path, BASE)
    assert project.name == "arm"
    system = project.build_system()
    assert isinstance(system, Machine)
    assert isinstance(system.plant, TwoLink)
    assert system.plant.gravity == 9.81
    assert project.spec.likelihood.window == 0.2


def test_older_files_call_viscous_damping_back_emf(tmp_path: Path) -> None:
    more = "\nmean = 0.0\nsd = 0.1\n"
    for what in ("viscous", "back_emf"):
        system = load(tmp_path, f"{BASE}\n[effects.q1.{what}]{more}").build_system()
        assert system.parameters[f"q1.{what}"].sd == 0.1
        assert f"q1.{what}" in system.parameters.names
        names = [c.name for c in candidates(system, windows=True)]
        assert "q1.viscous" not in names
        assert "q2.viscous" in names


def test_a_system_of_ones_own_in_a_project(tmp_path: Path) -> None:
    """Priors, effects and actuators of the file are for the user's system."""
    path = tmp_path / "mine.toml"
    path.write_text(
        'system = "my arm"\n[parameters]\ndamping = 0.05\n'
        "weight = {mean = 1.0, sd = 0.1}\n"
        "[effects.torque]\ndead_zone = 0.1\n"
        "[actuators.torque]\ndelay = {low = 0.0, high = 0.01}\n"
    )
    project = load_project(path, system=payload_arm.arm())
    table = project.system.parameters
    assert table.names == ("inertia", "weight", "payload", "torque.delay")
    known = dict(table.fixed)
    assert (known["damping"], known["torque.dead_zone"]) == (0.05, 0.1)
    assert project.system.longest_delay == 0.01
    path.write_text('system = "my arm"\n[effects.q.spring]\nsd = 0.1\n')
    spring = load_project(path, system=payload_arm.arm()).system.parameters["q.spring"]
    assert (spring.unit, spring.sd) == ("1/s^2", 0.1)
    path.write_text('system = "my arm"\n[effects.q.payload]\nsd = 0.1\n')
    with pytest.raises(InputError, match=r"E145 no payload on this machine.*encoder"):
        load_project(path, system=payload_arm.arm())
    path.write_text('system = "my arm"\n[options]\ngravity = 9.81\n')
    with pytest.raises(InputError, match="E160 unknown option"):
        load_project(path, system=payload_arm.arm())
    with pytest.raises(InputError, match="E160"):
        load_project(path)


def test_moments_become_the_prior(tmp_path: Path) -> None:
    parameter = load(tmp_path, BASE).build_system().parameters["m2"]
    # Log-normal, because a mass is positive: its moments in closed form.
    m, v = parameter.mean, parameter.sd**2
    assert parameter.map == "log"
    assert math.exp(m + v / 2) == pytest.approx(0.5, rel=1e-12)
    variance = math.expm1(v) * math.exp(2 * m + v)
    assert math.sqrt(variance) == pytest.approx(0.1, rel=1e-12)


def test_moments_inside_a_box(tmp_path: Path) -> None:
    text = BASE.replace("sd = 0.1", "sd = 0.1\nlow = 0.2\nhigh = 0.7")
    table = load(tmp_path, text).build_system().parameters
    i = table.names.index("m2")
    z = np.linspace(-8, 8, 4001)
    weight = np.exp(-0.5 * z**2) / np.exp(-0.5 * z**2).sum()
    with jax.enable_x64(True):
        tt = jnp.tile(table.prior().mean, (len(z), 1))
        tt = tt.at[:, i].set(jnp.asarray(table["m2"].mean + table["m2"].sd * z))
        theta = np.asarray(jax.vmap(table.constrain)(tt))[:, i]
    mean = weight @ theta
    assert mean == pytest.approx(0.5, abs=1e-5)
    assert math.sqrt(weight @ (theta - mean) ** 2) == pytest.approx(0.1, abs=1e-5)
    assert theta.min() >= 0.2
    assert theta.max() <= 0.7


def test_box_value_and_number(tmp_path: Path) -> None:
    text = BASE.replace("mean = 0.5\nsd = 0.1", "low = 0.2\nhigh = 0.7\nmap = 'box'")
    text += "[parameters]\nb1 = 0.01\nIr.value = 0.0\n"
    text += "cf1 = {low = 1e-4, high = 1.0}\n"
    table = load(tmp_path, text).build_system().parameters
    box = table["m2"]
    assert (box.map, box.low, box.high) == ("bounded", 0.2, 0.7)
    assert (box.mean, box.sd) == (0.0, BOX_SD)
    assert table["cf1"].map == "log_bounded"  # as the system's own prior
    assert dict(table.fixed)["b1"] == 0.01
    assert dict(table.fixed)["Ir"] == 0.0


def test_actuators_are_free_fixed_or_prior(tmp_path: Path) -> None:
    text = BASE.replace("delay = {", 'gain = "free"\noffset = 0.1\ndelay = {')
    table = load(tmp_path, text).build_system().parameters
    assert {"torque1.gain", "torque1.delay"} <= set(table.names)
    assert (table["torque1.delay"].low, table["torque1.delay"].high) == (0.0, 0.02)
    fixed = dict(table.fixed)
    assert fixed["torque1.offset"] == 0.1
    assert fixed["torque2.gain"] == 1.0
    assert fixed["torque2.delay"] == 0.0
    plain = BASE.replace("[actuators.torque1]\ndelay = {low = 0.0, high = 0.02}", "")
    assert isinstance(load(tmp_path, plain).build_system(), TwoLink)


@pytest.mark.parametrize("system", ["furuta", "cartpole", "cart_pole", "two_link"])
def test_every_system_loads_bare(system: str, tmp_path: Path) -> None:
    project = load(tmp_path, f'system = "{system}"\n')
    assert len(project.build_system().parameters) > 0
    with pytest.raises(InputError, match="E160 no logs"):
        project.load_logs()


SCHEMA_FAULTS: list[tuple[str, str, list[str]]] = [
    (BASE.replace("[likelihood]", "[likelyhood]"), "E160", ["line 24", "likelihood"]),
    (with_lines("gravty = 1"), "E160", ["line 4", "gravty", "mean gravity"]),
    (BASE.replace("sd = 0.1", "sdd = 0.1"), "E160", ["line 8", "did you mean sd"]),
    (BASE.replace("sign = 1", "sgn = 1"), "E160", ["line 17", "did you mean sign"]),
    (BASE.replace("sign = 1", "sign = 2"), "E160", ["line 17", "one of 1 or -1"]),
    (BASE.replace("delay", "dealy"), "E160", ["line 22", "did you mean delay"]),
    (BASE.replace("high = 0.02", "hi = 1"), "E160", ["line 22", "did you mean high"]),
    (BASE.replace("time =", "tiem ="), "E160", ["line 12", "did you mean time"]),
    (BASE.replace('"two_link"', '"twolink"'), "E160", ["line 1", "mean two_link"]),
    (BASE.replace("mean = 0.5", 'mean = "1e-3"'), "E160", ["line 7", "quotes"]),
    (BASE.replace("mean = 0.5", "mean = true"), "E160", ["line 7", "True"]),
    (BASE.replace('["logs/*.csv"]', '"logs"'), "E160", ["line 11", 'files = ["logs"]']),
    (BASE.replace("[[12.0, 13.5]]", "[[1.0]]"), "E160", ["line 13", "exclude"]),
    (BASE.replace("window = 0.2", "window = -1"), "E160", ["line 25", "or equal to 0"]),
    (BASE.replace("window = 0.2", "window = yes"), "E160", ["line 25", "TOML"]),
    (BASE.replace('system = "two_link"', ""), "E160", ["missing key system"]),
    (with_lines('gravity = "9.81"'), "E160", ["twice", "line 5"]),
    (BASE.replace("9.81", '"9.81"'), "E160", ["line 4", "number"]),
    (with_lines("locked = [true]"), "E160", ["line 4", "locked"]),
    (BASE.replace("high = 0.02", "high = inf"), "E141", ["line 22", "finite"]),
    (
        BASE.replace("mean = 0.5", "mean = 0.5\nmean = 1"),
        "E145",
        ["line 8", "duplicate"],
    ),
    (BASE.replace("window", "window = 0.2\nrobust = 1\nx"), "E160", ["robust"]),
]


@pytest.mark.parametrize("case", range(len(SCHEMA_FAULTS)))
def test_faults_of_shape(case: int, tmp_path: Path) -> None:
    text, code, words = SCHEMA_FAULTS[case]
    line = refused(tmp_path, text)
    assert line.startswith(f"{code} ")
    for word in words:
        assert word in line


NAME_FAULTS: list[tuple[str, str, list[str]]] = [
    (BASE.replace("parameters.m2", "parameters.m22"), "E145", ["line 6", "mean m2"]),
    (BASE + "[parameters]\nmm2 = 1.0", "E145", ["line 29", "m2"]),
    (BASE.replace("torque1]", "torqe1]"), "E160", ["line 21", "mean torque1"]),
    (BASE.replace("q1 =", "q_1 ="), "E160", ["line 16", "mean q1"]),
    (BASE.replace('torque2 = "tau_con2"', ""), "E160", ["line 15", "torque2"]),
    (BASE.replace('q1 = "pos_meas1"', "q1 = 1.0"), "E160", ["line 16", "constant"]),
    (BASE.replace("sd = 0.1", "low = 1.0\nhigh = 0.5"), "E141", ["line 6", "swap"]),
    (BASE.replace("sd = 0.1", "low = 1.0\nhigh = 1.0"), "E141", ["value = 1"]),
    (BASE.replace("high = 0.02", "high = -0.1"), "E141", ["line 22", "-0.1"]),
    (BASE.replace("low = 0.0", "low = -0.1"), "E141", ["line 22", "negative delay"]),
    (BASE.replace("sd = 0.1", "sd = 0.1\nlow = 0.6\nhigh = 1"), "E142", ["line 6"]),
    (BASE.replace("sd = 0.1", "sd = 0.0"), "E144", ["line 6"]),
    (BASE.replace("sd = 0.1", ""), "E160", ["line 6", "mean and sd"]),
    (BASE.replace("sd = 0.1", "value = 1.0"), "E160", ["line 6", "value alone"]),
    (BASE.replace("mean = 0.5\nsd = 0.1", ""), "E160", ["line 6", "nothing stated"]),
    (BASE.replace("[[12.0, 13.5]]", "[[2.0, 1.0]]"), "E141", ["line 13", "[2, 1]"]),
    (with_lines("q1 = [1, -1]", after="[limits]"), "E141", ["limits of q1"]),
    (with_lines("q7 = [-1, 1]", after="[limits]"), "E160", ["line 28", "q7"]),
    (with_lines("start_sd.q9 = 1", after="[likelihood]"), "E160", ["line 25", "q9"]),
    (
        BASE.replace("[actuators", "[logs.fixed]\nm3 = 1.0\n[actuators"),
        "E145",
        ["line 22", "m3"],
    ),
]


@pytest.mark.parametrize("case", range(len(NAME_FAULTS)))
def test_faults_of_names_and_values(case: int, tmp_path: Path) -> None:
    text, code, words = NAME_FAULTS[case]
    line = refused(tmp_path, text)
    assert line.startswith(f"{code} ")
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (".".join("a" * 70) + " = 1", "E161"),
        ('system = "import:os"', "E162"),
        ("system = ", "E160"),
        ("{}", "E160"),
    ],
)
def test_hostile_files(text: str, code: str, tmp_path: Path) -> None:
    assert refused(tmp_path, text).startswith(f"{code} ")


def test_binary_project(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"system = \xff")
    with pytest.raises(InputError, match=r"E120 .*byte 9"):
        load_project(path)


TRICKY = '''# [not.a.table]
title = """
[also.not]
x = 1
"""
numbers = [
  1, # a = 2
  [2],
]
"quoted.key" = 1
[a."b c"]
d.e = 'x = "y"' # f = 3
g = {h = 1, i = {j = 2}}
[[list]]
k = 1
[list.sub]
l = 2
[[list]]
k = 3
[[list.inner]]
m = 4
'''


def test_lines_of_keys(tmp_path: Path) -> None:
    path = tmp_path / "tricky.toml"
    path.write_text(TRICKY)
    source = read_source(path)
    expected: dict[tuple[Any, ...], int] = {
        ("title",): 2,
        ("numbers",): 6,
        ("quoted.key",): 10,
        ("a", "b c"): 11,
        ("a", "b c", "d"): 12,
        ("a", "b c", "d", "e"): 12,
        ("a", "b c", "g", "i"): 13,
        ("list", 0): 14,
        ("list", 0, "k"): 15,
        ("list", 0, "sub", "l"): 17,
        ("list", 1, "k"): 19,
        ("list", 1, "inner", 0, "m"): 21,
    }
    for key, line in expected.items():
        assert f":line {line}," in source.where(*key), key
    assert ("x",) not in source.lines
    assert ("also", "not") not in source.lines
    assert source.where("list", 1, "k").endswith("line 19, key list.k")


@given(st.text(alphabet="ab.[]{}=\"\n' #1,", max_size=60))
def test_no_text_breaks_the_reader(tmp_path_factory: Any, text: str) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "a.toml"
    path.write_text(text)
    try:
        source = read_source(path)
    except InputError:
        return  # anything else is a fault of the reader
    for key in source.lines:
        inside: Any = source.values
        for part in key:
            inside = inside[part]


def write_logs(folder: Path) -> None:
    t = 0.01 * np.arange(300)
    table = np.stack([t, np.sin(t), np.cos(2 * t), np.sin(t * t), np.cos(t * t)], 1)
    header = "time,pos_meas1,pos_meas2,tau_con1,tau_con2"
    (folder / "logs").mkdir()
    for name in ("b", "a"):
        path = folder / "logs" / f"{name}.csv"
        np.savetxt(path, table, delimiter=",", header=header, comments="", fmt="%.17g")


def test_logs_are_found_and_read(tmp_path: Path) -> None:
    write_logs(tmp_path)
    project = load(tmp_path, BASE.replace("[[12.0, 13.5]]", "[[1.0, 1.5]]"))
    logs = project.load_logs()
    assert [log.name for log in logs] == ["a[0]", "a[1]", "b[0]", "b[1]"]
    assert set(logs[0].channels) == {"q1", "q2"}
    assert set(logs[0].inputs) == {"torque1", "torque2"}
    again = project.read_logs([tmp_path / "logs" / "b.csv"])
    np.testing.assert_array_equal(again[0].time, logs[2].time)


def test_groups_differ_and_files_are_read_once(tmp_path: Path) -> None:
    write_logs(tmp_path)
    text = (tmp_path / "logs" / "a.csv").read_text()
    (tmp_path / "heavy").mkdir()
    renamed = text.replace("pos_meas1,pos_meas2", "p1,p2", 1)
    (tmp_path / "heavy" / "a.csv").write_text(renamed)
    second = """[[logs]]
files = ["heavy/a.csv"]
fixed = {m2 = 0.7}
[logs.columns]
q1 = "p1"
torque1 = "tau_con1"
torque2 = 0.0
"""
    project = load(tmp_path, BASE.replace("exclude", "# exclude") + second)
    logs = project.load_logs()
    assert [log.name for log in logs] == ["logs/a", "b", "heavy/a"]
    assert [log.group for log in logs] == [0, 0, 1]
    assert logs[2].fixed == {"m2": 0.7}
    (other,) = project.read_logs([tmp_path / "heavy" / "a.csv"])
    assert (other.group, set(other.channels)) == (1, {"q1"})
    twice = load(tmp_path, BASE + second.replace("heavy/a", "logs/a"))
    with pytest.raises(InputError, match="E160 file listed twice"):
        twice.load_logs()


def test_a_copied_project_file_still_loads(tmp_path: Path) -> None:
    """A run keeps the text of its project; the logs need not be there."""
    project = load(tmp_path, BASE)
    copy = tmp_path / "elsewhere" / "project.toml"
    copy.parent.mkdir()
    copy.write_text(project.source.text)
    again = load_project(copy)
    assert again.spec == project.spec
    assert again.build_system().parameters == project.build_system().parameters
