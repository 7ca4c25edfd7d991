"""Bad inputs 115 to 119: streams of messages, budgets, columns and clocks."""

import json
import sqlite3
import struct
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bombs
import recordings as rec
from recordings import Channel, numbers, write_streams
from sim2gp.data.logs import Budget, Column, Resample, columns_of, read_log
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.definitions import parse_definition
from sim2gp.data.logs.units import unit_factor
from sim2gp.data.split_log import measured_states
from sim2gp.systems import CartPole
from tests.catalogue.bad_formats import recording
from tests.catalogue.bad_inputs import (
    IDENTIFY,
    PROJECT,
    TEXTS,
    Case,
    Input,
    Patch,
    case,
    refusal,
)

STATES = (Channel("q", "rad", angle=True), Channel("x", "m"))
ACTIONS = (Channel("u", "V"),)
ARM = 0.004 + 0.01 * np.arange(30)
CMD = 0.004 * np.arange(80)
Q, U = numbers("q", np.sin(ARM)), numbers("u", np.cos(CMD))
STREAMS = {"/arm": (ARM, Q), "/cmd": (CMD, U)}
OF_STREAMS = {"q": Column("/arm/q"), "u": Column("/cmd/u")}


def streams(
    key: str,
    changes: dict[str, Any],
    *said: str,
    columns: Any = OF_STREAMS,
    **options: Any,
) -> Input:
    """Two topics in JSON, of which some are others."""

    def make(folder: Path, patch: Patch) -> None:
        pytest.importorskip("mcap")
        path = write_streams(folder / "a.mcap", STREAMS | changes)
        read_log(path, columns, states=STATES, actions=ACTIONS, **options)

    return Input(key, said, make)


def joints(names: list[str], position: list[float]) -> tuple[np.ndarray, list[Any]]:
    said = {"name": names, "position": position}
    return ARM, [{"name": ["left"], "position": [1.0]}, *[said] * (len(ARM) - 1)]


#: Two arms on one topic are two streams, until a message has both.
ALONE = [{"name": [name], "position": [1.0]} for name in ("left", "right")]
BOTH = {"name": ["left", "right"], "position": [0.0, 0.0]}
LEFT = {"q": Column("/arm/left/position"), "u": Column("/cmd/u")}


def messages(key: str, encoding: str, schema: str, *said: str) -> Input:
    """One message of a topic whose schema is another."""

    def make(folder: Path, patch: Patch) -> None:
        pytest.importorskip("mcap")
        head = struct.pack("<H", 1) + bombs.text("robot/msg/Arm") + bombs.text(encoding)
        message = bombs.record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + bytes(12))
        records = (
            bombs.record(3, head + bombs.text(schema)),
            bombs.channel("/arm", "cdr"),
        )
        content = bombs.mcap(*records, message, profile="ros2")
        (folder / "a.mcap").write_bytes(content)
        columns_of(folder / "a.mcap") if not said else read(folder / "a.mcap")

    return Input(key, said, make)


def read(path: Path, name: str = "/arm/q", **options: Any) -> object:
    states, actions = (Channel("q", "m"),), (Channel("u", "V"),)
    columns = {"q": Column(name), "u": 0.0}
    return read_log(path, columns, states=states, actions=actions, **options)


def many_objects(folder: Path, patch: Patch) -> None:
    """Lists in a message take more memory than their text: they are kept small."""
    schema = struct.pack("<H", 1) + bombs.text("any") + bombs.text("jsonschema")
    head = bombs.record(3, schema + bombs.text("{}")) + bombs.channel("/arm", "json")
    said = json.dumps({"q": [[]] * 60_000}).encode()
    message = bombs.record(5, struct.pack("<HIQQ", 1, 0, 1, 1) + said)
    (folder / "a.mcap").write_bytes(bombs.mcap(head, message))
    read(folder / "a.mcap", "/arm/q[0]", budget=SMALL)


SMALL = Budget(64 * 2**20, 30.0)  # a piece may have 2 MiB


