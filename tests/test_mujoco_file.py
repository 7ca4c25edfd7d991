"""MuJoCo models as files: read in a child process, and refused."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hostile_models import tetrahedron
from sim2gp import systems as sy
from sim2gp.errors import InputError, Sim2GPWarning
from sim2gp.systems import mjcf_child, mjcf_load
from sim2gp.systems.mjcf_sources import Sources, read_sources

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
        ("<mujoco><worldbody></mujoco>", r"E170 no model in .*model\.xml:line 1: got .*tag mismatch"),
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


MESH = """<mujoco><compiler {compiler}/><asset><mesh name="m" {mesh}/></asset>
<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
#: Attributes of the compiler and of a mesh that lead to ../secret.stl.
SPELLED = {
    "a reference": ('meshdir="&#46;."', 'file="secret.stl"'),
    "a hexadecimal one": ('assetdir=".&#x2e;"', 'file="secret.stl"'),
    "zeros": ('assetdir=".&#x0002E;"', 'file="secret.stl"'),
    "a bracket before": ("", 'class="a>b" file="../secret.stl"'),
    "in the file's name": ("", 'file="&#x2e;&#x2e;&#47;secret.stl"'),
    "backslashes": ("", r'file="..\secret.stl"'),
    "a link": ("", 'file="link.stl"'),
    "stripped": ('meshdir=".." strippath="true"', 'file="any/secret.stl"'),
}


@pytest.mark.parametrize("spelling", SPELLED)
def test_no_spelling_of_a_path_leads_outside(tmp_path: Path, spelling: str) -> None:
    """Whatever an XML parser makes of it: the mesh lies next to the folder, and loads."""
    (tmp_path / "secret.stl").write_bytes(tetrahedron(0.1))
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "link.stl").symlink_to("../secret.stl")
    compiler, mesh = SPELLED[spelling]
    path = written(folder, MESH.format(compiler=compiler, mesh=mesh))
    with pytest.raises(InputError, match=r"E171 .* outside the model's folder"):
        mjcf_load.compiled(path)
    if "class" not in mesh:
        assert mjcf_load.compiled(path, tmp_path).nmesh == 1
    part = f"<include {mesh.replace('class', 'x').replace('.stl', '.xml')}/>"
    path.write_text(f"<mujoco>{part}</mujoco>")
    with pytest.raises(InputError, match=r"E17[01] (include outside|no model)"):
        mjcf_load.compiled(path)


