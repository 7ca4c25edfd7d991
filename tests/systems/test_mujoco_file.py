"""MuJoCo models as files: read in a child process, and refused."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from crawler import CRAWLER, URDF, USUAL, written
from sim2gp import systems as sy
from sim2gp.errors import InputError, Sim2GPWarning
from sim2gp.systems.mujoco import compile_child as mjcf_child
from sim2gp.systems.mujoco import load as mjcf_load

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")


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


def test_an_include_in_a_comment_is_none(tmp_path):
    include = '<mujoco><include file="../secret.xml"/></mujoco>'
    text = CRAWLER.format(**USUAL)
    text = text.replace("<compiler", f"<!-- {include} --><compiler")
    sy.MuJoCo(written(tmp_path, text), ["body/torso/mass"])


def test_a_name_is_no_number(tmp_path: Path) -> None:
    path = tmp_path / "arm.urdf"
    path.write_text(URDF.replace("shoulder", "nan"))
    assert sy.MuJoCo(path).channels[0].name == "nan"


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
        mjcf_child.forbid_files()
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
