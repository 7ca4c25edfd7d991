"""Tied constants of a MuJoCo model: one number a quantity, mirrored bodies too."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.project import load_project
from sim2gp.systems.mujoco.inertia import inertia_matrix
from sim2gp.types import in_float64

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

#: Two thighs that are mirror images in y, and a tail that is none.
LEGS = """<mujoco><option gravity="0 0 0"/><worldbody>
<body name="left_thigh" pos="0 .1 0"><joint name="left" axis="0 1 0" damping=".1"/>
  <inertial pos=".02 .03 -.1" mass="1.2"
            fullinertia=".02 .021 .004 .001 .002 -.0015"/></body>
<body name="right_thigh" pos="0 -.1 0"><joint name="right" axis="0 1 0" damping=".3"/>
  <inertial pos=".02 -.03 -.1" mass="1.2"
            fullinertia=".02 .021 .004 -.001 .002 .0015"/></body>
<body name="tail_thigh" pos="-.2 0 0"><joint name="tail" axis="0 1 0" armature=".1"/>
  <inertial pos="-.1 .01 0" mass=".3" fullinertia=".001 .004 .004 0 0 0"/></body>
</worldbody></mujoco>"""
NUMBERS = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")


def bodies(plant: sy.MuJoCo, values: dict[str, float]):
    """Mass, centre and inertia of each body with these constants."""
    record = plant.record({k: jnp.asarray(v) for k, v in values.items()})
    model = plant.engine.with_values(np.asarray(record))
    return {
        model.body(b).name: (
            float(model.body_mass[b]),
            model.body_ipos[b].copy(),
            inertia_matrix(model, b),
        )
        for b in range(1, model.nbody)
    }


@in_float64
def test_an_inertia_of_two_sides_is_that_of_mirror_images(tmp_path: Path) -> None:
    """Any ten numbers leave the two thighs images of each other, as in the file."""
    path = tmp_path / "legs.xml"
    path.write_text(LEGS)
    plant = sy.MuJoCo(path, [["body/[lr]*_thigh/inertia"]])
    names = [f"body/left_thigh/inertia/{x}" for x in NUMBERS]
    assert plant.parameters.names == tuple(names)
    rng = np.random.default_rng(1)
    values = dict(zip(names, 0.2 * rng.standard_normal(10), strict=True))
    found = bodies(plant, values)
    (m, c, I), (m2, c2, I2) = found["left_thigh"], found["right_thigh"]
    mirror = np.asarray([1.0, -1.0, 1.0])
    assert m2 == pytest.approx(m, rel=1e-12)
    np.testing.assert_allclose(c2, mirror * c, rtol=1e-12)
    np.testing.assert_allclose(I2, np.outer(mirror, mirror) * I, rtol=1e-9, atol=1e-14)
    assert abs(m - 1.2) > 0.05
    assert abs(c[1] - 0.03) > 0.01
    # What is written into the file is the same two bodies.
    edited = plant.file().edited(plant.by_path(values))
    for body in found:
        b = mujoco.mj_name2id(edited.wanted, mujoco.mjtObj.mjOBJ_BODY, body)
        np.testing.assert_allclose(edited.wanted.body_ipos[b], found[body][1])


@in_float64
def test_bodies_that_are_no_images_have_equal_numbers(tmp_path: Path) -> None:
    path = tmp_path / "legs.xml"
    path.write_text(LEGS)
    plant = sy.MuJoCo(path, [["body/[lt]*_thigh/inertia"]])
    signs = {c.sign for group in plant.engine.constants for c in group}
    assert signs == {1.0}


@in_float64
def test_one_pattern_ties_each_quantity_by_itself(tmp_path: Path) -> None:
    (tmp_path / "legs.xml").write_text(LEGS)
    project = tmp_path / "project.toml"
    project.write_text(
        'system = "legs.xml"\n[parameters."body/[lr]*_thigh/com_[xy]"]\n'
        "sd = 0.01\ntie = true\n"
        '[parameters."joint/*t/damping"]\ntie = true\n'
    )
    plant = load_project(project).build_system()
    assert isinstance(plant, sy.MuJoCo)
    assert plant.parameters.names == (
        *(f"body/left_thigh/com_{axis}" for axis in "xy"),
        "joint/left/damping",
    )
    values = dict(zip(plant.parameters.names, (0.05, 0.07, 0.4), strict=True))
    found = bodies(plant, values)
    assert found["left_thigh"][1][:2].tolist() == [0.05, 0.07]
    assert found["right_thigh"][1][:2].tolist() == [0.05, -0.07]
    assert plant.by_path(values) == {
        "body/left_thigh/com_x": 0.05,
        "body/right_thigh/com_x": 0.05,
        "body/left_thigh/com_y": 0.07,
        "body/right_thigh/com_y": -0.07,
        "joint/left/damping": 0.4,
        "joint/right/damping": 0.4,
    }
