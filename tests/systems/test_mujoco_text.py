"""Constants written into a model's own text: little changes, all that it must say."""

import re
from pathlib import Path

import numpy as np
import pytest

from crawler import CRAWLER, USUAL
from sim2gp.errors import InputError
from sim2gp.systems.mujoco.load import compiled, compiled_all
from sim2gp.systems.mujoco.model_file import ModelFile

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

#: Comments, both quotes, defaults of classes, an include, a frame, names that lack.
ARM = """<?xml version="1.0"?>
<!-- <joint name="swing" damping="9"/> -->
<mujoco model='arm &amp; hand'>
  <compiler angle="radian"/>
  <default>
    <joint damping=".1"/>
    <default class="stiff"><joint stiffness="3" frictionloss=".02"/>
      <geom friction=".5 .01 .001" density="500"/></default>
  </default>
  <worldbody>
    <body name="upper" pos="0 0 1">  <!-- hangs -->
      <joint   name = 'swing'
               axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass='.5'/>
      <geom name="hub" type="sphere" size=".04" mass=".25"/>
      <frame pos="0 0 -.4">
        <body name="lower" childclass="stiff">
          <joint axis="0 1 0"/>
          <geom name="rod" type="capsule" fromto="0 0 0 .1 0 -.3" size=".015"/>
          <include file="hand.xml"/>
        </body>
      </frame>
    </body>
    <body pos="1 0 0"><joint type="slide" damping="2"/>
      <inertial pos="0 .1 0" mass="2" diaginertia=".1 .2	.25"/>
      <geom size=".1"/></body>
  </worldbody>
  <actuator>
    <motor name="push" joint="swing" gear="2" ctrllimited="true" ctrlrange="-1 1"/>
    <position joint="swing" kp="3"/>
    <general joint="swing" gainprm="5" biastype="affine" biasprm="0 -5 -.1"/>
    <damper joint="swing" kv=".4" ctrlrange="0 1"/>
    <general joint="swing" gainprm="3" biastype="affine" biasprm=".1 -2 -.2"/>
    <position joint="swing" kp="1" kv="1"/>
  </actuator>
  <contact>
    <pair geom1="rod" geom2="hub"/>
    <pair name="soft" geom1="rod" geom2="hub" friction=".6 .3" solref=".03 .9"/>
    <pair name="hard" geom1="hub" geom2="rod" solref="-900 -40"/>
  </contact>
</mujoco>
"""
HAND = """<mujocoinclude>
  <body name="hand" pos=".1 0 -.3"><joint name="grip" range="0 1" limited="true"/>
    <geom type="box" size=".02 .03 .04"/><geom size=".01" pos="0 0 -.05"/></body>
</mujocoinclude>
"""
#: Every constant of the arm, of which each is written by a rule of its own.
CHANGES = {
    "joint/swing/damping": 0.123456789012345,  # of a default: onto the element
    "joint/joint1/frictionloss": 0.03,  # no name; of a class
    "joint/grip/armature": 0.001,  # in an included file
    "body/upper/mass": 0.9,  # two geoms with masses
    "body/lower/mass": 0.3,  # one geom, by a density
    "body/hand/mass": 0.2,  # two geoms, by densities
    "body/hand/length": 0.4,
    "body/body4/mass": 3.0,  # no name; an inertial
    "body/body4/com_y": 0.12,
    "geom/rod/friction": 0.7,
    "actuator/push/gain": 1.5,  # a motor's is one
    "actuator/push/gear": 2.5,
    "actuator/actuator1/kp": 4.0,
    "actuator/actuator2/kp": 6.0,
    "actuator/actuator2/kv": 0.2,
    "actuator/actuator3/kv": 0.7,  # a damper's is a gain
    "actuator/actuator4/gain": 4.0,  # no servo's, that is its kp
    "actuator/actuator4/kp": 2.5,
    "actuator/actuator5/kp": 2.0,  # the gain goes with it
    "actuator/actuator5/kv": 0.5,  # and does not go with this
    "pair/soft/friction": 0.9,
    "pair/soft/timeconst": 0.04,
    "pair/soft/dampratio": 1.1,
    "pair/hard/friction": 0.4,  # of its geoms, until it is stated
    "pair/hard/stiffness": 1000.0,
    "pair/hard/damping": 50.0,
    "option/gravity": 9.7,
}


def arm(folder: Path) -> ModelFile:
    (folder / "hand.xml").write_text(HAND)
    (folder / "arm.xml").write_text(ARM)
    return file_of(folder / "arm.xml")


def file_of(path: Path) -> ModelFile:
    return ModelFile(path, mujoco.MjModel.from_xml_path(str(path)))


