"""`sim2gp init` of arms with servos: readings in seconds, and projects without logs."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sim2gp as sg
from hostile_models import tetrahedron
from servo_arm import LINKS, model_text, record
from sim2gp.cli import main
from sim2gp.errors import InputError
from sim2gp.project import load_project
from sim2gp.project.draft_text import window_of
from tests.cli.test_interrupts import CODES, SECONDS, everything_in, started, stopped

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
WALL = (-9.81, 0.0, 0.0)  # m/s^2: no mirror image of the arm moves as it does
DEG = float(np.pi / 180)
#: Of each column: sign, zero in rad, unit in rad.
ODD = {
    "joint1": (-1, 0.0, DEG),
    "u1": (-1, 0.0, 1.0),
    "joint2": (-1, 0.0, 1.0),
    "u2": (1, 0.0, DEG),
}


def drafted(folder: Path, *options: str, capsys: Any) -> tuple[dict[str, Any], str]:
    """The summary of `init arm.xml run.csv`, and the file that it wrote."""
    out = folder / "arm.toml"
    words = [str(folder / "arm.xml"), str(folder / "run.csv")]
    code = main(["init", *words, "--out", str(out), "--json", "--quiet", *options])
    said = capsys.readouterr()
    assert code == 0, said.err
    return json.loads(said.out), out.read_text()


def arm_and_log(folder: Path, links: Any, *, limited: bool = True, **how: Any) -> None:
    """An arm of these links, and a log of it, coarser than the model's step."""
    xml = model_text(0.002, links=links, limited=limited, down=WALL)
    (folder / "arm.xml").write_text(xml)
    record(folder / "run.csv", mujoco.MjModel.from_xml_string(xml), **how)


def two_links(folder: Path, seconds: float = 4.0) -> None:
    arm_and_log(folder, LINKS[1:3], seconds=seconds, read=ODD)


def test_signs_and_units_of_a_servo_arm(tmp_path: Path, capsys: Any) -> None:
    two_links(tmp_path)
    begun = time.monotonic()
    answer, text = drafted(tmp_path, capsys=capsys)
    assert time.monotonic() - begun < 60.0
    found = {n: (c["sign"], c["unit"]) for n, c in answer["columns"].items()}
    assert found == {
        "joint1": (-1, "deg"),
        "joint2": (-1, ""),
        "servo1": (-1, ""),
        "servo2": (1, "deg"),
    }
    assert not answer["warnings"]
    project = load_project(tmp_path / "arm.toml")
    assert 1.99 < project.spec.likelihood.window <= 2.0
    names = project.system.parameters.names
    assert answer["open_parameters"] == 8
    assert "held_parameters" not in answer
    assert "body/link1/mass" in names
    assert not [name for name in names if name.endswith(("/kp", "/kv"))]
    assert "the gains of the servos" in text


@pytest.mark.nightly  # 11 s
def test_a_model_without_motors_is_fitted_to_its_swinging(
    tmp_path: Path, capsys: Any
) -> None:
    model = """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0" damping=".01"/>
    <geom type="capsule" size=".01" fromto="0 0 0 0 0 -.3" mass=".5"/>
    </body></worldbody></mujoco>"""
    (tmp_path / "arm.xml").write_text(model)
    assert (
        main(["init", str(tmp_path / "arm.xml"), "--out", str(tmp_path / "a.toml")])
        == 0
    )
    capsys.readouterr()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.toml", "arm.xml"]
    truth = mujoco.MjModel.from_xml_string(model)
    truth.dof_damping[:] = 0.02
    data, rows = mujoco.MjData(truth), []
    data.qpos[:] = 1.5
    for _ in range(1000):
        rows.append([data.time, *data.qpos])
        mujoco.mj_step(truth, data)
    header = "time,hinge"
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header=header, comments="")
    answer, text = drafted(tmp_path, capsys=capsys)
    assert "actuators" not in text
    assert answer["open_parameters"] == 1  # its mass is no other parameter
    project = load_project(tmp_path / "arm.toml")
    found = sg.identify(project, held_out=False, progress=sg.Progress(quiet=True))
    low, high = found.parameters["joint/hinge/damping"].interval
    assert low <= 0.02 <= high
    assert high - low < 1e-3


