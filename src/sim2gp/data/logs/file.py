"""Files of robot data before they are parsed: what kind, whole and unchanged.

The suffix names the format and the first bytes must agree.
"""

import importlib
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sim2gp.errors import InputError, error, nearest

SUFFIXES = {
    ".npz": "npz",
    ".parquet": "parquet",
    ".pq": "parquet",
    ".h5": "hdf5",
    ".hdf5": "hdf5",
    ".bag": "rosbag1",
    ".db3": "rosbag2",
    ".mcap": "mcap",
}
FOLDERS = {
    "lerobot": ("meta/info.json",),
    "rosbag2": ("metadata.yaml",),
    "minari": ("data/metadata.json", "metadata.json"),
}
MAGIC = {
    "npz": b"PK\x03\x04",
    "parquet": b"PAR1",
    "hdf5": b"\x89HDF\r\n\x1a\n",
    "rosbag1": b"#ROSBAG V2.0\n",
    "rosbag2": b"SQLite format 3\x00",
    "mcap": b"\x89MCAP0\r\n",
}
COMPRESSED = (b"\x1f\x8b", b"BZh", b"\xfd7zXZ", b"PK\x03\x04", b"\x28\xb5\x2f\xfd")
_PICKLES = (".pkl", ".pickle", ".pt", ".pth", ".ckpt", ".joblib")
PICKLED = tuple(bytes([0x80, protocol]) for protocol in range(2, 6))


def display_path(path: Path) -> str:
    """A path as the user would write it: relative when it lies below the folder."""
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def kind_of(path: Path) -> str:
    """The format of a file or folder: "csv" or one of `SUFFIXES` and `FOLDERS`.

    Raises `InputError` E115, E120, E126, E130, E180, E181 where name and content
    differ.
    """
    _check_nul(path)
    if path.is_dir():
        for kind, marks in FOLDERS.items():
            if any((path / mark).is_file() for mark in marks):
                return kind
        raise _not_a_file(display_path(path), stat.S_IFDIR)
    if path.suffix.lower() in _PICKLES:
        raise pickle_error(display_path(path), path.suffix)
    if path.suffix.lower() == ".safetensors":
        raise _tensors(read_bytes(path, first=16), display_path(path))
    kind = SUFFIXES.get(path.suffix.lower(), "csv")
    if kind in MAGIC:  # a format of text has no first bytes of its own
        _check_magic(read_bytes(path, first=16), kind, display_path(path))
    return kind


def _check_magic(first: bytes, kind: str, where: str) -> None:
    if first.startswith(MAGIC[kind]):
        return
    if not first:
        raise error("empty_recording", where=where, got="0 bytes", format=kind)
    if first.startswith(PICKLED):
        raise pickle_error(where, "a pickle")
    if first.startswith(COMPRESSED) and not first.startswith(MAGIC["npz"]):
        raise compression_error(where, first)
    other = [name for name, magic in MAGIC.items() if first.startswith(magic)]
    raise error(
        "not_what_its_name_says",
        where=where,
        got=f"the first bytes of {other[0]}" if other else f"first bytes {first[:4]!r}",
        format=kind,
        magic=repr(MAGIC[kind][:6]),
    )


def _tensors(first: bytes, where: str) -> InputError:
    """E181: no header of a format that nothing here writes is believed."""
    if first.startswith((*PICKLED, MAGIC["npz"])):  # as PyTorch saves objects
        return pickle_error(where, "a pickle")
    return error(
        "safetensors_refused",
        where=where,
        got=f"first bytes {first[:8].hex() or 'none'}",
        formats=", ".join(["CSV", *MAGIC]),
    )


def pickle_error(where: str, got: str) -> InputError:
    """E180: loading a pickle runs the code in it, so none is ever opened."""
    return error("pickle_refused", where=where, got=got)


def compression_error(where: str, first: bytes) -> InputError:
    """E126: what a compressed text would unpack to is not known."""
    return error("compressed_file", where=where, got=f"first bytes {first[:2].hex()}")


def read_bytes(path: Path, limit: int | None = None, first: int | None = None) -> bytes:
    """The content of a regular file, or its first bytes (E126, E129, E130).

    Folders, devices and pipes are refused.
    """
    with unchanged_size(path, limit):
        try:
            if first is None:
                return path.read_bytes()
            with path.open("rb") as file:
                return file.read(first)
        except OSError as error:
            raise _file_unreadable(path, error) from error


@contextmanager
def unchanged_size(path: Path, limit: int | None = None) -> Iterator[int]:
    """The size of a regular file that is the same afterwards (E126, E129 to E131)."""
    where = display_path(path)
    _check_nul(path)
    before = _file_status(path)
    if not stat.S_ISREG(before.st_mode):
        raise _not_a_file(where, before.st_mode)
    if limit is not None and before.st_size > limit:
        raise error(
            "file_too_large", where=where, got=f"{before.st_size} bytes", limit=limit
        )
    yield before.st_size
    after = _file_status(path)
    if (before.st_size, before.st_mtime_ns) != (after.st_size, after.st_mtime_ns):
        raise error(
            "file_changed_while_read",
            where=where,
            got=f"{before.st_size} then {after.st_size} bytes",
        )


def _file_status(path: Path) -> os.stat_result:
    try:
        return os.stat(path)
    except OSError as error:
        raise _file_unreadable(path, error) from error


def import_optional(module: str, extra: str, what: str) -> Any:
    """A module of an optional package, imported when a file needs it (E135)."""
    try:
        return importlib.import_module(module)
    except ImportError as caught:
        raise error(
            "package_missing",
            got=str(caught),
            what=what,
            extra=extra,
            expected=module.split(".")[0],
        ) from caught


def _check_nul(path: Path) -> None:
    if "\x00" in str(path):
        raise error(
            "nul_in_path", where=repr(display_path(path)), got="a NUL character"
        )


def _not_a_file(where: str, mode: int) -> InputError:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a pipe",
        stat.S_IFSOCK: "a socket",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
    }
    return error(
        "not_a_file", where=where, got=kinds.get(stat.S_IFMT(mode), "something else")
    )


def _file_unreadable(path: Path, caught: OSError) -> InputError:
    folder = path.parent
    hint = "check the path"
    if isinstance(caught, FileNotFoundError):
        if path.is_symlink():
            hint = f"the link points to {os.readlink(path)}, which is not there"
        elif folder.is_dir():
            stems = [p.stem for p in folder.iterdir() if p.suffix == path.suffix]
            close = nearest(path.stem, stems)
            hint = f"did you mean {close}{path.suffix}" if close else hint
    elif isinstance(caught, PermissionError):
        hint = "give yourself the right to read it"
    return error(
        "file_cannot_be_read",
        where=display_path(path),
        got=(caught.strerror or str(caught)).lower(),
        fix=hint,
    )
