"""`sim2gp example`: what it writes is whole, runs, and hides a truth that is found."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from sim2gp.cli import main
from sim2gp.cli.commands import COMMANDS
from sim2gp.commands.example import MODEL, TRUTH
from sim2gp.errors import InputError
from sim2gp.runs import DiskError
from sim2gp.types import in_float64

QUIET = sg.Progress(quiet=True)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sg.example(tmp_path_factory.mktemp("example") / "first").parent


@pytest.mark.nightly  # by day a block of the README identifies it
def test_what_was_hidden_is_found(folder: Path) -> None:
    robot = sg.load_project(folder / "arm.toml")
    found = sg.identify(robot, held_out=False, progress=QUIET)
    assert set(found.parameters) == set(TRUTH)
    for name, parameter in found.parameters.items():
        low, high = parameter.interval
        assert low < TRUTH[name] < high
        assert parameter.verdict == "identified"
    assert not found.summary["misfit"]["alarm"]


def test_the_readme_names_commands_and_the_truth(folder: Path) -> None:
    text = (folder / "README.md").read_text()
    named = re.findall(r"sim2gp (\w+) ", text)
    assert set(named) <= set(COMMANDS)
    stated = re.findall(r"([\w.]+) = ([\d.]+)", text)
    assert {name: float(x) for name, x in stated} == TRUTH


@in_float64
def test_the_models_file_is_the_same_arm() -> None:
    """Accelerations by MuJoCo's C engine, at the numbers of the drawing."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is missing")
    model = mujoco.MjModel.from_xml_string(MODEL)
    arm, rng = sg.systems.UniformRodArm(), np.random.default_rng(0)
    known = {"l1": 0.5, "l2": 0.4, "m1": 1.0, "m2": 0.8, "b1": 0.1, "b2": 0.1}
    params = arm.record({k: jnp.asarray(v) for k, v in known.items()})
    for _ in range(5):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = rng.normal(size=2), rng.normal(size=2)
        data.ctrl[:] = rng.uniform(-1.0, 1.0, 2)
        start = np.r_[data.qpos, data.qvel]
        torque, h = np.array(data.ctrl), model.opt.timestep
        mujoco.mj_step(model, data)
        ours = np.asarray(arm.flow(params, jnp.asarray(start), jnp.asarray(torque), h))
        np.testing.assert_allclose(np.r_[data.qpos, data.qvel], ours, atol=2e-6)


def test_nothing_is_overwritten(folder: Path, tmp_path: Path) -> None:
    before = (folder / "arm.toml").read_bytes()
    with pytest.raises(InputError, match="E132 file exists"):
        sg.example(folder)
    assert (folder / "arm.toml").read_bytes() == before
    with pytest.raises(InputError, match="E132 no folder"):
        sg.example(tmp_path / "not" / "there")
    assert main(["example", str(tmp_path / "new"), "--quiet"]) == 0
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == sorted(
        ["README.md", "arm.toml", "arm.xml", "first.csv", "second.csv"]
    )


def test_what_fails_half_way_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *args: object, **more: object) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(DiskError, match="E190"):
        sg.example(tmp_path / "new")
    assert list(tmp_path.iterdir()) == []
