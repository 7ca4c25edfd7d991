"""Messages become streams of numbers: fields by path, joints by name, stamps in ns.

Each topic is a stream with stamps of its own. They are whole nanoseconds; the start is
subtracted before they become seconds in float64.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Int

from sim2gp.data.logs.arrays import MAX_WIDTH
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.log import Note
from sim2gp.data.logs.table import LogTable, Rows
from sim2gp.errors import error

NEAR = 1_000_000_000  # ns: clocks further apart than this are not one clock
#: Bytes of a message while it is collected, and of each of its numbers.
ROW, NUMBER = 160, 32
_JOINT = ("position", "velocity", "effort")
Fields = dict[str, float]


@dataclass(frozen=True)
class Message:
    """One message: its topic, when it was logged and stamped (ns), its content."""

    topic: str
    logged: int
    content: Any


@dataclass
class Stream:
    """The wanted numbers of a topic while they are collected, message by message."""

    topic: str
    names: tuple[str, ...]
    numbers: list[int] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)
    stamped: list[int] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)


def collect_streams(
    messages: Iterator[Message], wanted: Sequence[str] | None, meter: Meter
) -> tuple[list[Stream], tuple[str, ...]]:
    """The streams, and the names of all fields that were seen.

    A topic that several nodes publish with other fields each (joint states of two
    arms) is several streams; a field that comes and goes is refused (E140).
    """
    asked, where = None if wanted is None else frozenset(wanted), meter.where
    streams: dict[tuple[str, tuple[str, ...]], Stream] = {}
    counts: dict[str, int] = {}
    seen: dict[str, None] = {}
    for message in messages:
        topic = message.topic
        number = counts[topic] = counts.get(topic, -1) + 1
        fields = _message_fields(
            message.content, topic, f"{where} {topic}:message {number}"
        )
        if asked is None or number == 0:
            seen |= dict.fromkeys(fields)
        # In one order, which need not be that of the joints in this message.
        names = tuple(sorted(fields if asked is None else asked & fields.keys()))
        if not names:
            continue
        stream = streams.setdefault((topic, names), Stream(topic, names))
        stream.numbers.append(number)
        stream.logged.append(message.logged)
        stream.stamped.append(_stamp(message.content))
        stream.values.append(tuple(fields[name] for name in names))
        meter.spend(ROW + NUMBER * len(names))
    meter.place = ""
    if asked is not None:
        _check_steady_fields([*streams.values()], where)
    found = sorted(streams.values(), key=lambda stream: stream.topic)
    return found, tuple(seen)


def _check_steady_fields(streams: Sequence[Stream], where: str) -> None:
    owners: dict[str, Stream] = {}
    for stream in streams:
        for name in stream.names:
            other = owners.setdefault(name, stream)
            if other is not stream:
                raise error(
                    "field_comes_and_goes",
                    where=f"{where} {stream.topic}:message {stream.numbers[0]}",
                    got=f"{name} with other fields than before",
                )


def assign_times(
    streams: Sequence[Stream],
    start: int,
    clock: str | None,
    where: str,
    seen: tuple[str, ...],
) -> list[LogTable]:
    """Tables in seconds since the start of the recording; what was taken is said.

    Header stamps and log times are mixed only where they are of one clock.
    """
    logged = [np.asarray(stream.logged, dtype=np.int64) for stream in streams]
    stamped = [np.asarray(stream.stamped, dtype=np.int64) for stream in streams]
    stated = [bool(np.all(stamps > 0)) for stamps in stamped]
    if clock == "header" and not all(stated):
        raise error(
            "no_header_stamps",
            where=f"{where} {streams[stated.index(False)].topic}",
            got="messages without a stamp, or with a stamp of zero",
        )
    apart = [
        abs(int(np.median(a - b)))
        for a, b, has in zip(stamped, logged, stated, strict=True)
        if has
    ]
    far = max(apart, default=0) > NEAR
    use = [has and clock != "log" for has in stated]
    if far and not all(use):
        use = [False] * len(use)
    times = [s if u else t for s, t, u in zip(stamped, logged, use, strict=True)]
    first = min(int(t[0]) for t in times)
    origin = first if start < 0 or (far and all(use)) else start
    return [
        _stream_table(stream, time, origin, used, where, seen)
        for stream, time, used in zip(streams, times, use, strict=True)
    ]


def _stream_table(
    stream: Stream,
    time: Int[np.ndarray, " N"],
    origin: int,
    headed: bool,
    where: str,
    seen: tuple[str, ...],
) -> LogTable:
    what = "its headers" if headed else "its log times"
    text = f"time of {stream.topic} in {where} is that of {what}"
    values = np.asarray(stream.values, dtype=np.float64)
    columns = {name: values[:, i] for i, name in enumerate(stream.names)}
    rows = Rows(f"{where} {stream.topic}", np.asarray(stream.numbers), "message")
    seconds = (time - origin) / 1e9
    notes = (Note("W154", text),)
    return LogTable(rows, seen, columns, seconds, stream.topic, notes)


def _stamp(content: Any) -> int:
    """The stamp of a message's header in ns; 0 where it has none."""
    header = _get(content, "header")
    stamp = _get(header, "stamp") if header is not None else _get(content, "timestamp")
    seconds = _get(stamp, "sec")
    nanoseconds = _get(stamp, "nanosec")
    if nanoseconds is None:
        nanoseconds = _get(stamp, "nsec")
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        return 0
    return 1_000_000_000 * seconds + nanoseconds


