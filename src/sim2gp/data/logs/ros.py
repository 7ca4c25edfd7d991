"""Recordings of messages: rosbag1, rosbag2 (sqlite3, MCAP) and MCAP with JSON.

Columns are named by topic and field: ``/imu/angular_velocity/z``, ``/cmd/data[0]``, and
of a joint state by its joint: ``/joint_states/elbow/position``.
"""

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.chunks import check_bag, check_database, check_mcap
from sim2gp.data.logs.definitions import full_name, parse_definition
from sim2gp.data.logs.file import (
    MAGIC,
    compression_error,
    display_path,
    import_optional,
    read_bytes,
    unchanged_size,
)
from sim2gp.data.logs.messages import Message, assign_times, collect_streams
from sim2gp.data.logs.table import LogTable, missing_column
from sim2gp.data.logs.unpack import STEP, pieces
from sim2gp.errors import InputError, error

#: What a byte of a message may become in Python: lists of JSON, and of small messages.
JSON, NESTED = 16, 128
_ZSTD = b"\x28\xb5\x2f\xfd"  # no message in CDR begins so
_LISTED = re.compile(r"^\s*relative_file_paths:[ \t]*\n((?:[ \t]*-[ \t].*\n?)+)", re.M)
Decode = Callable[[bytes], Any]


def read_bag(
    path: Path, kind: str, wanted: Sequence[str] | None, clock: str | None, meter: Meter
) -> list[LogTable]:
    """The wanted fields of a recording, one table for each stream.

    ``clock`` names the stamps, "header" or "log"; None takes those of the headers where
    they are, and the recorder's otherwise. Raises `InputError` E103, E104, E125, E126,
    E135, E136, E140.
    """
    where = display_path(path)
    with ExitStack() as stack:
        start, messages = _opened(path, kind, wanted, meter, stack)
        streams, seen = collect_streams(messages, wanted, meter)
    for name in wanted or ():
        if not any(name in stream.names for stream in streams):
            known = seen if wanted is None else _topic_fields(path, kind, meter)
            raise missing_column(name, known, where)
    if not streams:
        raise error("no_messages", where=where, got="no numbers")
    return assign_times(streams, start, clock, where, seen)


def _topic_fields(path: Path, kind: str, meter: Meter) -> tuple[str, ...]:
    """The fields of every topic, for the message about one that is missing."""
    again = meter.again()
    with ExitStack() as stack:
        _, messages = _opened(path, kind, None, again, stack)
        return collect_streams(messages, None, again)[1]


def _opened(
    path: Path, kind: str, wanted: Sequence[str] | None, meter: Meter, stack: ExitStack
) -> tuple[int, Iterator[Message]]:
    """The first log time, and the messages of the topics that may be wanted."""
    if kind == "mcap":
        import_optional("mcap.reader", "ros", "an MCAP file")
    module = "rosbags.rosbag1" if kind == "rosbag1" else "rosbags.rosbag2"
    rosbags = import_optional(module, "ros", "a rosbag") if kind != "mcap" else None
    files = _files(path, meter) if path.is_dir() else [path]
    readers = []
    for file in files:
        stack.enter_context(unchanged_size(file))
        meter.place = file.name if path.is_dir() else ""
        if kind == "rosbag1":
            check_bag(file, meter)
        elif file.suffix == ".mcap":
            if check_mcap(file, meter) != "ros2" and kind == "mcap":
                return _mcap(path, wanted, meter, stack)
        else:
            check_database(file, meter)
    open_bag = (rosbags or import_optional(module, "ros", "a rosbag")).Reader
    decoders = _Decoders(meter, kind == "rosbag1")
    for file in files:
        reader = stack.enter_context(open_bag(file))
        chosen = []
        for connection in reader.connections:
            if not _may_hold(connection.topic, wanted):
                continue
            if decoders.knows(connection, wanted is not None):
                chosen.append(connection)
        readers.append((reader, chosen))
    meter.place = ""

    def messages() -> Iterator[Message]:
        for reader, chosen in readers:
            # None chosen means all to the library.
            for about, logged, raw in reader.messages(chosen) if chosen else ():
                meter.tick()
                if not isinstance(logged, int):  # SQLite keeps any type in any column
                    raise ValueError(f"{about.topic[:80]}: time {str(logged)[:40]}")
                meter.place = f"{about.topic[:80]}, logged at {logged} ns"
                content = decoders.decoded(about, raw)
                yield Message(about.topic, logged, content)

    return min(int(reader.start_time) for reader, _ in readers), messages()


def _files(path: Path, meter: Meter) -> list[Path]:
    """The storage files of a rosbag2, as its metadata lists them.

    The list alone is taken from there, by its lines: whether messages are compressed
    is seen in the files themselves.
    """
    text = read_bytes(path / "metadata.yaml", 1_000_000).decode("utf-8", "replace")
    listed = _LISTED.search(text)
    names = [
        line.split("-", 1)[1] for line in (listed[1] if listed else "").splitlines()
    ]
    names = [name.split(" #")[0].strip(" \t'\"\r") for name in names]
    files = [path / Path(name.replace("\\", "/")).name for name in names if name]
    if not files:
        meter.place = "metadata.yaml"
        raise ValueError("no relative_file_paths")
    for file in files:
        first = read_bytes(file, first=16)
        if first.startswith(_ZSTD):
            raise compression_error(display_path(file), first)
        if not first.startswith((MAGIC["mcap"], MAGIC["rosbag2"])):
            meter.place = file.name
            raise ValueError(f"first bytes {first[:8]!r}")
    return files


