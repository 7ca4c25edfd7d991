"""Bad inputs 91 to 96: MuJoCo models."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from crawler import CRAWLER, URDF, USUAL, written
from hostile_models import tetrahedron
from sim2gp import systems as sy
from tests.catalogue.bad_inputs import Case, Input, Patch, case

TEXT = CRAWLER.format(**USUAL)
FLOATING = """
<mujoco><worldbody>
  <body><freejoint name="base"/><geom size="1"/></body>
</worldbody></mujoco>
"""
Files = Mapping[str, str | bytes]


def files(
    key: str,
    content: Files,
    *said: str,
    constants: list[Any] | None = None,
    then: Callable[[sy.MuJoCo], object] = lambda system: None,
) -> Input:
    """A folder of files; the first is the model."""

    def make(folder: Path, patch: Patch) -> None:
        pytest.importorskip("mujoco")
        for name, data in content.items():
            path = folder / "model" / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data.encode() if isinstance(data, str) else data)
        options = {} if constants is None else {"constants": constants}
        then(sy.MuJoCo(folder / "model" / next(iter(content)), **options))

    return Input(key, said, make)


def model(key: str, text: str, *said: str, **options: Any) -> Input:
    return files(key, {"model.xml": text}, *said, **options)


def in_memory(key: str, text: str, *said: str, patch: Any = None, **options: Any):
    """A model without a file; skipped where this MuJoCo does not know it."""

    def make(folder: Path, patched: Patch) -> None:
        mujoco = pytest.importorskip("mujoco")
        try:
            made = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            pytest.skip(f"not in MuJoCo {mujoco.__version__}: {error}")
        if patch is not None:
            patch(patched, mujoco)
        sy.MuJoCo(made, **options)

    return Input(key, said, make)


# Numbers


def not_finite() -> Iterator[Input]:
    """The file, the line, the element and the attribute are named."""
    places = (
        ('mass=".1"', 'mass="NUMBER"', "mass of geom"),
        ('kv=".2"', 'kv="NUMBER"', "kv of position"),
        ('pos="0 0 .12"', 'pos="0\n NUMBER 0"', "pos of body"),
        ('damping=".02"', 'damping=" NUMBER"', "damping of joint"),
    )
    mass = '<mass value="1"/>'
    for number in ("nan", "-NaN", "nan(7)", "inf", "Infinity", "1e999"):
        for old, new, what in places:
            line = TEXT[: TEXT.rindex("<", 0, TEXT.index(old))].count("\n") + 1
            text = TEXT.replace(old, new.replace("NUMBER", number))
            where = f"model.xml:line {line}:"
            yield model("attribute_not_finite", text, what, where)
        text = URDF.replace(mass, f'<mass value="{number}"/>')
        said = "value of mass", "urdf:line 4"
        yield files("attribute_not_finite", {"arm.urdf": text}, *said)


HUGE = FLOATING.replace('<freejoint name="base"/>', "<joint/>").replace(
    '<geom size="1"/>', '<geom density="1e300" size="1e9"/>'
)

# Files


def outside(content: Files, *said: str) -> Input:
    """A file beside the model's folder, which MuJoCo would read."""
    given = files("file_outside_model_folder", content, *said)

    def make(folder: Path, patch: Patch) -> None:
        (folder / "secret.xml").write_text("<mujoco/>")
        given.make(folder, patch)

    return Input(given.key, given.words, make)


def dying(code: str, got: str) -> Input:
    """A parser that does not come back."""

    def make(folder: Path, patch: Patch) -> None:
        from sim2gp.systems.mujoco import load

        child = folder / "child.py"
        child.write_text(code)
        patch.setattr(load, "_CHILD", str(child))
        patch.setattr(load, "SECONDS", 1)
        sy.MuJoCo(written(folder, TEXT))

    return Input("parser_died", ("model.xml", got), make)


def without(package: str) -> Input:
    def make(folder: Path, patch: Patch) -> None:
        patch.setitem(__import__("sys").modules, package, None)
        sy.MuJoCo(written(folder, TEXT))

    return Input("missing_extra", (package, "pip install 'sim2gp[mujoco]'"), make)


