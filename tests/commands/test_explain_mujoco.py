"""`sim2gp explain` on a MuJoCo model: its own spring is the physics that is missing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp.commands.explain import explain
from sim2gp.commands.identify import identify
from sim2gp.project import load_project
from sim2gp.runs import Progress
from sim2gp.systems import Candidate, candidates

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

QUIET = Progress(quiet=True)
STIFFNESS, MASS, LENGTH, ARMATURE = 0.3, 0.4, 0.5, 0.02
MODEL = f"""<mujoco><option timestep="0.005"/><worldbody><body>
<joint name="hinge" axis="0 1 0" damping="0.05" armature="{ARMATURE}"/>
<inertial pos="0 0 {-LENGTH}" mass="{MASS}" diaginertia="1e-6 1e-6 1e-6"/></body>
</worldbody><actuator><motor name="torque" joint="hinge" ctrlrange="-3 3"/></actuator>
</mujoco>"""
PROJECT = """system = "pendulum.xml"
[parameters."joint/hinge/damping"]
[parameters."body/body1/mass"]
[likelihood]
window = 0.5
[[logs]]
files = ["log.csv"]
time = "time"
[logs.columns]
hinge = "hinge"
torque = "torque"
"""


def record(out: Path, stiffness: float) -> None:
    """Two seconds at 200 Hz of the model with a spring about its zero."""
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.jnt_stiffness[0] = stiffness
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows = []
    for k in range(400):
        t = 0.005 * k
        u = 1.2 * np.sin(4.0 * t) + 0.8 * np.sin(7.3 * t)
        rows.append([t, data.qpos[0] + 1e-3 * rng.normal(), u])
        data.ctrl[0] = u
        mujoco.mj_step(model, data)
    header = "time,hinge,torque"
    np.savetxt(out, rows, delimiter=",", header=header, comments="", fmt="%.9g")


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two candidates in place of eight."""

    def short(system: Any, *, windows: bool = False) -> tuple[Candidate, ...]:
        every = candidates(system, windows=windows)
        return tuple(c for c in every if c.name in ("hinge.spring", "hinge.drag"))

    monkeypatch.setattr(
        "sim2gp.identification.missing_physics.search.registered", short
    )


@pytest.mark.nightly
@pytest.mark.usefixtures("few")
def test_a_spring_of_mujocos_own_is_found(tmp_path: Path) -> None:
    (tmp_path / "pendulum.xml").write_text(
        MODEL.replace("<body>", '<body name="body1">')
    )
    (tmp_path / "arm.toml").write_text(PROJECT)
    record(tmp_path / "log.csv", STIFFNESS)
    project = load_project(tmp_path / "arm.toml")
    found = identify(project, progress=QUIET, held_out=False)
    summary = explain(found, progress=QUIET).summary
    assert summary["best"] == "hinge.spring"
    # A force of a machine without a mass matrix is an acceleration.
    best, inertia = summary["candidates"][0], MASS * LENGTH**2 + ARMATURE
    assert abs(best["value"] - STIFFNESS / inertia) < 4.0 * best["sd"]
    assert best["sd"] < 0.1 * best["value"]