@dataclass
class _Decoders:
    """What turns a topic's messages into Python objects, from its checked definition.

    Each definition has a store of types of its own. Bags of ROS 2 before Iron hold no
    definitions: those of ROS itself are known.
    """

    meter: Meter
    ros1: bool
    found: dict[tuple[str, str], tuple[Decode, bool]] = field(default_factory=dict)

    def knows(self, connection: Any, needed: bool) -> bool:
        """Whether its messages can be decoded; if they are ``needed``, E136 if not."""
        key = self._key(connection)
        place, self.meter.place = self.meter.place, connection.topic[:80]
        try:
            if key not in self.found:
                self.found[key] = self._decoder(connection, *key)
        except InputError as error:
            if needed or error.code != "E136":
                raise
            return False
        self.meter.place = place
        return True

    def decoded(self, connection: Any, raw: bytes) -> Any:
        """The content of a message, which may be compressed on its own."""
        decode, nested = self.found[self._key(connection)]
        if raw[:4] == _ZSTD:
            parts: list[bytes] = []
            for part in pieces(raw, "zstd", "a rosbag"):
                self.meter.spend(len(part), "messages")
                self.meter.piece(STEP * (len(parts) + 1), "message")
                parts.append(part)
            raw = b"".join(parts)
        if nested:
            self.meter.piece(NESTED * len(raw), "message of many parts")
        return decode(raw)

    def _key(self, connection: Any) -> tuple[str, str]:
        return connection.msgtype, connection.msgdef.data

    def _decoder(self, connection: Any, name: str, text: str) -> tuple[Decode, bool]:
        types = import_optional("rosbags.typesys", "ros", "a rosbag")
        if connection.msgdef.format.name == "IDL":
            raise self._unknown("a definition in IDL", "one in ROS's own form (msg)")
        full = full_name(name)
        if full is None:
            raise self._unknown(repr(name[:60]), "package/msg/Type")
        nested = True
        if not text.strip() and not self.ros1:
            store = types.get_typestore(types.Stores.LATEST)
            if full not in store.fielddefs:
                expected = (
                    "a message type of ROS, or one whose definition is in the bag"
                )
                raise self._unknown(full, expected)
        else:
            definition = parse_definition(text, name, self.meter)
            store = types.get_typestore(types.Stores.EMPTY)
            store.register(types.get_types_from_msg(definition.written(), full))
            nested = definition.nested
            self._check_digest(store, full, connection.digest, definition.whole)
        decode = store.deserialize_ros1 if self.ros1 else store.deserialize_cdr
        return (lambda raw: decode(raw, full)), nested

    def _check_digest(self, store: Any, name: str, stated: str, whole: bool) -> None:
        """The definition is the one that the topic was recorded with."""
        if not stated or (self.ros1 and not whole):
            return
        digest = (
            store.generate_msgdef(name)[1] if self.ros1 else store.hash_rihs01(name)
        )
        if digest != stated:
            raise ValueError(f"definition of {name}: checksum {digest}, not {stated}")

    def _unknown(self, got: str, expected: str) -> InputError:
        return _unknown(f"{self.meter.where} {self.meter.place}", got, expected)


def _unknown(where: str, got: str, expected: str) -> InputError:
    return error("messages_not_decodable", where=where, got=got, expected=expected)


def _mcap(
    path: Path, wanted: Sequence[str] | None, meter: Meter, stack: ExitStack
) -> tuple[int, Iterator[Message]]:
    """Messages in JSON of an MCAP file; another encoding that is wanted is E136."""
    reading = import_optional("mcap.reader", "ros", "an MCAP file")
    file = stack.enter_context(path.open("rb"))
    reader = reading.make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    known = summary is not None and summary.statistics is not None
    start = summary.statistics.message_start_time if known else -1
    topics = None
    if summary is not None and summary.channels:
        names = {channel.topic for channel in summary.channels.values()}
        topics = [name for name in names if _may_hold(name, wanted)]

    def messages() -> Iterator[Message]:
        for _, channel, message in reader.iter_messages(topics):
            meter.tick()
            if not _may_hold(channel.topic, wanted):
                continue
            if channel.message_encoding != "json":
                if wanted is None:
                    continue
                raise _unknown(
                    f"{meter.where} {channel.topic}",
                    repr(channel.message_encoding),
                    "'json', or 'cdr' in a file of ROS 2",
                )
            meter.place = f"{channel.topic[:80]}, logged at {message.log_time} ns"
            meter.piece(JSON * len(message.data), "message")
            content = json.loads(message.data)
            yield Message(channel.topic, int(message.log_time), content)

    return int(start), messages()


def _may_hold(topic: str, wanted: Sequence[str] | None) -> bool:
    inside = (f"{topic}/", f"{topic}[")
    return wanted is None or any(n == topic or n.startswith(inside) for n in wanted)
