"""Small files that unpack to gigabytes, written without unpacking anything."""

import sqlite3
import struct
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

MIB = 2**20
ROWS = 120
TIME = 0.01 * np.arange(ROWS)
GOOD = {"time": TIME, "q": np.sin(3 * TIME), "dq": 3 * np.cos(3 * TIME), "u": TIME**2}


def zeros_deflated(mebibytes: int, first: bytes = b"") -> bytes:
    """Raw deflate of some bytes and so many MiB of zeros: one block, repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = packer.compress(first) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(MIB)) + packer.flush(zlib.Z_FULL_FLUSH)
    return start + block * mebibytes + packer.flush()


def zeros_zlib(mebibytes: int) -> bytes:
    """The same without first bytes, as a zlib stream with its checksum."""
    adler = ((mebibytes * MIB) % 65521) << 16 | 1
    return b"\x78\xda" + zeros_deflated(mebibytes) + struct.pack(">I", adler)


def write_npz(path: Path, mebibytes: int = 3072) -> None:
    """An array whose header is said to be three gigabytes long."""
    first = b"\x93NUMPY\x02\x00" + struct.pack("<I", mebibytes * MIB)
    content, name = zeros_deflated(mebibytes, first), b"q.npy"
    size = (0, len(content), mebibytes * MIB + len(first))
    about = struct.pack("<HHHHHIIIHH", 20, 0, 8, 0, 33, *size, len(name), 0)
    local = b"PK\x03\x04" + about + name + content
    central = (
        b"PK\x01\x02\x14\x00" + about + struct.pack("<HHHII", 0, 0, 0, 0, 0) + name
    )
    end = struct.pack("<HHHHIIH", 0, 0, 1, 1, len(central), len(local), 0)
    path.write_bytes(local + central + b"PK\x05\x06" + end)


def write_hdf5(path: Path, declared: int = 2048, mebibytes: int = 2048) -> None:
    """A chunk that is declared so large, in MiB, and unpacks to so much."""
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in GOOD.items():
            if name != "q":
                file[name] = values
        shape = (max(declared * MIB // 8, ROWS),)
        more = {"chunks": shape, "maxshape": (None,), "compression": "gzip"}
        data = file.create_dataset("q", (ROWS,), "f8", **more)
        data.id.write_direct_chunk((0,), zeros_zlib(mebibytes))


def record(opcode: int, content: bytes) -> bytes:
    """One record of an MCAP file."""
    return struct.pack("<BQ", opcode, len(content)) + content


def text(word: str) -> bytes:
    return struct.pack("<I", len(word)) + word.encode()


def mcap(*records: bytes, profile: str = "") -> bytes:
    """An MCAP file without a summary."""
    magic = b"\x89MCAP0\r\n"
    head = record(1, text(profile) + text(""))
    end = record(15, bytes(4)) + record(2, bytes(20))
    return magic + head + b"".join(records) + end + magic


def channel(topic: str, encoding: str) -> bytes:
    """Channel 1, of schema 1."""
    return record(4, struct.pack("<HH", 1, 1) + text(topic) + text(encoding) + bytes(4))


def write_mcap(path: Path, mebibytes: int = 2662, declared: int | None = None) -> None:
    """A chunk of zstd with one message of zeros."""
    import zstandard

    message = struct.pack("<BQ", 5, mebibytes * MIB)
    packer = zstandard.ZstdCompressor(level=3).compressobj()
    packed = packer.compress(message)
    packed += b"".join(packer.compress(bytes(MIB)) for _ in range(mebibytes))
    packed += packer.flush()
    size = len(message) + mebibytes * MIB if declared is None else declared
    chunk = struct.pack("<QQQI", 0, 1, size, 0) + text("zstd")
    chunk += struct.pack("<Q", len(packed)) + packed
    schema = struct.pack("<H", 1) + text("any") + text("jsonschema") + text("{}")
    path.write_bytes(mcap(record(3, schema), channel("/arm", "json"), record(6, chunk)))


def write_bag(
    path: Path,
    definition: str = "string[1000000000] word\nfloat64 q\n",
    name: str = "robot/msg/Arm",
    digest: str = "",
) -> None:
    """A rosbag2 whose one topic has a definition of its own."""
    tables = (
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)",
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, "
        "serialization_format TEXT, offered_qos_profiles TEXT, "
        "type_description_hash TEXT)",
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
        "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)",
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, "
        "timestamp INTEGER, data BLOB)",
        "INSERT INTO schema VALUES (4, 'iron')",
    )
    with closing(sqlite3.connect(path)) as base:
        base.execute("PRAGMA synchronous = OFF")
        for table in tables:
            base.execute(table)
        topic = (name, digest)
        base.execute("INSERT INTO topics VALUES (1, '/arm', ?, 'cdr', '', ?)", topic)
        row = (name, "ros2msg", definition, digest)
        base.execute("INSERT INTO message_definitions VALUES (1, ?, ?, ?, ?)", row)
        content = b"\x00\x01\x00\x00" + bytes(64)
        for i in range(3):
            base.execute("INSERT INTO messages VALUES (?, 1, ?, ?)", (i, i, content))
        base.commit()


def write_parquet(path: Path, name: str = "picture") -> None:
    """Columns of numbers, and one of 3.1 GiB in two rows that name one value often."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    value = pa.array([bytes(27 * MIB)], pa.binary())
    words = pa.DictionaryArray.from_arrays(pa.array(np.zeros(118, np.int32)), value)
    offsets = np.full(ROWS + 1, 118, np.int32)
    offsets[:2] = 0, 59
    lists = pa.ListArray.from_arrays(pa.array(offsets), words)
    pq.write_table(
        pa.table(GOOD | {name: lists}),
        path,
        compression="zstd",
        dictionary_pagesize_limit=64 * MIB,
        store_schema=False,
        write_statistics=False,
    )


#: Name -> what writes it, and the columns of q, dq, u that are asked for.
Write = Callable[..., Any]
BOMBS: dict[str, tuple[Write, tuple[str, str, str]]] = {
    "a.mcap": (write_mcap, ("/arm/q", "/arm/dq", "/arm/u")),
    "a.h5": (write_hdf5, ("q", "dq", "u")),
    "a.npz": (write_npz, ("q", "q", "q")),
    "a.db3": (write_bag, ("/arm/q", "/arm/q", "/arm/q")),
    "a.parquet": (write_parquet, ("q", "dq", "u")),
}
