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
from tests.catalogue.bad_project_files import BASE


def load(folder: Path, text: str) -> Project:
    path = folder / "arm.toml"
    path.write_text(text)
    return load_project(path)


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