def larger(folder: Path, patch: Patch) -> None:
    from sim2gp.systems.mujoco import sources

    patch.setattr(sources, "_BYTES", 100)
    sy.MuJoCo(written(folder, TEXT))


SECRET = '<mujoco><include file="../secret.xml"/></mujoco>'
PART = '<include file="{0}/{0}.xml"/>'
NAMED = '<mujoco><asset><mesh name="{}" file="x.stl"/></asset></mujoco>'
MESH = """<mujoco><asset><mesh name="m" file="p//x.stl"/></asset>
<worldbody><body><joint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>"""
STL = tetrahedron(0.1)

# What is not supported

Q = '<joint name="q" damping=".1"/><geom size=".1" pos=".3 0 0" mass="1"/>'
PAIR = """<mujoco model="pair">{option}
<worldbody>
  <body name="one">{one}</body>
  <body name="two" pos="0 0 .5">{two}</body>{body}
</worldbody>{more}</mujoco>"""
TWO = {"option": "", "one": Q, "two": Q.replace('"q"', '"p"'), "body": "", "more": ""}
CLOTH = """<flexcomp type="grid" count="3 3 1" spacing=".1 .1 .1" name="cloth" dim="2"
radius=".01"><edge equality="true"/></flexcomp>"""
PLUGIN = """<extension><plugin plugin="mujoco.pid"><instance name="g"/></plugin>
</extension><actuator><plugin plugin="mujoco.pid" instance="g" joint="q"/></actuator>"""
DELAYED = """<mujoco><worldbody><body><joint name="q"/><geom size=".1" mass="1"/></body>
</worldbody><actuator><motor joint="q"/><motor name="late" joint="q" {actuator}/>
</actuator><sensor><jointpos name="seen" joint="q" {sensor}/></sensor></mujoco>"""


def pair(key: str, *said: str, **parts: str) -> Input:
    return in_memory(key, PAIR.format(**TWO | parts), *said)


def actuator(key: str, text: str, *said: str) -> Input:
    return pair(key, *said, more=f"<actuator>{text}</actuator>")


def newer(patch: Patch, mujoco: Any) -> None:
    """A MuJoCo that is newer than our checks."""
    size = mujoco.mj_stateSize
    patch.setattr(mujoco, "mj_stateSize", lambda *x: size(*x) + 3)


CART = """<mujoco>{option}<worldbody><body name="c" simple="false">
  <joint name="x" type="slide" axis="1 0 0" damping="1" frictionloss=".1"/>{joint}
  <geom name="g" size=".1" mass="1"/></body></worldbody>{more}
  <actuator><motor name="u" joint="x" gear="2"/></actuator></mujoco>"""
TENDON = '<tendon><fixed name="t"><joint joint="x" coef="1"/></fixed></tendon>'


def by_mjx(constant: str, got: str, **parts: str) -> Input:
    text = CART.format(**{"option": "", "joint": "", "more": ""} | parts)
    said = (got, "engine")
    return in_memory(
        "unsupported_by_mjx", text, *said, constants=[constant], engine="mjx"
    )


# Constants

BALL = '<mujoco><worldbody><body name="b"{}><joint/><geom size=".1"/></body>{}'
BALL = BALL.format("{}", "</worldbody></mujoco>")