def chunk(name: str, column: str, write: Callable[[Path], object]) -> Input:
    """What comes out is counted, and not only what the file says of it."""

    def make(folder: Path, patch: Patch) -> None:
        write(folder / name)
        read(folder / name, column, budget=SMALL)

    return Input("beyond_the_budget", (name,), make)


def database(key: str, change: str = "", *said: str, **options: Any) -> Input:
    def make(folder: Path, patch: Patch) -> None:
        path = folder / "a.db3"
        bombs.write_bag(path, "float64 q\n", **options)
        with closing(sqlite3.connect(path)) as base:
            base.execute(change or "SELECT 1")
            base.commit()
        read(path)

    return Input(key, said, make)


#: Views and generated columns would go on while they are read.
ENDLESS = (
    "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) "
    "SELECT i AS id, 1 AS topic_id, i AS timestamp, x'00' AS data FROM n"
)
GENERATED = "CREATE TABLE big(id INTEGER, data BLOB AS (zeroblob(1000000000)))"
#: A type of no bytes at all, of which a message may list many.
LINE = "=" * 80
EMPTY = f"B[] many\n{LINE}\nMSG: robot/B\nC[4000] c\n{LINE}\nMSG: robot/C\n"


def bag(
    key: str, names: tuple[str, ...], *said: str, cut: bool = False, **options: Any
):
    def write(path: Path) -> None:
        pytest.importorskip("rosbags")
        rec.write_bag(path, rec.motion(rows=30), "ros1")
        if cut:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])

    return recording(key, "a.bag", write, *said, names=names, **options)


GONE = ("/joints/elbow/position", "/joint_states/elbow/velocity", "/cmd/data[0]")


def text(key: str, content: str, *said: str) -> Input:
    def make(folder: Path, patch: Patch) -> None:
        (folder / "a.csv").write_text(content)
        columns_of(folder / "a.csv")

    return Input(key, said, make)


LONG = "9" * 200_000  # Python's CSV parser takes 128 KiB for a field


def columns(key: str, given: Any, *said: str, **options: Any) -> Input:
    """Columns of a cart's log that Python asks for."""

    def make(folder: Path, patch: Patch) -> None:
        (folder / "a.csv").write_text(TEXTS)
        cart = CartPole()
        states, actions = cart.physical_states, cart.actions
        read_log(
            folder / "a.csv",
            given,
            states=states,
            actions=actions,
            **{"time": "t"} | options,
        )

    return Input(key, said, make)


X, V = Column("pos"), Column("cmd")


def alone(folder: Path, patch: Patch) -> list[str]:
    """One table has nothing to resample at the clock of others."""
    resample = 'resample = {method = "hold"}\ntime'
    (folder / "project.toml").write_text(PROJECT.replace("time", resample))
    (folder / "a.csv").write_text(TEXTS)
    return [*IDENTIFY]


TICKS: tuple[Callable[[Meter], object], ...] = (
    lambda meter: meter.tick(),
    lambda meter: meter.claim(1),
    lambda meter: meter.spend(1),
    lambda meter: meter.piece(1, "chunk"),
    lambda meter: meter.measure(iter([b""]), 1, "chunk"),
)


def late(act: Callable[[Meter], object]) -> Input:
    """A meter whose seconds are over."""
    return refusal(
        "beyond_the_budget", lambda: act(Meter("a.bag", Budget(seconds=1e-9))), "a.bag"
    )


