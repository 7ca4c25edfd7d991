"""Arrays of a run: an ``.npz`` whose declarations are read before an array is built."""

import io
import math
import zipfile
from typing import NamedTuple

import numpy as np
from numpy.lib import format as npy

#: Of all arrays of a run, unpacked.
LARGEST = 2**31
_HEADERS = {
    (1, 0): npy.read_array_header_1_0,
    (2, 0): npy.read_array_header_2_0,
}


class Declared(NamedTuple):
    """What an archive says of one array."""

    shape: tuple[int, ...]
    dtype: np.dtype


def declarations(content: bytes, largest: int = LARGEST) -> dict[str, Declared]:
    """Shape and type of every array by name; nothing is unpacked but headers.

    ValueError, in few words, for what is no archive, a name that occurs twice, Python
    objects, a size that is not what the shape needs, and more bytes than ``largest``.
    """
    found: dict[str, Declared] = {}
    total = 0
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            for member in archive.infolist():
                name, declared = _declared(archive, member)
                if name in found:
                    raise ValueError(f"array {name} occurs twice")
                found[name] = declared
                total += member.file_size
    except ValueError:
        raise
    except Exception as error:  # of a library: damaged in one of its many ways
        raise ValueError(f"unreadable arrays ({type(error).__name__})") from error
    if total > largest:
        raise ValueError(f"arrays of {total} bytes, more than {largest}")
    return found


def load_arrays(content: bytes) -> dict[str, np.ndarray]:
    """All arrays by name; ValueError as `declarations`."""
    known = declarations(content)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {name: stored[name] for name in known}
    except Exception as error:
        raise ValueError(f"unreadable arrays ({type(error).__name__})") from error


def _declared(
    archive: zipfile.ZipFile, member: zipfile.ZipInfo
) -> tuple[str, Declared]:
    name = member.filename.removesuffix(".npy")
    if name == member.filename:
        raise ValueError(f"{name[:60]!r} is not an array")
    with archive.open(member) as file:
        try:
            shape, _, dtype = _HEADERS[npy.read_magic(file)](file)
        except (ValueError, KeyError) as error:
            raise ValueError(f"array {name[:60]} with an unreadable header") from error
        start = file.tell()
    if dtype.hasobject:
        raise ValueError(f"array {name[:60]} of Python objects")
    if member.file_size != start + math.prod(shape) * dtype.itemsize:
        raise ValueError(f"array {name[:60]} of another size than it declares")
    return name, Declared(shape, dtype)
