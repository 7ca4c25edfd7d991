"""What bags and MCAP files would unpack to, found before their libraries open them.

The libraries unpack a chunk, or a message, as a whole. Each that they may reach is
unpacked here first, in small pieces that are thrown away.
"""

import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.unpack import pieces
from sim2gp.errors import InputError, error

#: Kinds of records of MCAP (https://mcap.dev/spec).
_HEADER, _FOOTER, _CHUNK, _INDEX, _ATTACHMENT, _DATA_END = 1, 2, 6, 8, 9, 15
_ENTRY = 200  # bytes of Python objects for each entry of an index


def check_mcap(path: Path, meter: Meter) -> str:
    """Measure every chunk of an MCAP file; the profile of its header (E126)."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(8)
        first, length = _record_header(file)
        if first != _HEADER:
            raise ValueError("no header record")
        meter.piece(length, "record")
        profile = _read_text(file)
        file.seek(17 + length)
        chunks, attached = _chunks(file, size, meter)
        indexes = _indexes(file, size, meter)
        if any(chunks.get(place) != about for place, about in indexes):
            raise ValueError("an index of chunks that are not in the file")
        if not indexes:
            meter.piece(attached, "attachment")  # read from start to end, with all
            indexes = [*chunks.items()]
        packed = [about for _, about in indexes if about[2]]
        meter.claim(sum(about[1] for about in packed), "messages")
        for place, (stored, declared, kind) in dict(indexes).items():
            meter.piece(stored, "chunk")
            if kind:
                file.seek(place + 9 + 40 + len(kind.encode()))
                parts = pieces(file.read(stored), kind, "an MCAP file")
                meter.measure(parts, declared, "chunk")
    return profile


def _record_header(file: BinaryIO) -> tuple[int, int]:
    opcode, length = struct.unpack("<BQ", file.read(9))
    return opcode, length


def _read_text(file: BinaryIO) -> str:
    (length,) = struct.unpack("<I", file.read(4))
    if length > 4096:
        raise ValueError(f"a name of {length} bytes")
    return file.read(length).decode("utf-8")


#: Of a chunk: its stored bytes, what it says to unpack to, and how.
_Chunk = tuple[int, int, str]


def _chunks(file: BinaryIO, size: int, meter: Meter) -> tuple[dict[int, _Chunk], int]:
    """Every chunk of the data by its place, and the largest attachment."""
    found: dict[int, _Chunk] = {}
    attached = 0
    while (place := file.tell()) < size - 8:
        meter.tick()
        opcode, length = _record_header(file)
        if opcode in (_FOOTER, _DATA_END):
            break
        if opcode == _CHUNK:
            _, _, declared, _ = struct.unpack("<QQQI", file.read(28))
            kind = _read_text(file)
            (stored,) = struct.unpack("<Q", file.read(8))
            found[place] = stored, declared, kind
        elif opcode == _ATTACHMENT:
            attached = max(attached, length)
        else:
            meter.piece(length, "record")
        file.seek(place + 9 + length)
    return found, attached


def _indexes(file: BinaryIO, size: int, meter: Meter) -> list[tuple[int, _Chunk]]:
    """What the summary at the end of an MCAP file says of its chunks, if any."""
    file.seek(size - 8 - 29)
    opcode, _ = _record_header(file)
    (start,) = struct.unpack("<Q", file.read(8))
    found: list[tuple[int, _Chunk]] = []
    if opcode != _FOOTER or start == 0:
        return found
    file.seek(start)
    while (place := file.tell()) < size - 8:
        meter.tick()
        opcode, length = _record_header(file)
        if opcode == _FOOTER:
            break
        meter.piece(length, "record")
        if opcode == _INDEX:
            meter.claim(_ENTRY * len(found))
            _, _, chunk, _, offsets = struct.unpack("<QQQQI", file.read(36))
            file.seek(offsets + 8, 1)
            kind = _read_text(file)
            found.append((chunk, (*struct.unpack("<QQ", file.read(16)), kind)))
        file.seek(place + 9 + length)
    return found


def check_bag(path: Path, meter: Meter) -> None:
    """Measure the chunks that the index of a rosbag1 names (E126)."""
    with path.open("rb") as file:
        file.readline(64)
        fields = _header_fields(file, meter)
        (start,) = struct.unpack("<Q", fields[b"index_pos"])
        connections, infos = (
            struct.unpack("<I", fields[name])[0]
            for name in (b"conn_count", b"chunk_count")
        )
        if start == 0 or infos == 0:
            return  # not indexed, which its reader says
        file.seek(start)
        for _ in range(connections):
            _header_fields(file, meter)
            _skip(file, meter)
        places: list[tuple[int, int]] = []
        for _ in range(infos):
            meter.claim(_ENTRY * len(places))
            about = _header_fields(file, meter)
            (count,) = struct.unpack("<I", about[b"count"])
            places.append((struct.unpack("<Q", about[b"chunk_pos"])[0], count))
            _skip(file, meter)
        for place, count in places:
            file.seek(place)
            _measure_bag_chunk(file, meter)
            for _ in range(count):
                entries = struct.unpack("<I", _header_fields(file, meter)[b"count"])[0]
                meter.spend(_ENTRY * entries, "index entries")
                _skip(file, meter)


def _measure_bag_chunk(file: BinaryIO, meter: Meter) -> None:
    fields = _header_fields(file, meter)
    kind = fields[b"compression"].decode()
    (declared,) = struct.unpack("<I", fields[b"size"])
    (stored,) = struct.unpack("<I", file.read(4))
    meter.piece(stored, "chunk")
    content = file.read(stored)
    if kind != "none":
        meter.measure(pieces(content, kind, "a rosbag"), declared, "chunk")


def _header_fields(file: BinaryIO, meter: Meter) -> dict[bytes, bytes]:
    """The header of a record of rosbag1."""
    (length,) = struct.unpack("<I", file.read(4))
    meter.piece(length, "record")
    content = file.read(length)
    found: dict[bytes, bytes] = {}
    place = 0
    while place < len(content):
        (size,) = struct.unpack_from("<I", content, place)
        name, _, value = content[place + 4 : place + 4 + size].partition(b"=")
        found[name] = value
        place += 4 + size
    return found


def _skip(file: BinaryIO, meter: Meter) -> None:
    (length,) = struct.unpack("<I", file.read(4))
    meter.piece(length, "record")
    file.seek(length, 1)


def check_database(path: Path, meter: Meter) -> None:
    """The tables of a rosbag2 are plain ones, and no message is too large (E126, E136).

    A view, a virtual table or a generated column could go on for ever.
    """
    name = f"{path.absolute().as_uri()}?immutable=1"
    with closing(sqlite3.connect(name, uri=True)) as base:
        base.text_factory = bytes
        base.set_progress_handler(lambda: _ended(meter), 100_000)
        try:
            _check_tables(base, meter)
            query = (
                "SELECT count(*), max(length(data)), sum(length(data)) FROM messages"
            )
            count, largest, total = base.execute(query).fetchone()
            meter.piece(largest or 0, "message")
            if (total or 0) > path.stat().st_size:
                raise ValueError(f"{count} messages of {total} bytes")
        except sqlite3.OperationalError:
            meter.tick()  # interrupted
            raise


def _ended(meter: Meter) -> int:
    try:
        meter.tick()
    except InputError:
        return 1  # ends the query
    return 0


def _check_tables(base: sqlite3.Connection, meter: Meter) -> None:
    for kind, name, text in base.execute("SELECT type, name, sql FROM sqlite_master"):
        plain = {b"table": b"CREATE TABLE", b"index": b"CREATE "}.get(kind)
        words = b" ".join((text or b"").split()[:3]).upper()
        ok = plain is not None and (not text or words.startswith(plain))
        if ok and kind == b"table":
            quoted = '"' + name.decode().replace('"', '""') + '"'
            columns = base.execute(f"PRAGMA table_xinfo({quoted})").fetchall()
            ok = not any(column[6] for column in columns)
        if not ok:
            raise error(
                "more_than_tables",
                where=meter.where,
                got=repr((text or name)[:60].decode("utf-8", "replace")),
            )
