"""Message definitions: what reaches rosbags, which builds code from it, is harmless."""

import itertools
import re
import struct
from pathlib import Path
from typing import Any

import pytest

import bombs
from recordings import Channel
from sim2gp.data.logs import Column, read_log
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.definitions import parse_definition
from sim2gp.errors import InputError

#: Python that would leave a folder behind, in the forms that a template may be left by.
RUN = "__import__('os').mkdir('was-run')"
PAYLOADS = (
    RUN,
    f"x = {RUN}",
    f"x: {RUN} = 1",
    f"q'''\n{RUN}\n'''",
    f'q"""\n{RUN}\n"""',
    f"q')]}}\n{RUN}\n#",
    f"q: int\n{RUN}\nclass B:",
    f"{{{RUN}}}",
    f"q\r{RUN}",
    f"q\x0b{RUN}",
    f"q\u2028{RUN}",
    f"q\\\n{RUN}",
    f"q;{RUN}",
    f"q,{RUN}",
    f"[{RUN}]",
    f"q if {RUN} else q",
    f"lambda: {RUN}",
)
#: Where in a definition of the fields q, dq and u it may be put.
PLACES = (
    "float64 {}\nfloat64 q",
    "float64 q {}",
    "float64 q{}",
    "{} q\nfloat64 dq",
    "float64[{}] q",
    "float64[<={}] q",
    "float64[2]{} q",
    "string<={} word\nfloat64 q",
    "float64 {}=1\nfloat64 q",
    "float64 LIMIT={}\nfloat64 q",
    "float64 LIMIT = 1 {}\nfloat64 q",
    "int32 N=0x{}\nfloat64 q",
    "bool YES={}\nfloat64 q",
    "geometry_msgs/{} where\nfloat64 q",
    "{}/Point where\nfloat64 q",
    "a/b/c/{} where\nfloat64 q",
    "Part part\nfloat64 q\n" + "=" * 80 + "\nMSG: robot/Part\nfloat64 {}",
    "Part part\nfloat64 q\n" + "=" * 80 + "\nMSG: robot/Part {}\nfloat64 x",
    "Part part\nfloat64 q\n" + "=" * 80 + "\nMSG: {}\nfloat64 x",
    "Part part\nfloat64 q\n" + "=" * 80 + "\n{}\nfloat64 x",
    "@{}\nfloat64 q",
    "float64[2] q [1, {}]",
)
#: Forms that are no names, numbers or types, without a payload.
ODD = (
    "(float64 q",
    "; float64 q",
    "float64 __class__",
    "float64 _q",
    "float64 q.real",
    "float64 \u0445",  # a letter of another alphabet
    "\uff46loat64 q",
    "float64 1q",
    "float64 q\nfloat64 q",
    "float64 q\nfloat64 q=1",
    "float128 q",
    "wstring q",
    "object q",
    "float64[-1] q",
    "float64[1.5] q",
    "float64[1][2] q",
    "float64[1e9] q",
    "float64[\u0661] q",
    "A q",
    "robot/msg/Arm again",
    "Arm again",
    "float64\u00a0q",
    "MSG: robot/Arm\nfloat64 q",
    "float64 q\n" + "=" * 80 + "\nMSG: robot/Arm\nfloat64 q",
    "float64 q\n" + "=" * 79 + "\nMSG: robot/B\nfloat64 q",
    "float64 q\n" + "=" * 80,
    "float64 X=one",
    "float64 X=",
    "float64 X=--1",
    "time T=1",
    "float64[] X=1",
    "module pkg { struct A { double q; }; };",
    "#include <x>\nstruct A { double q; };",
)
TOO_LARGE = (
    "string[1000000000] q",
    "string[4097] q",
    "float64[9999999999] q",
    "".join(f"float64 q{i}\n" for i in range(5000)),
    "string[4000] a\nstring[4000] b\nfloat64 q",
    "B[300] b\n" + "=" * 80 + "\nMSG: robot/B\nC[300] c\n" + "=" * 80
    + "\nMSG: robot/C\nfloat64 q",
    "# \n" * 600_000 + "float64 q",
)  # fmt: skip
NAMES = (
    f"robot/msg/Arm'{RUN}'",
    f"robot/msg/{RUN}",
    f"robot/msg/Arm\n{RUN}",
    'robot/msg/Arm"""',
    "robot/msg/Arm:\n  x=1\nclass B",
    "../msg/Arm",
    "robot/msg/__init__",
    "robot//Arm",
    "Arm",
    "",
)
FILLER = "structure_needs_at_least_one_member"  # of a message without fields
CANONICAL = re.compile(
    r"MSG: [a-z][a-z0-9_]*/(msg|action)/[A-Za-z][A-Za-z0-9_]*|={80}|"
    r"[A-Za-z0-9_/]+(<=\d+)?(\[(<=)?\d*\])? [A-Za-z][A-Za-z0-9_]*|"
    r"[a-z0-9]+ [A-Z][A-Z0-9_]*=[ -~]+|"
)


