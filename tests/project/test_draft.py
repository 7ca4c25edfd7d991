"""`sim2gp init`: columns by names and rates, readings by what the machine explains."""

import json
from pathlib import Path

import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands.example import example
from sim2gp.commands.init import init
from sim2gp.data.logs import Column, Log
from sim2gp.data.split_log import cut
from sim2gp.errors import InputError
from sim2gp.project import load_project
from sim2gp.project.columns import match, time_column, unit_in, words_of
from sim2gp.systems import MuJoCo
from sim2gp.systems.base import Channel

T = np.arange(0.0, 4.0, 0.01)
Q = {k: np.sin(w * T) + 0.2 * np.sin(3.1 * w * T) for k, w in ((1, 2.0), (2, 3.3))}
V = {k: np.gradient(q, T) for k, q in Q.items()}
U = {k: np.sign(np.sin(5.0 * k * T)) for k in (1, 2)}


def joints(*names: str, unit: str = "rad") -> list[Channel]:
    return [
        *(Channel(name, unit, angle=True) for name in names),
        *(Channel(f"{name}.velocity", f"{unit}/s") for name in names),
    ]


def test_words_and_units_of_names() -> None:
    assert words_of("pos_meas1") == ("pos", "meas", "1")
    assert words_of("motorTorque [N m]") == ("motor", "torque")
    assert words_of("observation.state[0]") == ("observation", "state", "0")
    units = {"q [deg]": "deg", "t_ms": "ms", "speed (rpm)": "rpm", "tau (Nm)": "N m"}
    assert {name: unit_in(name) for name in units} == units
    assert unit_in("pos_m1") is None
    assert unit_in("state[0]") is None


@pytest.mark.parametrize(
    ("name", "scale", "unit"),
    [
        ("t", 1.0, None),
        ("t", 1e3, "ms"),
        ("stamp", 1e9, "ns"),
        ("time [ms]", 1e3, "ms"),
    ],
)
def test_time_by_name_and_step(name: str, scale: float, unit: str | None) -> None:
    columns = {"count": np.arange(400.0), "u": U[1], name: 7.0 + scale * T}
    assert time_column(columns, "").column == Column(name, unit)


def test_columns_by_names_and_rates() -> None:
    columns = {
        "pos_des1": Q[1] + 0.1,
        "pos_meas1": Q[1],
        "pos_meas2": Q[2],
        "vel_meas1": V[1],
        "vel_meas2": V[2],
        "tau_meas1": U[1],
        "tau_cmd1": U[1],
        "tau_cmd2": U[2],
        "tau_fric2": 0.0 * T,
    }
    machine = joints("shoulder", "elbow")
    inputs = [Channel("shoulder.motor", "N m"), Channel("elbow.motor", "N m")]
    found = match(columns, T, machine, inputs, "")
    assert {name: m.column.column for name, m in found.items()} == {
        "shoulder": "pos_meas1",
        "elbow": "pos_meas2",
        "shoulder.velocity": "vel_meas1",
        "elbow.velocity": "vel_meas2",
        "shoulder.motor": "tau_cmd1",
        "elbow.motor": "tau_cmd2",
    }


def test_the_only_joint_that_slides_is_x_and_the_only_hinge_theta() -> None:
    """Of two hinges neither is: no guess is better than one by the columns' order."""
    cart = [Channel("slider", "m"), Channel("hinge_1", "rad")]
    cart += [Channel(f"{c.name}.velocity", f"{c.unit}/s") for c in cart]
    columns = {"theta": Q[1], "x": Q[2], "x_dot": V[2], "u": U[1]}
    found = match(columns, T, cart, [Channel("slide", "1")], "")
    assert {name: m.column.column for name, m in found.items()} == {
        "slider": "x",
        "hinge_1": "theta",
        "slider.velocity": "x_dot",
        "slide": "u",
    }
    swap = {"x": Q[1], "theta": Q[2], "u": U[1]}
    with pytest.raises(InputError, match="E103 no column for joint"):
        match(swap, T, joints("left", "right"), [Channel("slide", "1")], "")


def test_columns_whose_names_say_nothing_are_given() -> None:
    """The others are looked for as before: a velocity by what it is the rate of."""
    columns = {"first": Q[1], "other": Q[2], "rate": V[2], "v_cmd": U[1]}
    asked = T, joints("left", "right"), [Channel("motor", "N m")], "run.csv"
    found = match(columns, *asked, {"right": "other", "left": "first"})
    assert {name: m.column.column for name, m in found.items()} == {
        "left": "first",
        "right": "other",
        "right.velocity": "rate",
        "motor": "v_cmd",
    }
    assert [found[name].why for name in ("left", "right")] == 2 * ["as given"]
    del columns["rate"]  # whose integral is a position under any name
    for given, said in (
        ({}, "E103 no column for joint left, right .* --column left=COLUMN"),
        ({"motor": "v_cmd"}, "E103 no column for joint left, right"),
        ({"lefd": "first"}, "E103 unknown channel .* did you mean left"),
        ({"left": "frist"}, "E103 missing column frist in run.csv.* mean first"),
    ):
        with pytest.raises(InputError, match=said):
            match(columns, *asked, given)


@pytest.mark.parametrize(
    ("position", "velocity", "units"),
    [
        (1.0, 1.0, (None, None, 1)),
        (1.0, -1.0, (None, None, -1)),
        (180 / np.pi, 1.0, ("deg", None, 1)),
        (1.0, 180 / np.pi, (None, "deg/s", 1)),
        (1.0, 60 / (2 * np.pi), (None, "rpm", 1)),
    ],
)
def test_a_rate_tells_units_and_signs(
    position: float, velocity: float, units: tuple[str | None, str | None, int]
) -> None:
    columns = {"a": position * Q[1], "b": velocity * V[1], "drive": U[1]}
    found = match(columns, T, joints("a"), [Channel("motor", "1")], "")
    q, v = found["a"].column, found["a.velocity"].column
    assert (q.column, v.column) == ("a", "b")
    assert (q.unit, v.unit, v.sign) == units
    assert found["motor"].column == Column("drive")


