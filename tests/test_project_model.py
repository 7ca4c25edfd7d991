"""A model's file as the machine of a project: patterns, ties, priors, faults."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.errors import InputError
from sim2gp.project import load_project

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0" damping=".05"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="1"/>
    <body name="lower" pos="0 0 -.4">
      <joint name="elbow" axis="0 1 0" damping=".02"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/>
    </body>
  </body></worldbody>
  <actuator><motor name="push" joint="shoulder" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
LOGS = """
[[logs]]
files = ["*.csv"]
[logs.columns]
shoulder = "q1"
elbow = "q2"
push = "u"
"""


def project(folder: Path, text: str) -> Path:
    (folder / "arm.xml").write_text(MODEL)
    path = folder / "arm.toml"
    path.write_text('system = "arm.xml"\n' + text + LOGS)
    return path


def test_patterns_open_constants_and_ties_make_them_one(tmp_path: Path) -> None:
    text = """
[parameters."joint/*/damping"]
tie = true
relative_sd = 0.5
[parameters."body/*/mass"]
relative_sd = 0.1
[parameters]
"actuator/push/gear" = 2.5
"""
    system = load_project(project(tmp_path, text)).system
    table = system.parameters
    names = ("joint/shoulder/damping", "body/upper/mass", "body/lower/mass")
    assert table.names == names
    assert dict(table.fixed) == {"actuator/push/gear": 2.5}
    for name, mean, sd in zip(names, (0.05, 1.0, 0.5), (0.025, 0.1, 0.05), strict=True):
        rng = np.random.default_rng(0)
        p = table[name]
        draws = [p.constrain(x) for x in p.mean + p.sd * rng.standard_normal(800)]
        assert np.mean(draws) == pytest.approx(mean, rel=0.1)
        assert np.std(draws) == pytest.approx(sd, rel=0.1)
    assert (table["body/upper/mass"].low, table["body/upper/mass"].unit) == (0.0, "kg")


def test_a_path_is_the_exception_to_a_pattern(tmp_path: Path) -> None:
    text = """
[parameters."joint/*/damping"]
tie = true
[parameters."joint/elbow/damping"]
value = 0.3
"""
    system = load_project(project(tmp_path, text)).system
    assert system.parameters.names == ("joint/shoulder/damping",)
    assert dict(system.parameters.fixed) == {"joint/elbow/damping": 0.3}
    text = '[parameters]\n"joint/*/damping" = 1.0\n"joint/s*/damping" = 2.0\n'
    with pytest.raises(InputError, match=r"E145 a constant named twice.*line 2"):
        load_project(project(tmp_path, text))


def test_without_mujoco_the_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InputError, match=r"E135.*pip install 'sim2gp\[mujoco\]'"):
        load_project(project(tmp_path, ""))


def test_without_parameters_all_usual_ones_are_open(tmp_path: Path) -> None:
    names = load_project(project(tmp_path, "")).system.parameters.names
    assert {n.split("/")[-1] for n in names} == {"damping", "mass", "gain"}
    assert len(names) == 5


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('[parameters."joint/wrist/damping"]\nmean = 1.0\nsd = 0.1', "E170.*line 3"),
        ('[parameters."joint/*/frictionloss"]\ntie = true', "E160.*line 3"),
        ('[parameters."joint/*/stiffness"]\nrelative_sd = 0.1', "E160.*relative_sd"),
        ("[options]\ngravity = 9.8", "E160 unknown option.*line 4.*root"),
        ("[effects.shoulder.spring]\nmean = 0.0\nsd = 1.0", "E160 unknown table"),
        ("[limits]\nwrist = [0.0, 1.0]", "E160 unknown channel.*line 4"),
    ],
)
def test_faults_name_their_line(tmp_path: Path, text: str, fault: str) -> None:
    with pytest.raises(InputError, match=fault):
        load_project(project(tmp_path, "\n" + text))


def test_a_tie_is_for_files(tmp_path: Path) -> None:
    path = tmp_path / "p.toml"
    path.write_text('system = "furuta"\n[parameters.arm_mass]\ntie = true\n' + LOGS)
    with pytest.raises(InputError, match=r"E160 unknown option.*line 2.*tie"):
        load_project(path)


def test_a_model_that_is_not_there_is_said_with_its_line(tmp_path: Path) -> None:
    path = project(tmp_path, "")
    (tmp_path / "arm.xml").unlink()
    with pytest.raises(InputError, match=r"E130 cannot read .*arm\.xml"):
        load_project(path)


def test_identify_from_a_file_and_logs(tmp_path: Path, capsys) -> None:
    """Two constants that were changed, behind a delay; positions alone are measured."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.dof_damping[:] = 0.08
    model.actuator_gear[0, 0] = 1.7
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows, u = [], np.repeat(rng.uniform(-1.0, 1.0, 20), 20)
    for i in range(400):
        rows.append([data.time, *(data.qpos + 1e-3 * rng.standard_normal(2)), u[i]])
        data.ctrl[0] = u[i - 2] if i >= 2 else 0.0  # 10 ms late
        mujoco.mj_step(model, data)
    names = "time,q1,q2,u"
    np.savetxt(tmp_path / "a.csv", rows, delimiter=",", header=names, comments="")
    text = """
[parameters."joint/*/damping"]
tie = true
relative_sd = 1.0
[parameters."actuator/push/gear"]
relative_sd = 0.3
[actuators.push]
delay = {low = 0.0, high = 0.02}
"""
    path = project(tmp_path, text)
    assert main(["identify", str(path), "--out", str(tmp_path / "run"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    truth = {
        "joint/shoulder/damping": 0.08,
        "actuator/push/gear": 1.7,
        "push.delay": 0.01,
    }
    assert set(summary["parameters"]) == set(truth)
    for name, value in truth.items():
        found = summary["parameters"][name]
        assert abs(found["mean"] - value) < 4.0 * found["sd"], name
        assert found["verdict"] == "identified"
        assert found["sd"] < 0.1 * value