MESSAGES: tuple[Case, ...] = (
    case(
        115,
        "streams",
        streams(
            "streams_do_not_overlap",
            {"/cmd": (CMD + 100.0, U)},
            "/cmd",
        ),
        streams(
            "streams_do_not_overlap",
            {"/cmd": (CMD + 100.0, U)},
            resample=Resample(period=0.01),
        ),
        streams("no_stream", {}, "mean /cmd", resample=Resample(stamps="/cnd")),
        streams("no_header_stamps", {}, "a.mcap", time="header"),
        streams("no_such_clock", {}, "'stamp'", time="stamp"),
        streams("unit_of_own_clock", {}, time=Column("log", "ms")),
        streams("period_with_stamps", {}, period=0.01),
        streams("column_of_episodes_unneeded", {}, episode="run"),
        streams(
            "field_comes_and_goes",
            {"/arm": (ARM, [*ALONE * 4, BOTH, *ALONE * 11][: len(ARM)])},
            "message 8",
            columns=LEFT | {"x": Column("/arm/right/position")},
        ),
        streams(
            "joint_named_twice",
            {"/arm": joints(["left", "left"], [0.0, 0.0])},
            columns=LEFT,
        ),
        streams(
            "names_and_values_differ",
            {"/arm": joints(["left"], [0.0, 0.0])},
            "1 names, 2 of position",
            columns=LEFT,
        ),
        bag(
            "missing_column",
            ("/joint_states/elbow/position", "/joint_states/elbow/speed", GONE[2]),
            "column /joint_states/elbow/speed",
            "did you mean /joint_states/",
        ),
        bag("missing_column", GONE, "did you mean /joint_states/elbow/position"),
        bag("period_with_stamps", GONE, period=0.01),
        bag("column_of_episodes_unneeded", GONE, episode="run"),
        bag("file_incomplete_or_damaged", GONE, cut=True),
    ),
    case(
        116,
        "messages",
        messages("messages_not_decodable", "ros2idl", "module a { };", "/arm"),
        recording(
            "messages_not_decodable",
            "a.mcap",
            lambda path: rec.write_mcap(path, rec.motion(rows=9), encoding="protobuf"),
            "'protobuf'",
            names=("/arm/elbow/q", "/arm/elbow/dq", "/cmd/u[0]"),
        ),
        Input(
            "no_messages",
            ("a.mcap",),
            lambda folder, patch: columns_of(write_streams(folder / "a.mcap", {})),
        ),
        refusal(
            "message_definition_refused",
            lambda: parse_definition(EMPTY, "robot/Arm", Meter("a.bag")),
        ),
        database("more_than_tables", f"CREATE VIEW more AS {ENDLESS}"),
        database("more_than_tables", GENERATED),
        database(
            "file_incomplete_or_damaged",
            "",
            "checksum",
            digest="RIHS01_" + "0" * 64,
        ),
    ),
    case(
        117,
        "budget of a file",
        chunk(
            "a.h5",
            "q",
            lambda path: bombs.write_hdf5(path, declared=1, mebibytes=200),
        ),
        chunk(
            "a.mcap",
            "/arm/q",
            lambda path: bombs.write_mcap(path, 200, declared=2**20),
        ),
        Input("beyond_the_budget", ("a.mcap",), many_objects),
        *[late(act) for act in TICKS],
        *[
            refusal("budget_not_positive", lambda pair=pair: Budget(*pair))
            for pair in ((0, 1.0), (1, 0.0), (1, float("nan")))
        ],
        *[
            refusal("budget_factor_not_positive", lambda x=x: Budget().times(x))
            for x in (0.0, -1.0, float("inf"), float("nan"))
        ],
    ),
    case(
        118,
        "lines of text",
        text("line_not_split", f"time,{LONG}\n0,1\n1,2\n", "a.csv:line 1"),
        text("line_not_split", f"time,q\n0,1\n1,{LONG}x\n", "a.csv:line 3"),
        text("line_not_split", f'time,q\n0,1\n1,2\n2,"{LONG}"\n', "a.csv:line 4"),
    ),
    case(
        119,
        "columns and clocks from Python",
        columns("unknown_channel", {"y": X, "voltage": V}, "got y"),
        columns("no_column_for_input", {"x": X}, "voltage"),
        columns("nothing_measured", {"voltage": V}, "x"),
        columns(
            "excluded_interval", {"x": X, "voltage": V}, "[2, 1]", exclude=[(2.0, 1.0)]
        ),
        columns("unknown_unit", {"x": Column("pos", "furlong"), "voltage": V}, "furl"),
        refusal(
            "unit_of_another_kind", lambda: unit_factor("deg", "m", "here"), "here"
        ),
        Input("nothing_to_resample", ("a.csv",), alone),
        refusal("unmeasured_state", lambda: measured_states([], CartPole()), "x"),
    ),
)
