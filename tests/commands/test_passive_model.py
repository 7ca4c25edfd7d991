"""A MuJoCo model without actuators: a swing that was let go is identified."""

import json
from pathlib import Path

import numpy as np
import pytest

from sim2gp.cli import main

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

SWING = """<mujoco model="swing"><option timestep=".005"/><worldbody><body name="arm">
<joint name="q" axis="0 1 0" damping="{}"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".5"/></body></worldbody>
</mujoco>"""
PROJECT = """system = "swing.xml"
[parameters."joint/q/damping"]
[[logs]]
files = ["*.csv"]
time = "t"
columns = {q = "angle"}
"""
TRUE, SD = 0.02, 1e-3  # N m s/rad, rad


@pytest.mark.nightly
def test_a_swing_is_identified_without_an_input(tmp_path: Path, capsys) -> None:
    (tmp_path / "swing.xml").write_text(SWING.format(0.012))
    (tmp_path / "swing.toml").write_text(PROJECT)
    model = mujoco.MjModel.from_xml_string(SWING.format(TRUE))
    rng = np.random.default_rng(0)
    for name, start in (("a", 1.0), ("b", -1.5)):
        data, rows = mujoco.MjData(model), []
        data.qpos[:] = start
        for _ in range(200):
            rows.append((data.time, data.qpos[0] + SD * rng.standard_normal()))
            mujoco.mj_step(model, data, 2)
        text = "\n".join(f"{t:.6f},{q:.9f}" for t, q in rows)
        (tmp_path / f"{name}.csv").write_text(f"t,angle\n{text}\n")
    run = tmp_path / "run"
    code = main(["identify", str(tmp_path / "swing.toml"), "--out", str(run)])
    assert code == 0, capsys.readouterr().err
    summary = json.loads((run / "summary.json").read_text())
    found = summary["parameters"]["joint/q/damping"]
    assert found["mean"] == pytest.approx(TRUE, abs=4.0 * found["sd"])
    assert found["sd"] < 0.1 * TRUE