@pytest.fixture
def reached(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """Every definition that the parser of rosbags is given."""
    from rosbags.typesys.msg import MSGParser

    monkeypatch.chdir(tmp_path)
    texts: list[str] = []
    whole = MSGParser.specification

    def spy(self: Any) -> Any:
        texts.append(self.text)
        return whole(self)

    monkeypatch.setattr(MSGParser, "specification", spy)
    return texts


def read(path: Path) -> Any:
    states, actions = (Channel("q", "m"),), (Channel("u", "V"),)
    columns = {"q": Column("/arm/q"), "u": 0.0}
    return read_log(path, columns, states=states, actions=actions)


HOSTILE = [
    *(place.format(p) for place, p in itertools.product(PLACES, PAYLOADS)),
    *ODD,
]


def test_no_hostile_definition_reaches_rosbags(
    tmp_path: Path, reached: list[str]
) -> None:
    """Refused in one line, and nothing of it is run."""
    assert len(HOSTILE) > 400
    path = tmp_path / "a.db3"
    for text in HOSTILE:
        path.unlink(missing_ok=True)
        bombs.write_bag(path, text)
        with pytest.raises(InputError, match=r"^E136 ") as caught:
            read(path)
        assert "\n" not in str(caught.value)
        assert not reached, text
    for text in TOO_LARGE:
        path.unlink(missing_ok=True)
        bombs.write_bag(path, text)
        with pytest.raises(InputError, match=r"^E126 .*definition"):
            read(path)
        assert not reached, text[:80]
    for name in NAMES:
        path.unlink(missing_ok=True)
        bombs.write_bag(path, "float64 q", name)
        with pytest.raises(InputError, match=r"^E136 "):
            read(path)
        assert not reached, name
    assert [file.name for file in tmp_path.iterdir()] == ["a.db3"]


def test_what_is_no_part_of_a_type_stays_out(
    tmp_path: Path, reached: list[str]
) -> None:
    """Comments, defaults and texts may say anything: they are not passed on."""
    words = ("x", RUN, "it's", 'a "b"', "\\", "caf\u00e9")
    for word in words:
        (tmp_path / "a.db3").unlink(missing_ok=True)
        text = f"# {word}\nfloat64 q 1.5 # {word}\nstring WORD={word} # {word}\n"
        text += f'string name "one" # {word}\nint32[] n [1, 2]\r\n@key\n\n'
        bombs.write_bag(tmp_path / "a.db3", text)
        with pytest.raises(InputError, match=r"^E125 .*/arm, logged at 0 ns"):
            read(tmp_path / "a.db3")
    assert len(reached) == len(words)
    for text in reached:
        assert RUN not in text
        assert all(CANONICAL.fullmatch(line) for line in text.split("\n")), text


@pytest.mark.parametrize("name", ["ROS1_NOETIC", "ROS2_FOXY", "ROS2_HUMBLE", "LATEST"])
def test_every_message_of_ros_passes(name: str) -> None:
    """Parsed and written again, each makes the fields that it made before."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(getattr(Stores, name))
    version = 1 if name.startswith("ROS1") else 2
    for message in store.fielddefs:
        if "/msg/" not in message:
            continue
        text, _ = store.generate_msgdef(message, version)
        found = parse_definition(text, message, Meter("a.bag"))
        read = get_types_from_msg(found.written(), message)
        assert message in read
        for other, (_, fields) in read.items():
            before = [f for f in store.fielddefs[other][1] if f[0] != FILLER]
            assert fields == before, (message, other)


def test_messages_that_list_messages_are_counted() -> None:
    """A byte may become an object of Python: such messages are kept small."""
    parts = "Part[] parts\n" + "=" * 80 + "\nMSG: robot/Part\nuint8 x"
    for text, nested in (
        (parts, True),
        ("string[] names", True),
        ("float64[] numbers\nstring name", False),
        ("float64[9] numbers", False),
    ):
        assert parse_definition(text, "robot/Arm", Meter("a.bag")).nested is nested
    empty = "B[] many\n" + "=" * 80 + "\nMSG: robot/B\nC[4000] c\n" + "=" * 80
    with pytest.raises(InputError, match="E136"):  # from no bytes at all
        parse_definition(empty + "\nMSG: robot/C\n", "robot/Arm", Meter("a.bag"))


def test_definitions_in_idl_are_refused(tmp_path: Path, reached: list[str]) -> None:
    schema = struct.pack("<H", 1) + bombs.text("robot/msg/Arm")
    schema += bombs.text("ros2idl") + bombs.text(
        "module a { struct B { double q; }; };"
    )
    message = bombs.record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(12))
    records = (bombs.record(3, schema), bombs.channel("/arm", "cdr"), message)
    (tmp_path / "a.mcap").write_bytes(bombs.mcap(*records, profile="ros2"))
    with pytest.raises(InputError, match=r"E136 .*/arm.*IDL"):
        read(tmp_path / "a.mcap")
    assert not reached