def write(file: ModelFile, values: dict[str, float], folder: Path) -> mujoco.MjModel:
    """New files in a folder, compiled, checked by the file itself."""
    edited = file.edited(values)
    folder.mkdir(exist_ok=True)
    for _, name, data in file.texts(edited, "new" + file.suffix, folder):
        (folder / name).write_bytes(data)
    model = mujoco.MjModel.from_xml_path(str(folder / f"new{file.suffix}"))
    file.check(edited, model)
    return model


@pytest.mark.parametrize("path", CHANGES)
def test_one_constant_changes_alone(tmp_path: Path, path: str) -> None:
    """In the compiled model all other numbers stay, in the text all but a line."""
    file = arm(tmp_path)
    model = write(file, {path: CHANGES[path]}, tmp_path)
    plain = {k: c for k, c in file.constants.items() if c.block is None}
    for other, constant in plain.items():
        expected = CHANGES[path] if other == path else constant.get(file.model)
        assert constant.get(model) == pytest.approx(expected, rel=1e-12), other
    edited = file.edited({path: CHANGES[path]})
    ((source, text),) = file.replaced(edited).items()
    assert source.name == (
        "hand.xml" if "hand" in path or "grip" in path else "arm.xml"
    )
    before, after = source.read_text().split("\n"), text.decode().split("\n")
    changed = set(after) - set(before)
    assert len(changed) <= 1 + (path == "body/upper/mass")
    if path == "joint/swing/damping":
        line = """               axis="0 1 0" damping="0.123456789012345"/>"""
        assert changed == {line}
    if path == "body/upper/mass":
        assert """size=".02" mass='0.6'/>""" in text.decode()
    if path == "body/body4/mass":
        assert re.search(r'mass="3" diaginertia="\S+ \S+\t\S+"', text.decode())
    if path == "body/body4/com_y":
        assert (
            """pos="0 0.12 0" mass="2" diaginertia=".1 .2	.25\"""" in text.decode()
        )


def test_all_constants_at_once_and_in_another_folder(tmp_path: Path) -> None:
    file = arm(tmp_path)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    for folder in (tmp_path, tmp_path / "else where"):
        model = write(file, CHANGES, folder)
        for path, value in CHANGES.items():
            found = file.constants[path].get(model)
            assert found == pytest.approx(value, rel=1e-12), path
    assert {p.name for p in folder.iterdir()} == {"new.xml", "new.hand.xml"}
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    kept = re.sub(r'"[^"]*"|\'[^\']*\'', "", (tmp_path / "new.xml").read_text())
    assert "<!-- <joint name= damping=/> -->" in kept
    assert "<motor" not in kept


def test_an_untouched_part_is_named_where_it_is(tmp_path: Path) -> None:
    file = arm(tmp_path)
    values = {"body/upper/mass": 0.9}
    write(file, values, tmp_path / "other")
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["new.xml"]
    text = (tmp_path / "other" / "new.xml").read_text()
    assert '<include file="../hand.xml"/>' in text
    assert not file.edited({"body/upper/mass": 0.75}).said
    assert file.replaced(file.edited({})) == {}


def test_what_was_written_is_compared(tmp_path: Path) -> None:
    """With the model that it makes: another number is reported, whatever it is of."""
    file = arm(tmp_path)
    edited = file.edited({"body/upper/mass": 0.9})
    for field, index, name in (
        ("body_mass", 1, "body/upper/mass"),
        ("dof_damping", 1, "joint/joint1/damping"),
        ("geom_size", (1, 0), "geom_size"),
        ("body_inertia", (1, 0), "inertia of upper"),
    ):
        model = file.edited({"body/upper/mass": 0.9}).wanted
        file.check(edited, model)
        getattr(model, field)[index] *= 1.0 + 1e-5
        with pytest.raises(InputError, match=f"E170 {name} cannot be written"):
            file.check(edited, model)