def _get(content: Any, name: str) -> Any:
    if isinstance(content, dict):
        return content.get(name)
    return getattr(content, name, None)


def _message_fields(content: Any, topic: str, where: str) -> Fields:
    """The numbers of a message by path; those of joints by the joint's name."""
    found: Fields = {}
    joints = _get(content, "name")
    named = isinstance(joints, list | tuple) and len(joints) > 0
    parts = [p for p in _JOINT if named and _get(content, p) is not None]
    if parts and all(isinstance(joint, str) for joint in joints):
        _add_joints(content, joints, parts, topic, where, found)
        return found
    _walk(content, topic, found, top=True)
    return found


def _add_joints(
    content: Any,
    joints: Sequence[str],
    parts: Sequence[str],
    topic: str,
    where: str,
    found: Fields,
) -> None:
    if len(set(joints)) != len(joints):
        raise error("joint_named_twice", where=where, got=", ".join(joints)[:80])
    for part in parts:
        values = _get(content, part)
        if len(values) == 0:
            continue
        if len(values) != len(joints):
            raise error(
                "names_and_values_differ",
                where=where,
                got=f"{len(joints)} names, {len(values)} of {part}",
            )
        for joint, value in zip(joints, values, strict=True):
            found[f"{topic}/{joint}/{part}"] = _number_or_nan(value)


def _number_or_nan(value: Any) -> float:
    return float("nan") if value is None else float(value)


def _walk(value: Any, path: str, found: Fields, *, top: bool = False) -> None:
    """Numbers of records, lists and dictionaries; texts, truths, pictures are not."""
    if isinstance(value, bool | str | bytes | np.bool_):
        return
    if value is None or isinstance(value, int | float | np.number):
        found[path] = _number_or_nan(value)
    elif isinstance(value, dict):
        for name, inner in value.items():
            if not (top and name in ("header", "timestamp")):
                _walk(inner, f"{path}/{name}", found)
    elif isinstance(value, list | tuple | np.ndarray):
        if len(value) <= MAX_WIDTH:
            for i, inner in enumerate(value):
                _walk(inner, f"{path}[{i}]", found)
    else:
        for name in getattr(value, "__dataclass_fields__", ()):
            if not name.startswith("__") and name not in ("header", "layout"):
                _walk(getattr(value, name), f"{path}/{name}", found)
