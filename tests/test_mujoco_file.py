"""MuJoCo models as files: read in a child process, and refused."""

import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.systems import mjcf_load

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

from test_mujoco_system import CRAWLER, USUAL, crawler, written  # noqa: E402

FLOATING = """
<mujoco><worldbody>
  <body><freejoint name="base"/><geom size="1"/></body>
</worldbody></mujoco>
"""


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("<mujoco><worldbody></mujoco>", "E170 no model.*number=1"),
        (FLOATING, "E172 joint with a quaternion.*got base"),
    ],
)
def test_models_that_cannot_be_used_are_refused(tmp_path, text, code):
    with pytest.raises(InputError, match=code):
        sy.MuJoCo(written(tmp_path, text))


def test_an_unknown_constant_names_the_nearest(tmp_path):
    with pytest.raises(InputError, match=r"E170.*did you mean joint/hip/damping"):
        crawler(tmp_path, constants=["joint/hip/dampin"])


URDF = """
<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -.2"/><mass value="1"/>
    <inertia ixx=".02" iyy=".02" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping=".1" friction=".05"/></joint>
</robot>
"""


def test_a_urdf_has_a_motor_at_every_joint(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    system = sy.MuJoCo(path)
    assert [c.name for c in system.states] == ["shoulder", "shoulder.velocity"]
    assert [c.name for c in system.actions] == ["shoulder.motor"]
    assert {"joint/shoulder/damping", "joint/shoulder/frictionloss"} <= {
        *system.parameters.names
    }
    own = [[g[0].get(system.engine.model) for g in system.engine.constants]]
    still, pushed = (
        system.engine.flow(
            np.asarray(own), np.zeros((1, 2)), np.array([[torque]]), np.array([0.01])
        )
        for torque in (0.0, 1.0)
    )
    assert still[0, 1] == 0.0
    assert pushed[0, 1] > 0.1


def test_an_actuator_with_a_joints_name_is_another_channel(tmp_path):
    text = CRAWLER.format(**USUAL).replace('name="motor"', 'name="knee"')
    system = sy.MuJoCo(written(tmp_path, text), ["body/torso/mass"])
    assert [c.name for c in system.actions] == ["servo", "knee.control"]


def test_a_model_stays_in_its_folder(tmp_path):
    """An include, a mesh, by a folder of its own or by another file."""
    outside = tmp_path / "secret.xml"
    outside.write_text("<mujoco/>")
    folder = tmp_path / "model"
    folder.mkdir()
    mesh = '<compiler meshdir=".."/><asset><mesh file="secret.xml"/></asset>'
    mesh = f"<mujoco>{mesh}</mujoco>"
    include = '<mujoco><include file="../secret.xml"/></mujoco>'
    absolute = '<mujoco><include file="/etc/passwd"/></mujoco>'
    (folder / "part.xml").write_text(include)
    nested = '<mujoco><include file="part.xml"/></mujoco>'
    for text, what in (
        (mesh, "mesh outside"),
        (include, "include outside"),
        (absolute, "include outside.*/etc/passwd"),
        (nested, r"include outside.*part\.xml"),
    ):
        path = written(folder, text)
        with pytest.raises(InputError, match=f"E171 {what}"):
            sy.MuJoCo(path)
    commented = CRAWLER.format(**USUAL).replace(
        "<compiler", "<!-- " + include + " --><compiler"
    )
    sy.MuJoCo(written(folder, commented), ["body/torso/mass"])


def test_a_parser_that_dies_is_an_error_of_the_file(tmp_path, monkeypatch):
    path = written(tmp_path, CRAWLER.format(**USUAL))
    for code, got in (
        ("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "exit -11"),
        ("import time; time.sleep(30)", "no answer"),
    ):
        child = tmp_path / "child.py"
        child.write_text(code)
        monkeypatch.setattr(mjcf_load, "_CHILD", str(child))
        monkeypatch.setattr(mjcf_load, "SECONDS", 1)
        with pytest.raises(InputError, match=f"E171 MuJoCo's parser.*{got}"):
            sy.MuJoCo(path)
    with pytest.raises(InputError, match=r"E130 cannot read .*none\.xml"):
        sy.MuJoCo(tmp_path / "none.xml")
