"""What is guessed of the windows' starts says nothing of the parameters."""

from pathlib import Path

import jax
import numpy as np
import pytest

from linear_system import linear
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut, roughness
from sim2gp.identification.fit import fit_windows
from sim2gp.project import load_project
from sim2gp.types import in_float64

pytest.importorskip("mujoco")

#: Free in the plane: the same start rates make up for much of what the motors do.
ARM = """
<mujoco model="reacher">
  <option timestep="0.02"><flag contact="disable"/></option>
  <default>
    <joint type="hinge" axis="0 0 1" damping="0.01"/>
    <geom type="capsule" size="0.01"/>
  </default>
  <worldbody>
    <body name="upper">
      <geom fromto="0 0 0 0.12 0 0"/><joint name="shoulder"/>
      <body name="lower" pos="0.12 0 0">
        <geom fromto="0 0 0 0.1 0 0"/><joint name="elbow"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="one" joint="shoulder" gear="0.05" ctrlrange="-1 1"/>
    <motor name="two" joint="elbow" gear="0.05" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""
PROJECT = """
system = "arm.xml"
[parameters."joint/*/damping"]
relative_sd = 0.5
[parameters."body/lower/mass"]
relative_sd = 0.3
[parameters."actuator/*/gear"]
tie = true
relative_sd = 0.3
[[logs]]
files = ["log.csv"]
[logs.columns]
shoulder = "q1"
elbow = "q2"
one = "u1"
two = "u2"
"""


def record(path: Path, seconds: float) -> None:
    """By C MuJoCo, encoders of 1 mrad; the input jumps where windows begin."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(ARM)
    data, rng, rows = mujoco.MjData(model), np.random.default_rng(1), []
    model.actuator_gear[:, 0] *= 1.3
    count = round(seconds / 0.02)
    u = np.repeat(rng.uniform(-1.0, 1.0, (count // 5 + 1, 2)), 5, axis=0)
    for k in range(count):
        u[k] = np.clip(u[k] - 0.3 * (data.qpos + data.qvel), -1.0, 1.0)
        rows.append([data.time, *(data.qpos + 1e-3 * rng.standard_normal(2)), *u[k]])
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, delimiter=",", header="time,q1,q2,u1,u2", comments="")


@in_float64
def test_guessed_starts_do_not_pull_at_the_parameters(tmp_path: Path) -> None:
    """The guesses are wrong by the jumps of the acceleration, all the same way."""
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "arm.toml").write_text(PROJECT)
    record(tmp_path / "log.csv", seconds=20.0)
    project = load_project(tmp_path / "arm.toml")
    logs = project.read_logs([tmp_path / "log.csv"])
    rates = {"shoulder.velocity": 1e3, "elbow.velocity": 1e3}
    guessed, free = (
        fit_windows(
            project.system,
            cut(logs, project.system, window=0.2, start_sd=sd)[0],
            key=jax.random.key(0),
        ).posterior
        for sd in (None, rates)
    )
    moved = np.asarray(guessed.mean - free.mean) / np.asarray(free.sd())
    assert np.abs(moved).max() < 0.15
    np.testing.assert_allclose(guessed.sd(), free.sd(), rtol=0.02)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_start_of_a_noisy_sensor_is_as_uncertain_as_its_rows(noise: float) -> None:
    """Of white noise its sd, to some percent; a step of 1e-3 alone counts 100 times."""
    rng, rows = np.random.default_rng(5), 4000
    x = np.sin(0.02 * np.arange(rows)) + noise * rng.standard_normal(rows)
    log = Log(
        name="log",
        source="log.csv",
        time=0.01 * np.arange(rows),
        channels={"x0": 1e-3 * np.round(1e3 * x)},
        inputs={"a0": np.zeros(rows), "a1": np.zeros(rows)},
        mask={"x0": rng.random(rows) < 0.9},
    )
    assert roughness([log], "x0") == pytest.approx(noise, rel=0.05, abs=5e-4)
    windows, _ = cut([log], linear(2, 1), window=1.0)
    sd = np.unique(np.asarray(windows.start_sd))
    expected = max(100.0 * 1e-3 / np.sqrt(12.0), 3.0 * noise)
    np.testing.assert_allclose(sd, expected, rtol=0.05)
