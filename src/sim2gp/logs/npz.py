"""NumPy archives: a zip of arrays, opened member by member and never unpickled.

An array's header says its shape and dtype; both are checked against what the archive
says of the member's size before anything is allocated.
"""

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Shaped

from sim2gp.errors import InputError
from sim2gp.logs.arrays import Entry, distinct, table_of
from sim2gp.logs.file import check_declared, pickled, readable, shown, steady
from sim2gp.logs.table import Table

_HEADER = 10_000  # bytes; numpy's own limit


def read_npz(path: Path, wanted: Sequence[str] | None, time: str | None) -> Table:
    """The wanted arrays of an archive as columns (E103 to E126, E140, E180, E182)."""
    where = shown(path)
    with (
        steady(path) as size,
        readable(where, zipfile.BadZipFile, NotImplementedError),
        zipfile.ZipFile(path) as archive,
    ):
        members = [_checked(info, where) for info in archive.infolist()]
        names = [info.filename.removesuffix(".npy") for info in members]
        distinct(names, where)
        entries = {
            name: _entry(archive, info, size, f"{where}:array {name}")
            for name, info in zip(names, members, strict=True)
        }
        return table_of(entries, where, wanted, time=time, size=size)


def _checked(info: zipfile.ZipInfo, where: str) -> zipfile.ZipInfo:
    name = info.filename.replace("\\", "/")
    path = PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        raise InputError(
            "E182",
            "archive entry outside the archive",
            where=where,
            got=repr(info.filename)[:60],
            expected="names of arrays",
            fix="do not use this file: it was made to overwrite others",
        )
    if path.suffix == ".pkl" or "data.pkl" in path.parts:
        raise pickled(where, info.filename)
    if path.suffix != ".npy":
        raise InputError(
            "E125",
            "not an array",
            where=where,
            got=repr(info.filename)[:60],
            expected="members that end with .npy",
            fix="save the arrays with numpy.savez",
        )
    return info


def _entry(
    archive: zipfile.ZipFile, info: zipfile.ZipInfo, size: int, where: str
) -> Entry:
    """The array's shape and dtype, and how to read it."""
    with archive.open(info) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read = np.lib.format.read_array_header_2_0
        shape, in_columns, dtype = read(member, max_header_size=_HEADER)
        start = member.tell()
    if dtype.hasobject:
        return Entry(shape, np.dtype(object), lambda: np.empty(0))
    count = math.prod(shape)
    claimed = count * dtype.itemsize
    if claimed != info.file_size - start:
        raise InputError(
            "E126",
            "array header and size differ",
            where=where,
            got=f"shape {shape} in {info.file_size} bytes",
            expected=f"{start + claimed} bytes",
            fix="save the array again",
        )

    def values() -> Shaped[np.ndarray, "..."]:
        check_declared(info.file_size, size, where)
        with archive.open(info) as member:
            content = member.read()
        flat = np.frombuffer(content, dtype, count, start)
        return flat.reshape(shape, order="F" if in_columns else "C")

    return Entry(shape, dtype, values)
