"""Recordings of messages: rosbag1, rosbag2 (sqlite3, MCAP) and MCAP with JSON.

Columns are named by topic and field: ``/imu/angular_velocity/z``, ``/cmd/data[0]``, and
of a joint state by its joint: ``/joint_states/elbow/position``.
"""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

from sim2gp.errors import InputError
from sim2gp.logs.arrays import missing
from sim2gp.logs.file import check_declared, library, readable, shown, steady
from sim2gp.logs.messages import Message, clocked, collected
from sim2gp.logs.table import Table

#: Module -> its error; which of them are there depends on the release of rosbags.
_ERRORS = {
    "apsw": "Error",
    "backports.zstd": "ZstdError",
    "compression.zstd": "ZstdError",
    "mcap.exceptions": "McapError",
    "rosbags.highlevel": "AnyReaderError",
    "rosbags.rosbag1": "ReaderError",
    "rosbags.rosbag2": "ReaderError",
    "rosbags.serde": "SerdeError",
    "rosbags.typesys": "TypesysError",
    "sqlite3": "Error",
    "zstandard": "ZstdError",
}
_COMPRESSED = re.compile(r"^\s*compression_mode:\s*['\"]?file", re.I | re.M)


def read_bag(
    path: Path, kind: str, wanted: Sequence[str] | None, clock: str | None
) -> list[Table]:
    """The wanted fields of a recording, one table for each stream.

    ``clock`` names the stamps, "header" or "log"; None takes those of the headers where
    they are, and the recorder's otherwise. Raises `InputError` E103, E104, E125, E126,
    E135, E136, E140.
    """
    where = shown(path)
    with ExitStack() as stack:
        start, messages = _opened(path, kind, wanted, where, stack)
        streams, seen = collected(messages, wanted, where)
    for name in wanted or ():
        if not any(name in stream.names for stream in streams):
            known = seen if wanted is None else _names(path, kind, where)
            raise missing(name, known, where)
    if not streams:
        raise InputError(
            "E115",
            "no messages",
            where=where,
            got="no numbers",
            expected="messages with numbers",
            fix="record the topics of the robot",
        )
    return clocked(streams, start, clock, where, seen)


def _names(path: Path, kind: str, where: str) -> tuple[str, ...]:
    """The fields of every topic, for the message about one that is missing."""
    with ExitStack() as stack:
        _, messages = _opened(path, kind, None, where, stack)
        return collected(messages, None, where)[1]


def _opened(
    path: Path, kind: str, wanted: Sequence[str] | None, where: str, stack: ExitStack
) -> tuple[int, Iterator[Message]]:
    """The first log time, and the messages of the topics that may be wanted."""
    if path.is_dir():
        with steady(path / "metadata.yaml", 1_000_000):
            text = (path / "metadata.yaml").read_text("utf-8", "replace")
        if _COMPRESSED.search(text):
            raise InputError(
                "E126",
                "compressed file",
                where=where,
                got="compression_mode: file",
                expected="a recording that is not compressed as a whole",
                fix="ros2 bag convert, with compression_mode message or none",
            )
    for file in sorted(path.iterdir()) if path.is_dir() else [path]:
        if file.is_file():
            stack.enter_context(steady(file))
    if kind == "mcap" and _profile(path, where) != "ros2":
        return _mcap(path, wanted, where, stack)
    highlevel = library("rosbags.highlevel", "ros", "a rosbag")
    types = library("rosbags.typesys", "ros", "a rosbag")
    stack.enter_context(readable(where, *_faults()))
    # Bags of ROS 2 before Iron hold no definitions: those of ROS itself are known.
    common = types.get_typestore(types.Stores.LATEST)
    reader = highlevel.AnyReader([path], default_typestore=common)
    stack.enter_context(reader)
    chosen = [c for c in reader.connections if _may_hold(c.topic, wanted)]
    known = reader.typestore.fielddefs
    for connection in chosen if wanted is not None else ():
        if connection.msgtype not in known:
            raise _unknown(
                f"{where} {connection.topic}",
                connection.msgtype,
                "a message type of ROS, or one whose definition is in the bag",
            )
    chosen = [c for c in chosen if c.msgtype in known]

    def messages() -> Iterator[Message]:
        if not chosen:
            return
        for connection, logged, raw in reader.messages(connections=chosen):
            content = reader.deserialize(raw, connection.msgtype)
            yield Message(connection.topic, logged, content)

    return int(reader.start_time), messages()


def _unknown(where: str, got: str, expected: str) -> InputError:
    return InputError(
        "E136",
        "messages that cannot be decoded",
        where=where,
        got=got,
        expected=expected,
        fix="record as rosbag2 with MCAP storage, or convert the topic to JSON",
    )


def _faults() -> tuple[type[Exception], ...]:
    """Errors of rosbags, mcap and what they use that are based on nothing else."""
    loaded = [(sys.modules.get(module), name) for module, name in _ERRORS.items()]
    return tuple(getattr(module, name) for module, name in loaded if module)


def _profile(path: Path, where: str) -> str:
    """What an MCAP file says it holds; what its chunks unpack to is checked (E126)."""
    reading = library("mcap.reader", "ros", "an MCAP file")
    with steady(path) as size, readable(where, *_faults()), path.open("rb") as file:
        reader = reading.make_reader(file)
        profile = str(reader.get_header().profile)
        summary = reader.get_summary()
        for chunk in summary.chunk_indexes if summary else ():
            if chunk.compression:
                check_declared(chunk.uncompressed_size, size, where, "messages")
    return profile


def _mcap(
    path: Path, wanted: Sequence[str] | None, where: str, stack: ExitStack
) -> tuple[int, Iterator[Message]]:
    """Messages in JSON of an MCAP file; another encoding that is wanted is E136."""
    reading = library("mcap.reader", "ros", "an MCAP file")
    stack.enter_context(readable(where, *_faults()))
    file = stack.enter_context(path.open("rb"))
    reader = reading.make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    known = summary is not None and summary.statistics is not None
    start = summary.statistics.message_start_time if known else -1

    def messages() -> Iterator[Message]:
        for _, channel, message in reader.iter_messages():
            if not _may_hold(channel.topic, wanted):
                continue
            if channel.message_encoding != "json":
                if wanted is None:
                    continue
                raise _unknown(
                    f"{where} {channel.topic}",
                    repr(channel.message_encoding),
                    "'json', or 'cdr' in a file of ROS 2",
                )
            content = json.loads(message.data)
            yield Message(channel.topic, int(message.log_time), content)

    return int(start), messages()


def _may_hold(topic: str, wanted: Sequence[str] | None) -> bool:
    inside = (f"{topic}/", f"{topic}[")
    return wanted is None or any(n == topic or n.startswith(inside) for n in wanted)