def test_a_short_log_is_one_window(tmp_path: Path, capsys: Any) -> None:
    two_links(tmp_path, seconds=0.8)
    drafted(tmp_path, "--no-readings", capsys=capsys)
    window = load_project(tmp_path / "arm.toml").spec.likelihood.window
    assert 0.75 < window < 0.8


@pytest.mark.parametrize(
    ("longest", "window"), [(0.8, 0.8), (1.6, 1.0), (5.0, 2.5), (30.0, 5.0)]
)
def test_windows_of_servos_are_half_of_the_log(longest: float, window: float) -> None:
    assert window_of(longest) == window


@pytest.mark.parametrize("option", [("--budget", "0.01"), ("--no-readings",)])
def test_what_was_not_tried_is_named(
    tmp_path: Path, capsys: Any, option: tuple[str, ...]
) -> None:
    two_links(tmp_path)
    answer, text = drafted(tmp_path, *option, capsys=capsys)
    reason = "the 0.01 s were over" if len(option) == 2 else "--no-readings"
    late = len(option) == 2  # then what to open is not known, either
    assert text.count(f"not tried: {reason}") == 4 + late
    assert "held_parameters" not in answer
    assert answer["warnings"] == [
        "W160 not tried how to read joint1, joint2, servo1, servo2"
    ]
    assert answer["columns"]["joint2"]["sign"] == 1