def test_a_file_that_cannot_say_it_is_refused(tmp_path: Path) -> None:
    """Overruled by geoms, made by `replicate`, a shortcut without the word, no XML."""
    text = CRAWLER.format(**USUAL)
    text = text.replace('autolimits="true"', 'autolimits="true" inertiafromgeom="true"')
    path = tmp_path / "model.xml"
    path.write_text(text)
    values = {"body/torso/mass": 1.3}
    assert write(file_of(path), values, tmp_path).body("torso").mass[0] == 1.3
    heavy = '<inertial pos="0 0 0" mass="3" diaginertia="1 1 1"/>'
    shin = '<body name="shin" pos=".05 0 -.08">'
    path.write_text(text.replace(shin, shin + heavy))
    with pytest.raises(InputError, match=r"E170 body/shin/mass cannot be written"):
        write(file_of(path), {"body/shin/mass": 0.3}, tmp_path)
    many = """<mujoco><worldbody><replicate count="2" offset="1 0 0">
      <body name="leg"><joint damping="1"/><geom size=".1"/></body>
      </replicate></worldbody></mujoco>"""
    path.write_text(many)
    file = file_of(path)
    for name in ("body/leg0/mass", "joint/joint1/damping"):
        with pytest.raises(InputError, match=r"E170 .* cannot be found.*replicate"):
            file.edited({name: 2.0})
    one = many.replace('count="2"', 'count="1"')
    muscle = '<actuator><cylinder joint="a" area="2"/></actuator></mujoco>'
    one = one.replace("<joint ", '<joint name="a" ').replace("</mujoco>", muscle)
    path.write_text(re.sub("</?replicate[^>]*>", "", one))
    with pytest.raises(InputError, match=r"E170 .*gain cannot be written.*cylinder"):
        file_of(path).edited({"actuator/actuator0/gain": 3.0})
    good = mujoco.MjModel.from_xml_string(many)
    for bad in ("<!DOCTYPE a>" + many, many.replace("</mujoco>", "")):
        path.write_text(bad)
        with pytest.raises(InputError, match=r"E170 the file's text cannot be changed"):
            ModelFile(path, good)


URDF = """<robot name="arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 -.2"/><mass value="1"/>
    <inertia ixx=".02" iyy=".02" izz=".001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tip"><inertial><mass value=".1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><mass value=".5"/>
    <inertia ixx=".02" iyy=".03" izz=".04" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="meshes/part.stl"/></geometry></visual>
    <collision><geometry><mesh filename="part.stl"/></geometry></collision></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><dynamics damping=".1" friction=".05"/></joint>
  <joint name="weld" type="fixed"><parent link="upper"/><child link="tip"/>
    <origin xyz="0 0 -.4"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 -.4"/><axis xyz="0 1 0"/></joint>
</robot>
"""
OF_URDF = {
    "joint/shoulder/damping": 0.2,
    "joint/shoulder/frictionloss": 0.07,
    "joint/elbow/damping": 0.3,
    "body/upper/mass": 1.3,
    "body/lower/com_x": 0.02,
    "body/lower/mass": 0.6,
    "body/lower/length": 0.5,
    "option/gravity": 9.7,
}


def tetrahedron() -> bytes:
    """A mesh in binary STL: four triangles."""
    corners = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], "<f4")
    out = b"\0" * 80 + np.uint32(4).tobytes()
    for face in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]):
        out += np.zeros(3, "<f4").tobytes() + corners[face].tobytes() + b"\0\0"
    return out


def urdf(folder: Path) -> Path:
    (folder / "part.stl").write_bytes(tetrahedron())
    (folder / "arm.urdf").write_text(URDF)
    return folder / "arm.urdf"


def test_a_urdf_is_written_in_its_own_words(tmp_path: Path) -> None:
    """Welded links change together; what it has no word for stays, and is named."""
    path = urdf(tmp_path)
    file = ModelFile(path, compiled(path))
    more = {"joint/elbow/armature": 0.01, "actuator/elbow.motor/gain": 2.0}
    edited = file.edited(OF_URDF | more)
    assert set(edited.unsaid) == set(more)
    (tmp_path / "sub").mkdir()
    for folder in (tmp_path, tmp_path / "sub"):
        ((_, name, data),) = file.texts(edited, "new.urdf", folder)
        (folder / name).write_bytes(data)
        (model,) = compiled_all([folder / name])
        file.check(edited, model)
        for constant, value in OF_URDF.items():
            found = file.constants[constant].get(model)
            assert found == pytest.approx(value, rel=1e-9), constant
    (text,) = file.replaced(edited).values()
    lines = set(text.decode().split("\n")) - set(URDF.split("\n"))
    assert len(lines) == 10


def test_a_urdf_as_mjcf_has_its_motors_and_meshes(tmp_path: Path) -> None:
    """Of two draws, in another folder; the source is compiled once for all."""
    path = urdf(tmp_path)
    file = ModelFile(path, compiled(path), mjcf=True)
    draws = [OF_URDF | {"actuator/elbow.motor/gain": gain} for gain in (2.0, 3.0)]
    out = tmp_path / "sub"
    out.mkdir()
    edits = [file.edited(values) for values in draws]
    for i, edited in enumerate(edits):
        for _, name, data in file.texts(edited, f"v{i}.xml", out):
            (out / name).write_bytes(data)
    models = compiled_all([out / "v0.xml", out / "v1.xml"])
    for edited, values, model in zip(edits, draws, models, strict=True):
        file.check(edited, model)
        assert model.nu == 2
        assert model.nmesh == 1
        for constant, value in values.items():
            found = file.constants[constant].get(model)
            assert found == pytest.approx(value, rel=1e-5), constant