#: Where MuJoCo looks for the files of each: main text, parts by name, meshes by size.
LAYOUTS = {
    "folders": (
        '<compiler meshdir="a//b/.." assetdir="c"/><asset><mesh name="m" '
        'file="./p/x.stl"/><mesh name="n" file="q\\x.stl"/></asset>',
        {},
        {"a/p/x.stl": 0.1, "a/q/x.stl": 0.2, "x.stl": 0.3, "c/x.stl": 0.4},
    ),
    "assetdir": (
        '<compiler assetdir="c"/><asset><mesh name="m" file="x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "x.stl": 0.2},
    ),
    "a later compiler": (
        '<compiler assetdir="c"/><compiler meshdir="d"/><asset>'
        '<mesh name="m" file="x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "d/x.stl": 0.2},
    ),
    "strippath": (
        '<compiler strippath="true" meshdir="c"/><asset>'
        '<mesh name="m" file="far/off/x.stl"/></asset>',
        {},
        {"c/x.stl": 0.1, "c/far/off/x.stl": 0.2},
    ),
    "parts of parts": (
        '<include file="sub/one.xml"/>',
        {
            "sub/one.xml": '<asset><mesh name="m" file="x.stl"/></asset>'
            '<include file="deep/two.xml"/>',
            "sub/deep/two.xml": '<asset><mesh name="n" file="y.stl"/></asset>',
        },
        {"sub/x.stl": 0.1, "sub/deep/y.stl": 0.2, "y.stl": 0.3},
    ),
    "a part's own folder": (
        '<include file="sub/one.xml"/>',
        {"sub/one.xml": '<compiler meshdir="d"/><asset><mesh name="m" file="x.stl"/>'
         "</asset>"},
        {"d/sub/x.stl": 0.1, "sub/d/x.stl": 0.2, "sub/x.stl": 0.3},
    ),
    "another model": (
        '<compiler meshdir="d"/><asset><mesh name="m" file="x.stl"/>'
        '<model name="k" file="sub/k.xml"/></asset>',
        {"sub/k.xml": '<compiler meshdir="e"/><asset><mesh name="n" file="x.stl"/>'
         '</asset><worldbody><body name="b"><joint/><geom type="mesh" mesh="n"/></body>'
         "</worldbody>"},
        {"d/x.stl": 0.1, "sub/e/x.stl": 0.2, "x.stl": 0.3, "e/x.stl": 0.4},
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_files_are_found_where_mujoco_finds_them(tmp_path: Path, layout: str) -> None:
    """The same model as MuJoCo makes of the folder itself."""
    text, parts, meshes = LAYOUTS[layout]
    used = [f'<body><joint/><geom type="mesh" mesh="{n}"/></body>' for n in ("m", "n")]
    used = used[: 1 + ('"n"' in text + "".join(parts.values()))]
    if layout == "another model":
        used[1] = '<attach model="k" body="b" prefix="k"/>'
    for name, inner in parts.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"<mujoco>{inner}</mujoco>")
    for name, size in meshes.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(tetrahedron(size))
    for name in ("a/b", "sub"):
        (tmp_path / name).mkdir(parents=True, exist_ok=True)
    whole = f"<mujoco>{text}<worldbody>{''.join(used)}</worldbody></mujoco>"
    path = written(tmp_path, whole)
    expected = mujoco.MjModel.from_xml_path(str(path))
    found = mjcf_load.compiled(path)
    assert found.nmesh == expected.nmesh == len(used)
    np.testing.assert_array_equal(found.body_mass, expected.body_mass)
    np.testing.assert_array_equal(found.mesh_vert, expected.mesh_vert)


def test_files_that_mujoco_could_confuse_are_refused(tmp_path: Path) -> None:
    """Two parts with a mesh of one name, each in its own folder."""
    for name, size in (("one", 0.1), ("two", 0.2)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.stl").write_bytes(tetrahedron(size))
        text = f'<mujoco><asset><mesh name="{name}" file="x.stl"/></asset></mujoco>'
        (tmp_path / name / f"{name}.xml").write_text(text)
    text = '<include file="one/one.xml"/><include file="two/two.xml"/>'
    path = written(tmp_path, f"<mujoco>{text}</mujoco>")
    with pytest.raises(InputError, match=r"E172 two files of one name.*two\.xml:line 1"):
        mjcf_load.compiled(path)


def test_forms_that_mujoco_reads_though_they_are_not_xml(tmp_path: Path) -> None:
    """Rules of hyphens in comments, a blank line first, a prefix without namespace."""
    text = CRAWLER.format(**USUAL)
    rules = "<!-- ---- the robot ---- -->\n"
    text = '\n<?xml version="1.0"?>' + text.replace("<worldbody>", rules + "<worldbody>")
    assert mjcf_load.compiled(written(tmp_path, text)).njnt == 4
    many = written(tmp_path, text.replace(rules, 101 * rules + "<body"))
    with pytest.raises(InputError, match="E170 no model"):
        mjcf_load.compiled(many)
    for bad in ('<!DOCTYPE mujoco [<!ENTITY a "b">]>', "<?run me?>"):
        path = written(tmp_path, bad + CRAWLER.format(**USUAL).strip())
        with pytest.raises(InputError, match="E170 no model.*(document type|<[?]run)"):
            mjcf_load.compiled(path)


@pytest.mark.parametrize("number", ["nan", "-NaN", "nan(7)", "inf", "Infinity", "1e999"])
def test_a_number_that_is_not_finite_is_refused(tmp_path: Path, number: str) -> None:
    """The file, the line, the element and the attribute are named."""
    text = CRAWLER.format(**USUAL)
    for old, new, what in (
        ('mass=".1"', f'mass="{number}"', "mass of geom"),
        ('kv=".2"', f'kv="{number}"', "kv of position"),
        ('pos="0 0 .12"', f'pos="0\n {number} 0"', "pos of body"),
        ('damping=".02"', f'damping=" {number}"', "damping of joint"),
    ):
        path = written(tmp_path, text.replace(old, new))
        line = text[: text.rindex("<", 0, text.index(old))].count("\n") + 1
        where = re.escape(f"E170 {what} is not finite in {path}:line {line}: got ")
        with pytest.raises(InputError, match=where):
            sy.MuJoCo(path)
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.replace('<mass value="1"/>', f'<mass value="{number}"/>'))
    with pytest.raises(InputError, match=r"E170 value of mass is not .*urdf:line 4"):
        sy.MuJoCo(path)
    path.write_text(URDF.replace("shoulder", "nan"))  # a name is no number
    assert sy.MuJoCo(path).channels[0].name == "nan"


def test_numbers_that_become_infinite_are_refused(tmp_path: Path) -> None:
    huge = 'density="1e300" size="1e9"'
    text = FLOATING.replace('<freejoint name="base"/>', "<joint/>")
    text = text.replace('<geom size="1"/>', f"<geom {huge}/>")
    with pytest.raises(InputError, match=r"E170 .* not finite: got inf in body_"):
        sy.MuJoCo(written(tmp_path, text))


def test_what_mujocos_compiler_warns_of_is_a_warning(tmp_path: Path) -> None:
    """Those of a handler, of Python and of the error stream; once each, by file."""
    path = tmp_path / "arm.urdf"
    ball = '<collision name="k"><geometry><sphere radius=".1"/></geometry></collision>'
    path.write_text(URDF.replace("</inertial></link>", f"</inertial>{2 * ball}</link>"))
    with pytest.warns(Sim2GPWarning) as warned:
        sy.MuJoCo(path)
    (line,) = [str(each.message) for each in warned]
    assert line.startswith(f"W170 {path}: Geom with duplicate name 'k'")


def test_a_warning_names_the_line_that_mujoco_names(tmp_path: Path, monkeypatch):
    """Whatever way MuJoCo takes to say it."""
    child = tmp_path / "child.py"
    own = Path(mjcf_load.__file__).with_name("mjcf_child.py").read_text()
    more = (
        "    import warnings as w\n"
        "    w.warn('soft\\nElement geom, line 7')\n"
        "    mujoco.MjSpec.from_string('<mujoco><option gravity=\"nan 0 0\"/></mujoco>')\n"
        "    import numpy as np\n"
    )
    assert own.count("    import numpy as np\n") == 1
    child.write_text(own.replace("    import numpy as np\n", more))
    monkeypatch.setattr(mjcf_load, "_CHILD", str(child))
    path = written(tmp_path, CRAWLER.format(**USUAL))
    with pytest.warns(Sim2GPWarning) as warned:
        mjcf_load.compiled(path)
    assert [str(each.message) for each in warned] == [
        f"W170 {path}:line 7: soft Element geom, line 7",
        f"W170 {path}: XML contains a 'NaN'. Please check it carefully.",
    ]


DELAYED = """<mujoco><worldbody><body><joint name="q"/><geom size=".1"/></body></worldbody>
<actuator><motor joint="q"/><motor name="late" joint="q" {actuator}/></actuator>
<sensor><jointpos name="seen" joint="q" {sensor}/></sensor></mujoco>"""


@pytest.mark.parametrize("said", ['nsample="8" delay=".01"', 'nsample="4"'])
def test_an_actuator_with_its_own_delay_is_refused_by_name(tmp_path: Path, said: str):
    """MuJoCo keeps its past inputs in the state, which has no channels for them."""
    late = DELAYED.format(actuator=said, sensor="")
    try:
        mujoco.MjModel.from_xml_string(late)
    except ValueError:
        pytest.skip("MuJoCo before 3.5")
    with pytest.raises(InputError, match=r'E172 actuator.*late.*\[actuators."late"\]'):
        sy.MuJoCo(written(tmp_path, late))
    seen = DELAYED.format(actuator="", sensor=said)
    with pytest.raises(InputError, match=r"E172 sensor.*nsample of seen"):
        sy.MuJoCo(written(tmp_path, seen))
    plain = sy.MuJoCo(written(tmp_path, DELAYED.format(actuator="", sensor="")))
    assert [c.name for c in plain.actions] == ["actuator0", "late"]


def _child(tmp_path: Path, **kwargs) -> subprocess.CompletedProcess:
    """The child process itself, on one model."""
    path = written(tmp_path, CRAWLER.format(**USUAL))
    mjcf_load._hand_over(tmp_path, 0, ".xml", read_sources(path, tmp_path))
    command = [sys.executable, "-I", mjcf_load._CHILD, "60", str(tmp_path), "mjb", "1"]
    return subprocess.run(command, capture_output=True, text=True, **kwargs)


def test_limits_are_set_where_they_can_be_and_never_raised(tmp_path, monkeypatch):
    """A system without limits, one that refuses them, and one with lower ones."""
    for fake in (
        None,
        SimpleNamespace(),
        SimpleNamespace(
            RLIMIT_AS=5, RLIMIT_CPU=0, RLIMIT_NOFILE=7, RLIM_INFINITY=-1,
            getrlimit=lambda kind: (-1, -1),
            setrlimit=_raising(ValueError("current limit exceeds maximum limit")),
        ),
        SimpleNamespace(
            RLIMIT_AS=5, RLIM_INFINITY=-1, getrlimit=_raising(OSError(22, "no"))
        ),
    ):
        monkeypatch.setitem(sys.modules, "resource", fake)
        mjcf_child.limit("RLIMIT_AS", 8 << 30)
        mjcf_child.seal()
    asked = []
    low = SimpleNamespace(
        RLIMIT_AS=5, RLIM_INFINITY=-1,
        getrlimit=lambda kind: (3 << 30, 6 << 30),
        setrlimit=lambda kind, limits: asked.append((kind, limits)),
    )
    monkeypatch.setitem(sys.modules, "resource", low)
    mjcf_child.limit("RLIMIT_AS", 8 << 30)
    mjcf_child.limit("RLIMIT_AS", 1 << 30)
    assert asked == [(5, (3 << 30, 3 << 30)), (5, (1 << 30, 1 << 30))]


def _raising(error: Exception):
    def call(*_: object) -> None:
        raise error

    return call


@pytest.mark.skipif(sys.platform == "win32", reason="no limits")
def test_a_model_loads_under_a_lower_limit_of_memory(tmp_path: Path) -> None:
    """As after `ulimit -v`: raising it again is not permitted."""
    import resource

    def lower() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (5 << 30, 5 << 30))

    done = _child(tmp_path, preexec_fn=lower)
    assert (done.returncode, done.stderr) == (0, "MODEL 0\n")
    assert (tmp_path / "0.mjb").stat().st_size > 1000


@pytest.mark.skipif(sys.platform == "win32", reason="no limits")
def test_the_child_opens_no_file_after_it_has_read_its_own(tmp_path: Path) -> None:
    """A text that names a file, past the guard: the compiler gets nothing of it."""
    (tmp_path / "x.stl").write_bytes(tetrahedron(0.1))
    text = MESH.format(compiler="", mesh=f'file="{tmp_path}/x.stl"')
    mjcf_load._hand_over(tmp_path, 0, ".xml", Sources(text.encode()))
    command = [sys.executable, "-I", mjcf_load._CHILD, "60", str(tmp_path), "mjb", "1"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3
    assert re.search(r"REFUSED Error.*x\.stl", done.stderr)