MODELS: tuple[Case, ...] = (
    case(
        91,
        "MuJoCo: text, names, numbers",
        model("not_plain_xml", "<mujoco><worldbody></mujoco>", "xml:line 1", "tag mis"),
        model("joint_with_quaternion", FLOATING, "got base"),
        model("unknown_model_constant", TEXT, constants=["joint/hip/dampin"]),
        model("compiled_number_not_finite", HUGE, "got inf in body_"),
        model("model_not_compiled", TEXT.replace('joint="hip"', 'joint="hop"'), "hop"),
        *not_finite(),
    ),
    case(
        92,
        "MuJoCo: files",
        outside(
            {
                "model.xml": '<mujoco><compiler meshdir=".."/><asset>'
                '<mesh file="secret.xml"/></asset></mujoco>'
            },
            "meshdir",
        ),
        outside({"model.xml": SECRET}, "include"),
        outside(
            {"model.xml": '<mujoco><include file="/etc/passwd"/></mujoco>'},
            "/etc/passwd",
        ),
        outside(
            {
                "model.xml": '<mujoco><include file="part.xml"/></mujoco>',
                "part.xml": SECRET,
            },
            "part.xml",
        ),
        files(
            "two_files_of_one_name",
            {
                "model.xml": "<mujoco>"
                + PART.format("one")
                + PART.format("two")
                + "</mujoco>",
                "one/one.xml": NAMED.format("one"),
                "one/x.stl": STL,
                "two/two.xml": NAMED.format("two"),
                "two/x.stl": tetrahedron(0.2),
            },
            "two.xml:line 1",
        ),
        files("empty_part_in_path", {"m.xml": MESH, "p/x.stl": STL}, "p//x.stl"),
        files(
            "missing_model_part",
            {"m.xml": '<mujoco><include file="no.xml"/></mujoco>'},
            "no.xml",
        ),
        dying("import os, signal; os.kill(os.getpid(), signal.SIGSEGV)", "exit -11"),
        dying("import time; time.sleep(30)", "no answer"),
        Input(
            "unreadable_file",
            ("none.xml",),
            lambda folder, patch: sy.MuJoCo(folder / "none.xml"),
        ),
        Input("large_model", ("model.xml",), larger),
        without("lxml"),
    ),
    case(
        93,
        "MuJoCo: unsupported",
        pair(
            "joint_with_quaternion",
            "got base (free)",
            one='<freejoint name="base"/><geom size=".1"/>',
        ),
        pair(
            "joint_with_quaternion",
            "got hip (ball)",
            one='<joint type="ball" name="hip"/><geom size=".1"/>',
        ),
        pair("model_without_joints", "got model pair", one="", two=""),
        pair("mocap_body", "got hand", body='<body name="hand" mocap="true"/>'),
        pair("deformable_body", "got flex cloth", body=CLOTH),
        actuator(
            "actuator_of_unknown_type",
            '<dcmotor name="m" joint="q" motorconst=".1" resistance="1"/>',
            "dyntype dcmotor: got m,",
        ),
        actuator(
            "actuator_of_unknown_type",
            '<pid name="m" joint="q" kp="1"/>',
            "gaintype pid: got m,",
        ),
        actuator(
            "actuator_of_unknown_type",
            '<general name="m" joint="q" dyntype="user" actdim="2"/>',
            "dyntype user: got m,",
        ),
        pair("bodies_that_sleep", option='<option><flag sleep="enable"/></option>'),
        pair("model_with_plugin", "got plugin g", more=PLUGIN),
        pair(
            "spring_that_yields",
            "of q",
            one='<joint name="q" stiffness="3" springyield="1"/><geom size=".1"/>',
        ),
        in_memory(
            "state_beyond_activations",
            PAIR.format(**TWO),
            "3 more numbers",
            patch=newer,
        ),
    ),
    case(
        94,
        "MuJoCo: a delay of its own",
        *[
            given
            for said in ('delay="0.1" nsample="5"', 'nsample="5"')
            for given in (
                in_memory(
                    "delay_of_its_own",
                    DELAYED.format(actuator=said, sensor=""),
                    "late",
                ),
                in_memory(
                    "delay_of_its_own",
                    DELAYED.format(actuator="", sensor=said),
                    "nsample of seen",
                ),
            )
        ],
    ),
    case(
        95,
        "MuJoCo: unsupported by MJX",
        by_mjx("joint/x/damping", "IMPLICIT", option='<option integrator="implicit"/>'),
        by_mjx("joint/x/damping", "PGS", option='<option solver="PGS"/>'),
        by_mjx(
            "body/c/inertia",
            "inertia",
            joint='<joint axis="0 1 0"/><geom size=".2"/>',
        ),
        by_mjx("body/c/mass", "tendons", more=TENDON),
    ),
    case(
        96,
        "MuJoCo: constants",
        in_memory(
            "constant_and_its_inertia",
            BALL.format(' simple="false"'),
            "body/b/com_x",
            constants=["body/b/inertia", "body/b/com_x"],
        ),
        in_memory(
            "centre_of_simple_body",
            BALL.format(""),
            "body/b/inertia/alpha",
            constants=["body/b/inertia"],
        ),
        model("no_default_prior", TEXT, "joint/z/damping", constants=["joint/*/d*g"]),
    ),
)
