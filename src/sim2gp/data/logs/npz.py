"""NumPy archives: a zip of arrays, opened member by member and never unpickled.

An array's header says its shape and dtype. It is read by a grammar of our own, because
numpy's evaluates it, and checked against what the archive says of the member's size
before anything is allocated.
"""

import math
import re
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.data.logs.arrays import LazyArray, distinct, read_columns
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.file import display_path, pickle_error, unchanged_size
from sim2gp.data.logs.table import LogTable
from sim2gp.errors import error

MAX_HEADER = 10_000  # bytes; numpy's own limit
STEP = 2**20  # bytes that are unpacked at once
_PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # what numpy writes
#: As numpy writes it: a dictionary of three literals, in any order.
_ITEM = re.compile(
    r"""\s*(?P<q>['"])(?P<key>descr|fortran_order|shape)(?P=q)\s*:\s*(?:
        (?P<bool>True|False)
        | (?P<s>['"])(?P<dtype>[<>|=]?[A-Za-z?][0-9]{0,9}(?:\[[0-9a-z]{1,9}\])?)(?P=s)
        | \((?P<shape>[0-9,\ L]*)\)
        | (?P<record>\[[^{}:]*\])
    )\s*(?:,|(?=\}))""",
    re.VERBOSE,
)
_AXIS = re.compile(r" *([0-9]{1,19})L? *")


def read_npz(
    path: Path, wanted: Sequence[str] | None, time: str | None, meter: Meter
) -> LogTable:
    """The wanted arrays of an archive as columns (E103 to E126, E140, E180, E182)."""
    where = display_path(path)
    with unchanged_size(path), zipfile.ZipFile(path) as archive:
        members = [_check_member(info, where) for info in archive.infolist()]
        names = [info.filename.removesuffix(".npy") for info in members]
        distinct(names, where)
        entries = {}
        for name, info in zip(names, members, strict=True):
            meter.place = f"array {name[:60]}"
            entries[name] = _lazy_member(archive, info, meter)
        return read_columns(entries, where, wanted, time=time, meter=meter)


def _check_member(info: zipfile.ZipInfo, where: str) -> zipfile.ZipInfo:
    name = info.filename.replace("\\", "/")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise error("entry_outside_archive", where=where, got=repr(info.filename)[:60])
    if path.suffix == ".pkl" or "data.pkl" in path.parts:
        raise pickle_error(where, info.filename)
    if path.suffix != ".npy":
        raise error("member_not_an_array", where=where, got=repr(info.filename)[:60])
    if info.compress_type not in _PLAIN:
        raise error(
            "unknown_archive_compression",
            where=where,
            got=f"method {info.compress_type} of {info.filename!r}"[:80],
        )
    return info


def _lazy_member(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, meter: Meter
) -> LazyArray:
    """The array's shape and dtype, and how to read it."""
    meter.tick()
    with archive.open(info) as member:
        shape, in_columns, dtype, start = _array_header(member, meter)
    if dtype.hasobject or dtype.kind == "V":
        return LazyArray(shape, dtype, lambda: np.empty(0))
    count = math.prod(shape)
    claimed = count * dtype.itemsize
    if claimed != info.file_size - start:
        raise error(
            "array_header_and_size_differ",
            where=meter.at,
            got=f"shape {shape} in {info.file_size} bytes",
            size=start + claimed,
        )

    def values() -> Shaped[np.ndarray, "..."]:
        meter.claim(claimed)
        content = np.empty(claimed, np.uint8)  # memory is taken as it is filled
        with archive.open(info) as member:
            member.read(start)
            done = 0
            while done < claimed:
                part = member.read(min(STEP, claimed - done))
                if not part:
                    raise EOFError(f"{done} of {claimed} bytes")
                meter.spend(len(part))
                content[done : done + len(part)] = np.frombuffer(part, np.uint8)
                done += len(part)
            member.read(1)  # at the end the archive's checksum is compared
        flat = content.view(dtype)
        return flat.reshape(shape, order="F" if in_columns else "C")

    return LazyArray(shape, dtype, values)


def _array_header(
    member: Any, meter: Meter
) -> tuple[tuple[int, ...], bool, np.dtype, int]:
    """Shape, order, dtype and length of an array's header; ValueError for any other."""
    version = np.lib.format.read_magic(member)
    form = "<H" if version == (1, 0) else "<I"
    size = struct.calcsize(form)
    (length,) = struct.unpack(form, member.read(size))
    if length > MAX_HEADER:
        raise meter.over(
            "array header too large", f"{length} bytes", f"at most {MAX_HEADER}"
        )
    text = member.read(length).decode("utf-8" if version >= (3, 0) else "latin-1")
    found: dict[str, re.Match[str]] = {}
    body, rest = text.strip(), ""
    if body[:1] == "{" and body[-1:] == "}":
        rest = body[1:]
        while (item := _ITEM.match(rest)) and item["key"] not in found:
            found[item["key"]] = item
            rest = rest[item.end() :]
    if len(found) != 3 or rest.strip() != "}":
        raise ValueError(f"array header {body[:40]!r}")
    order, shape = found["fortran_order"]["bool"], found["shape"]["shape"]
    descr = found["descr"]
    if order is None or shape is None or not (descr["dtype"] or descr["record"]):
        raise ValueError(f"array header {body[:40]!r}")
    axes = [axis for axis in shape.split(",") if axis.strip()]
    sizes = [_AXIS.fullmatch(axis) for axis in axes]
    if not all(sizes) or len(axes) > 32:
        raise ValueError(f"array of shape ({shape[:40]})")
    dtype = np.dtype(descr["dtype"]) if descr["dtype"] else np.dtype([("field", "f8")])
    found_shape = tuple(int(size[1]) for size in sizes if size)
    return found_shape, order == "True", dtype, 8 + size + length
