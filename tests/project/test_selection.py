"""Which constants a draft opens: closed forms, and what C MuJoCo says of base sums."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import servo_arm
from linear_system import linear, windows_of
from sim2gp.cli import main
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.identifiability.selection import (
    SILENT,
    Selection,
    select_parameters,
)
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.linear_likelihood import LinearLikelihood
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.project import load_project
from sim2gp.project.open_constants import select_constants, try_selection
from sim2gp.types import in_float64


def table(sd: Mapping[str, float], kind: str = "identity", mean: float = 2.0) -> Any:
    """Constants about one mean, and their prior."""
    free = tuple(Parameter(n, "kg", n, kind, mean=mean, sd=s) for n, s in sd.items())
    return Parameters(free), Parameters(free).prior()


def selected(J: np.ndarray, names: str, **more: Any) -> Selection:
    """Of standard normal priors."""
    parameters, prior = table(dict.fromkeys(names.split(), 1.0))
    return select_parameters(parameters, prior, jnp.asarray(J), **more)


def test_small_effects_are_held() -> None:
    """Orthogonal effects: each has its own size, and leaves 1 / sqrt(1 + size^2)."""
    size = np.asarray([3.0, 0.9 * SILENT, 1.1 * SILENT, 0.0])
    Q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(9, 4)))
    found = selected(Q * size, "a b c d")
    assert found.held == pytest.approx({"b": 1.0 / np.hypot(1.0, size[1]), "d": 1.0})
    assert found.stands_for == {}


def test_one_of_a_sum_stands_for_it() -> None:
    """Data of ``a + .5 b + 2 c`` alone: the largest effect in prior sd stays open."""
    parameters, prior = table({"a": 1.0, "b": 0.6, "c": 0.2})
    F = np.outer(np.arange(1.0, 6.0), [1.0, 0.5, 2.0])
    A = jnp.asarray(F) @ prior.scale
    found = select_parameters(parameters, prior, A)
    assert set(found.held) == {"b", "c"}
    assert found.stands_for == {"a": pytest.approx({"b": 0.5, "c": 2.0})}
    # What is left of z_j is 1 - h_j^2 / (1 + h^2), h of the sum in prior sd.
    h = np.asarray([1.0, 0.3, 0.4]) * np.sqrt(55.0)
    left = np.sqrt(1.0 - h**2 / (1.0 + h @ h))
    assert [*found.held.values()] == pytest.approx(left[1:])


def test_sums_are_of_physical_values() -> None:
    """Of log-normal masses, too, whose priors are in their logarithms."""
    parameters, prior = table({"a": 1.5, "b": 0.5}, "log", mean=2.0)
    theta = np.asarray(parameters.constrain(prior.mean))
    F = np.outer([1.0, 3.0], [1.0, 0.25]) * theta  # by logarithms: sums of masses
    found = select_parameters(parameters, prior, jnp.asarray(F) @ prior.scale)
    assert found.stands_for == {"a": pytest.approx({"b": 0.25})}


def test_a_correlated_prior_is_counted_by_its_sd() -> None:
    parameters, _ = table({"a": 1.0, "b": 1.0})
    F = jnp.asarray([[5.0, 0.3], [5.0, 0.3]])
    scale = jnp.asarray([[1.0, 0.0], [0.8, 0.6]])
    found = [
        select_parameters(parameters, Gaussian(jnp.full(2, 2.0), L0), F @ L0)
        for L0 in (jnp.eye(2), scale)
    ]
    assert [*found[0].held] == ["b"]
    assert found[1].held == pytest.approx(found[0].held)
    assert found[1].stands_for["a"] == pytest.approx(found[0].stands_for["a"])


def test_nuisances_take_what_they_can_and_are_never_held() -> None:
    """A constant that acts like a delay is held; a delay without effect costs nothing.

    ``b`` moves the data like the delay but for one row, which it needs to itself.
    """
    J = np.asarray([[1.0, 1.0, 1.0], [2.0, 2.0, 2.0], [0.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    found = selected(J, "late a b", nuisances=["late"])
    assert [*found.held] == ["a"]
    idle = selected(J * [0.0, 1.0, 1.0], "late a b", nuisances=["late"])
    assert idle.held == {}


def test_nothing_told_holds_nothing() -> None:
    assert selected(np.zeros((4, 3)), "a b c") == Selection({}, {})


@in_float64
def test_a_likelihood_linearised_once_is_the_linear_one_everywhere() -> None:
    rng = np.random.default_rng(1)
    J, y = rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 2))
    windows = windows_of(J, y, np.zeros(4, int))
    true = WindowsLikelihood(linear(3, 2), windows)
    n, W = true.n_nuisances, len(windows)
    tt, e0 = rng.normal(size=3), rng.normal(size=(W, n))
    at = np.asarray(true.blocks(jnp.asarray(tt), jnp.asarray(e0), jnp.eye(3)))
    noise = Noise(jnp.ones(2), jnp.ones(W))
    once = LinearLikelihood(true.counts, true.floor, at, tt, e0, noise)
    assert once.n_nuisances == n
    e, scale = rng.normal(size=(W, n)), rng.normal(size=(3, 3))
    elsewhere = tt + rng.normal(size=3)
    found, exact = (x.trial(elsewhere, e, scale) for x in (once, true))
    np.testing.assert_allclose(found.squares, exact.squares, rtol=1e-10)
    grams = [
        np.einsum("wcij,wcik->wcjk", B, B) for B in (found.blocks(), exact.blocks())
    ]
    np.testing.assert_allclose(*grams, rtol=1e-9, atol=1e-11)


def six_axis_project(folder: Path, seconds: float = 3.0) -> Any:
    """The arm with all that a draft opens, its delay, and its log."""
    kinds = "damping", "armature", "frictionloss"
    joints = [f"joint/joint{k}/{x}" for k in range(1, 7) for x in kinds]
    masses = [f"body/link{k}/mass" for k in range(1, 7)]
    (folder / "arm.xml").write_text(servo_arm.model_text())
    servo_arm.record(folder / "log.csv", seconds=seconds, delay=0.01)
    text = servo_arm.project_text(["log.csv"], constants=[*joints, *masses])
    (folder / "arm.toml").write_text(text)
    project = load_project(folder / "arm.toml")
    return project, project.load_logs()


def test_the_first_link_of_an_arm_is_held(tmp_path: Path) -> None:
    """About its vertical axis a mass is inertia, which the armature is as well."""
    pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    project, logs = six_axis_project(tmp_path)
    found = select_constants(project, logs, until=np.inf)
    assert [*found.held] == ["body/link1/mass"]
    assert found.held["body/link1/mass"] > 0.99
    mass, about_z = servo_arm.LINKS[0][0], servo_arm.LINKS[0][2][2]
    assert found.stands_for == {
        "joint/joint1/armature": {"body/link1/mass": pytest.approx(about_z / mass)}
    }
    with pytest.raises(TimeoutError):
        select_constants(project, logs, until=-np.inf)
    assert try_selection(project, logs, -np.inf, 5.0) == (
        None,
        "not tried: the 5 s were over",
    )


def test_two_bodies_in_one_joint_are_one_inertia(tmp_path: Path) -> None:
    """About a vertical axis, with an armature: one sum is learned, by C MuJoCo's M."""
    mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is absent")
    (tmp_path / "arm.xml").write_text(TURNTABLE)
    model = mujoco.MjModel.from_xml_string(TURNTABLE)
    per_kg = [_inertia(mujoco, k, 1.0) - _inertia(mujoco, k, 0.0) for k in (1, 2)]
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows = []
    for k in range(600):
        if k % 40 == 0:
            data.ctrl[0] = rng.uniform(-1.0, 1.0)
        noisy = data.qpos[0] + 1e-3 * rng.standard_normal()
        rows.append([0.005 * k, noisy, data.ctrl[0]])
        mujoco.mj_step(model, data)
    names = "time,turn,drive"
    log = tmp_path / "run.csv"
    np.savetxt(log, rows, delimiter=",", header=names, comments="", fmt="%.9g")
    words = ["init", str(tmp_path / "arm.xml"), str(log), "--quiet"]
    assert main([*words, "--out", str(tmp_path / "arm.toml")]) == 0
    system = load_project(tmp_path / "arm.toml").system
    learned = "joint/turn/damping", "body/lower/mass", "drive.delay"
    assert set(system.parameters.names) == set(learned)
    text = (tmp_path / "arm.toml").read_text()
    (line,) = (x for x in text.splitlines() if "stands for" in x)
    ratios = per_kg[1] / per_kg[0], 1.0 / per_kg[0]
    sums = "body/lower/mass + {:.3g} body/upper/mass + {:.3g} joint/turn/armature"
    assert line.endswith(f"stands for {sums.format(*ratios)}")
    opened = text.replace('# "body/upper/mass" = {}', '"body/upper/mass" = {}')
    (tmp_path / "arm.toml").write_text(opened)
    names = load_project(tmp_path / "arm.toml").system.parameters.names
    assert "body/upper/mass" in names


#: A body on a turntable, and another one welded to it.
TURNTABLE = """<mujoco><option timestep="0.005" integrator="implicitfast"/><worldbody>
<body name="lower"><joint name="turn" axis="0 0 1" damping=".2" armature=".01"/>
<inertial mass="2" pos=".2 0 0" diaginertia=".01 .01 .01"/>
<body name="upper" pos=".1 0 0"><inertial mass="1" pos=".1 0 0"
diaginertia=".01 .02 .02"/></body></body></worldbody>
<actuator><motor name="drive" joint="turn" ctrlrange="-1 1"/></actuator></mujoco>"""


def _inertia(mujoco: Any, body: int, kilograms: float) -> float:
    """About the joint, with so many more kg of a body as the file has it."""
    model = mujoco.MjModel.from_xml_string(TURNTABLE)
    more = 1.0 + kilograms / model.body_mass[body]
    model.body_mass[body] *= more
    model.body_inertia[body] *= more
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return float(model.dof_M0[0])