MODEL = """
<mujoco><option timestep="0.01" integrator="RK4"/><worldbody><body name="rod">
  <joint name="hinge" axis="0 1 0" damping=".02"/>
  <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass=".5"/>
</body></worldbody>
<actuator><motor name="drive" joint="hinge" ctrlrange="-2 2"/></actuator></mujoco>
"""


def odd_log(path: Path) -> None:
    """A pendulum in degrees that hangs at 180, turns the other way, its clock in ms."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    data.qpos[0], rows = 0.8, []
    for k in range(600):
        if k % 15 == 0:
            data.ctrl[0] = rng.uniform(-1.0, 1.0)
        q = data.qpos[0] + 1e-3 * rng.standard_normal()
        rows.append([10.0 * k, np.rad2deg(np.pi - q), data.ctrl[0]])
        mujoco.mj_step(model, data)
    header = "millis,encoder,u"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.9g")


def test_an_odd_log_becomes_a_project(tmp_path: Path, capsys) -> None:
    (tmp_path / "pendulum.xml").write_text(MODEL)
    odd_log(tmp_path / "run.csv")
    out = tmp_path / "pendulum.toml"
    words = [tmp_path / "pendulum.xml", tmp_path / "run.csv", "--out", out, "--json"]
    assert main(["init", *map(str, words)]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["columns"]["hinge"]["sign"] == -1
    project = load_project(out)
    stated = project.spec.logs[0]
    assert stated.files == ["run.csv"]
    (log,) = project.load_logs()
    assert log.period == pytest.approx(0.01)
    assert abs(log.channels["hinge"][0] % (2 * np.pi) - 0.8) < 0.01
    names = set(project.system.parameters.names)
    assert {"body/rod/mass", "joint/hinge/damping", "drive.delay"} <= names
    text = out.read_text()
    assert "# 2 ways to read" in text  # a pendulum and its mirror image
    assert main(["init", *map(str, words)]) == 2
    assert "E132 file exists" in capsys.readouterr().err
    assert out.read_text() == text


def test_a_doubt_that_more_windows_settle_is_none(tmp_path: Path) -> None:
    """Forty windows leave open how the example's columns are read; all do not."""
    pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    folder = example(tmp_path / "arm").parent
    logs = [folder / name for name in ("first.csv", "second.csv")]
    answer = init(folder / "arm.xml", logs, out=folder / "mine.toml")
    assert answer["warnings"] == []
    for column in answer["columns"].values():
        assert (column["sign"], column["offset"]) == (1, 0.0)
        assert "the model predicts the log best so" in column["why"]


def test_a_coarse_model_is_stepped_as_it_is() -> None:
    """Half of its own step would be another simulator."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    text = MODEL.replace('"0.01" integrator="RK4"', '"0.03" integrator="Euler"')
    system = MuJoCo(mujoco.MjModel.from_xml_string(text))
    fine = MuJoCo(mujoco.MjModel.from_xml_string(MODEL.replace("0.01", "0.002")))
    assert (system.window_substep, fine.window_substep) == (0.03, 0.002)
    time, y = 0.03 * np.arange(20), np.linspace(0.5, 1.0, 20)
    log = Log("a", "a.csv", time, {"hinge": y}, {"drive": 0.0 * y}, {"hinge": y > 0})
    windows, _ = cut([log], system, window=0.3)
    spans = np.asarray(windows.span)
    np.testing.assert_allclose(spans[spans > 0.0], 0.03, rtol=1e-9)


def test_what_a_log_needs_to_be_read_is_said_in_the_draft(
    tmp_path: Path, capsys
) -> None:
    """A stamp that appears twice, a value that is none: the key, and where."""
    (tmp_path / "pendulum.xml").write_text(MODEL)
    odd_log(tmp_path / "run.csv")
    lines = (tmp_path / "run.csv").read_text().splitlines()
    lines.insert(20, lines[19])
    stamp, _, command = lines[40].split(",")
    lines[40] = f"{stamp},nan,{command}"
    (tmp_path / "run.csv").write_text("\n".join(lines) + "\n")
    out = tmp_path / "pendulum.toml"
    words = [tmp_path / "pendulum.xml", tmp_path / "run.csv", "--out", out]
    assert main(["init", *map(str, words), "--no-readings"]) == 0
    answer = capsys.readouterr().err
    assert "the file has keep_first = true: duplicate time stamp in" in answer
    assert "the file has drop_nonfinite = true: value that is not finite in" in answer
    text = out.read_text()
    assert "keep_first = true  # duplicate time stamp in" in text
    assert "drop_nonfinite = true  # value that is not finite in" in text
    assert load_project(out).load_logs()


def test_bad_input_is_one_line_and_nothing_is_written(tmp_path: Path, capsys) -> None:
    (tmp_path / "log.csv").write_text("time,q1\n0,0\n0.1,1\n0.2,3\n")
    log = str(tmp_path / "log.csv")
    for words, fault in (
        (["two_lnik", log], "E160 unknown system"),
        ([], "E160 missing MODEL"),
        (["furuta", str(tmp_path / "none.csv")], "E130"),
        (["furuta", log], "E103 no column for input voltage"),
    ):
        out = ["--out", str(tmp_path / "p.toml")]
        assert main(["init", *words, *out]) == 2
        err = capsys.readouterr().err
        assert fault in err
        assert err.count("\n") <= 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["log.csv"]