def test_without_logs_the_columns_and_an_experiment(
    tmp_path: Path, capsys: Any
) -> None:
    (tmp_path / "arm.xml").write_text(model_text(links=LINKS[1:3]))
    out, model = tmp_path / "arm.toml", str(tmp_path / "arm.xml")
    assert main(["init", model, "--out", str(out), "--json", "--quiet"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert load_project(out).system.actions[1].name == "servo2"
    text = out.read_text()
    for line in ("time in s", "joint1 in rad, measured", "servo2 in rad, as commanded"):
        assert f"#   {line}" in text
    rows = np.genfromtxt(answer["commands"], delimiter=",", names=True)
    assert rows.dtype.names[:3] == ("time", "servo1", "servo2")
    for name, reach in (("servo1", 1.5), ("servo2", 1.8)):
        assert 0.05 < np.ptp(rows[name]) <= 0.8 * reach
        assert np.abs(np.diff(rows[name])).max() <= 0.01 * 0.8 * reach / 3.0 + 1e-8
        assert max(abs(rows[name][[0, -1]])) < 0.02  # it begins and ends at rest


def test_no_experiment_where_none_is_safe(tmp_path: Path, capsys: Any) -> None:
    """An arm whose motors alone do not hold it falls, and the summary says so."""
    text = model_text(links=LINKS[1:2], down=WALL).replace("-1.5 1.5", "-0.3 0.3")
    servo = text[text.index("<position") : text.index("</actuator>")]
    motor = '<motor name="m" joint="joint1" ctrlrange="-1 1"/>'
    (tmp_path / "arm.xml").write_text(text.replace(servo, motor))
    out, model = tmp_path / "arm.toml", str(tmp_path / "arm.xml")
    assert main(["init", model, "--out", str(out), "--json", "--quiet"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["experiment"].startswith("no experiment: ")
    assert "joint1 comes to an end of its range" in answer["experiment"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.toml", "arm.xml"]


def test_an_input_without_a_column_is_a_number(tmp_path: Path, capsys: Any) -> None:
    two_links(tmp_path)
    log = tmp_path / "run.csv"
    rows = np.loadtxt(log, delimiter=",", skiprows=1)[:, :-1]
    header = "time,joint1,joint2,u1"
    np.savetxt(log, rows, delimiter=",", header=header, comments="", fmt="%.9g")
    words = ["init", str(tmp_path / "arm.xml"), str(log)]
    out = tmp_path / "arm.toml"
    assert main([*words, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert "E103" in said
    assert "--constant servo2=0.0" in said
    option = ("--constant", "servo2=0.0", "--no-readings")
    drafted(tmp_path, *option, capsys=capsys)
    (read,) = load_project(out).load_logs()
    assert not read.inputs["servo2"].any()
    text = out.read_text().replace("servo2 = 0.0 ", 'servo2 = "u2" ')
    out.write_text(text)
    with pytest.raises(InputError, match=r"E103 .*u2.* write servo2 = 0\.0"):
        load_project(out).load_logs()


@pytest.mark.nightly  # 7 s
def test_a_mesh_behind_a_link_and_the_root(tmp_path: Path, capsys: Any) -> None:
    stored, folder = tmp_path / "stored", tmp_path / "model"
    stored.mkdir()
    folder.mkdir()
    (stored / "part.stl").write_bytes(tetrahedron(0.1))
    (folder / "part.stl").symlink_to("../stored/part.stl")
    text = model_text(links=LINKS[1:2]).replace(
        "<worldbody>", '<asset><mesh name="m" file="part.stl"/></asset><worldbody>'
    )
    (folder / "arm.xml").write_text(text)
    words = ["init", str(folder / "arm.xml"), "--out", str(tmp_path / "arm.toml")]
    assert main(words) == 2
    said = capsys.readouterr().err
    assert "E171" in said
    assert str(stored.resolve() / "part.stl") in said
    assert "--root DIR" in said
    assert main([*words, "--root", str(tmp_path)]) == 0
    assert load_project(tmp_path / "arm.toml").spec.options == {"root": "."}


@pytest.mark.nightly  # 8 s; other commands are interrupted by day
def test_ctrl_c_ends_init_while_it_tries_readings(tmp_path: Path) -> None:
    """Of a six-axis arm without stops: the most readings that a draft tries."""
    arm_and_log(tmp_path, LINKS, limited=False, seconds=10.0)
    call = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sim2gp.cli import entry; entry()"
    )
    words = ["init", str(tmp_path / "arm.xml"), str(tmp_path / "run.csv")]
    (tmp_path / "run").mkdir()
    with started(tmp_path / "run", ["-c", call, *words]) as child:
        assert child.stderr is not None
        assert any("readings" in line for line in child.stderr)
        time.sleep(3.0)  # columns are matched by then
        seconds, _, said = stopped(child, "SIGINT")
        assert child.returncode == CODES["SIGINT"]
    assert seconds < SECONDS
    assert said.splitlines() == ["interrupted; nothing half-written is left"]
    assert everything_in(tmp_path / "run") == ["temporary", "work"]


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(20))
def test_random_readings_are_found_again(
    tmp_path: Path, capsys: Any, seed: int
) -> None:
    """Of two or three links, with stops or without; up to readings said to be alike."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 4))
    first, limited = int(rng.integers(0, 7 - n)), bool(rng.integers(2))
    links, truth = LINKS[first : first + n], {}
    for k in range(1, n + 1):
        zero = 0.0 if limited else float(rng.choice([0.0, np.pi]))
        for name in (f"joint{k}", f"u{k}"):
            sign, unit = int(rng.choice([1, -1])), float(rng.choice([1.0, DEG]))
            truth[name] = (sign, zero, unit)
    how = {"limited": limited, "seconds": 8.0, "seed": seed, "read": truth}
    arm_and_log(tmp_path, links, **how)
    answer, text = drafted(tmp_path, capsys=capsys)
    for k in range(1, n + 1):
        pair = answer["columns"][f"joint{k}"], answer["columns"][f"servo{k}"]
        turned = [c["sign"] * truth[c["column"]][0] for c in pair]
        assert turned[0] == turned[1]
        doubts = "ways to read these columns", "the log hardly tells this from"
        assert turned[0] == 1 or any(doubt in text for doubt in doubts)
        for c in pair:
            _, zero, unit = truth[c["column"]]
            assert np.cos(c["offset"] - zero) == pytest.approx(1.0)
            assert (c["unit"] == "deg") == (unit == DEG)
