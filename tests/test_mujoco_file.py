"""MuJoCo models as files: read in a child process, and refused."""

import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim2gp import systems as sy
from sim2gp.errors import InputError, Sim2GPWarning
from sim2gp.systems.mujoco import compile_child as mjcf_child
from sim2gp.systems.mujoco import load as mjcf_load

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
        (
            "<mujoco><worldbody></mujoco>",
            r"E170 no model in .*model\.xml:line 1: got .*tag mismatch",
        ),
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
        (mesh, "meshdir outside"),
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


@pytest.mark.parametrize(
    "number", ["nan", "-NaN", "nan(7)", "inf", "Infinity", "1e999"]
)
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


def test_a_name_is_no_number(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.replace("shoulder", "nan"))
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
    own = Path(mjcf_load.__file__).with_name("compile_child.py").read_text()
    more = (
        "    import warnings as w\n"
        "    w.warn('soft\\nElement geom, line 7')\n"
        "    text = '<mujoco><option gravity=\"nan 0 0\"/></mujoco>'\n"
        "    mujoco.MjSpec.from_string(text)\n"
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


DELAYED = """<mujoco>
<worldbody><body><joint name="q"/><geom size=".1"/></body></worldbody>
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
    seen = mujoco.MjModel.from_xml_string(DELAYED.format(actuator="", sensor=said))
    with pytest.raises(InputError, match=r"E172 sensor.*nsample of seen"):
        sy.MuJoCo(seen)
    plain = mujoco.MjModel.from_xml_string(DELAYED.format(actuator="", sensor=""))
    assert [c.name for c in sy.MuJoCo(plain).actions] == ["actuator0", "late"]


def test_limits_are_set_where_they_can_be_and_never_raised(tmp_path, monkeypatch):
    """A system without limits, one that refuses them, and one with lower ones."""
    for fake in (
        None,
        SimpleNamespace(),
        SimpleNamespace(
            RLIMIT_AS=5,
            RLIMIT_CPU=0,
            RLIMIT_NOFILE=7,
            RLIM_INFINITY=-1,
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
        RLIMIT_AS=5,
        RLIM_INFINITY=-1,
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
    """As after `ulimit -v`, where no process may raise it again."""
    path = written(tmp_path, CRAWLER.format(**USUAL))
    code = (
        "import pathlib, sys; from sim2gp.systems.mujoco.load import compiled;"
        "print(compiled(pathlib.Path(sys.argv[1])).njnt)"
    )
    command = [sys.executable, "-c", code, str(path)]
    limited = ["sh", "-c", 'ulimit -v 7000000; exec "$0" "$@"', *command]
    done = subprocess.run(limited, capture_output=True, text=True)
    assert (done.stdout, done.returncode) == ("4\n", 0), done.stderr[-2000:]


def test_without_lxml_the_extra_is_named(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "lxml", None)
    with pytest.raises(
        InputError, match=r"E135 .*lxml.*pip install 'sim2gp\[mujoco\]'"
    ):
        sy.MuJoCo(written(tmp_path, CRAWLER.format(**USUAL)))
