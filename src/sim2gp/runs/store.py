"""A run directory appears whole or not at all, and says when it is no longer whole.

Files are written into a hidden sibling of the target, each flushed to the disk, with a
``manifest.json`` of their sizes and SHA-256 at the end; then the sibling is renamed to
the target. An earlier run there is first renamed to ``.NAME.previous``. It is read from
there should the machine stop just then, and removed when the new one is in place (files
that the run did not write are carried over). A failed command removes the sibling and
the folders it made. ``.NAME.lock`` is locked meanwhile: a second process on the same
target gets an error. The lock ends with its process, and what a killed one left is
removed.
"""

import errno
import hashlib
import io
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from filelock import FileLock, Timeout

from sim2gp import cleanup
from sim2gp.errors import InputError, Sim2GPError, error
from sim2gp.runs.archive import load_arrays
from sim2gp.runs.manifest import FORMAT, MANIFEST, damaged, not_a_run, read_manifest
from sim2gp.runs.plain import environment, to_json, version
from sim2gp.runs.sealed import parse, seal

SUMMARY = "summary.json"
ARRAYS = "arrays.npz"
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EFBIG)


class DiskError(Sim2GPError):
    """E190: the disk is full or broken; nothing of the run was changed (exit 74)."""


class RunOwned(Sim2GPError):
    """E191: another process writes this run directory (exit 75)."""


@dataclass
class Writer:
    """The files of a run that is not committed yet."""

    folder: Path
    files: dict[str, dict[str, Any]] = field(default_factory=dict)

    def write_bytes(self, name: str, content: bytes) -> None:
        """Write one file and wait until it is on the disk."""
        target = self.folder / _plain(name)
        target.parent.mkdir(parents=True, exist_ok=True)
        with open(target, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        digest = hashlib.sha256(content).hexdigest()
        self.files[name] = {"bytes": len(content), "sha256": digest}

    def write_text(self, name: str, text: str) -> None:
        """Write text as UTF-8."""
        self.write_bytes(name, text.encode("utf-8"))

    def write_json(self, name: str, values: Mapping[str, Any]) -> None:
        """Write a table as JSON; every number must be finite (E203)."""
        self.write_text(name, to_json(values))

    def write_arrays(self, name: str, arrays: Mapping[str, Any]) -> None:
        """Write numeric arrays as one ``.npz``; object arrays are refused (E182)."""
        plain = {key: np.asarray(value) for key, value in arrays.items()}
        for key, value in plain.items():
            if value.dtype.kind not in "biufcSU":
                got = f"dtype {value.dtype}"
                raise error("run_array_of_objects", Sim2GPError, got=got, name=key)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=False, **plain)
        self.write_bytes(name, buffer.getvalue())

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        self.write_json(SUMMARY, summary)


@dataclass(frozen=True)
class Run:
    """A finished run: its folder, summary, and arrays by name."""

    path: Path
    summary: dict[str, Any]
    arrays: dict[str, np.ndarray]


@contextmanager
def new_run(path: Path | str, command: str) -> Iterator[Writer]:
    """Write a run directory: committed when the block ends, gone when it raises.

    Raises `InputError` E132 for a folder that is not a run and not empty, `RunOwned`
    for one that another process writes, `DiskError` when the disk fails.
    """
    path = Path(os.path.abspath(path))
    try:
        check_target(path)
        made = _make_parents(path.parent)
        try:
            with _locked(path), _staging(path, made) as folder:
                _settle(path)
                writer = Writer(folder)
                yield writer
                _commit(writer, path, command)
        except BaseException:
            for parent in made:
                _remove_if_empty(parent)
            raise
    except BrokenPipeError:
        raise  # somebody closed the stream we print to; the disk is well
    except OSError as error:
        raise disk_error(path, error) from error


def check_target(path: Path) -> None:
    """Refuse to write into a folder that is somebody else's (E132)."""
    if not path.exists() and not path.is_symlink():
        return
    if path.is_dir() and not path.is_symlink():
        if (path / MANIFEST).is_file() or not any(path.iterdir()):
            return
        got = "a folder with other files"
    else:
        got = "a link" if path.is_symlink() else "a file"
    raise error("output_is_not_a_run", where=str(path), got=got)


def check_absent(path: Path) -> None:
    """Refuse to write a file where there is something, or no folder for it (E132)."""
    there = path.exists() or path.is_symlink()
    if path.parent.is_dir() and not there:
        return
    if there:
        raise error("file_exists", where=str(path), got="something of that name")
    raise error("no_folder_for_file", where=str(path.parent), got="nothing there")


@dataclass(frozen=True)
class Stored:
    """A run that is whole: its folder, its summary, the bytes of its arrays (or None).

    No array is built yet.
    """

    path: Path
    summary: dict[str, Any]
    arrays: bytes | None


def load_run(path: Path | str) -> Run:
    """Read a run's summary and arrays, checked by its manifest (E130, E183, E185).

    Reports and pictures are not read: they may be drawn again from these two.
    """
    stored = read_run(path)
    if stored.arrays is None:
        return Run(stored.path, stored.summary, {})
    try:
        arrays = load_arrays(stored.arrays)
    except ValueError as error:
        raise damaged(stored.path, ARRAYS, str(error)) from error
    return Run(stored.path, stored.summary, arrays)


def read_text(path: Path | str, name: str) -> str:
    """A further file of a run, checked by its manifest (E130, E183, E185)."""
    path = Path(path)
    files = read_manifest(path)["files"]
    if name not in files:
        raise not_a_run(path, f"a {MANIFEST} without {name}")
    return _read_file(path / name, path, files[name]).decode("utf-8")


def read_run(path: Path | str) -> Stored:
    """Read a run without building its arrays (E130, E183, E185)."""
    path = Path(path)
    place = path if path.exists() or not _previous(path).exists() else _previous(path)
    files = read_manifest(place)["files"]
    if SUMMARY not in files:
        raise not_a_run(path, f"a {MANIFEST} without {SUMMARY}")
    contents = {
        name: _read_file(place / name, path, files[name])
        for name in (SUMMARY, ARRAYS)
        if name in files
    }
    try:
        summary = parse(contents[SUMMARY])
    except ValueError as error:
        raise damaged(path, SUMMARY, str(error)) from error
    return Stored(path, summary, contents.get(ARRAYS))


def _read_file(file: Path, path: Path, entry: dict[str, Any]) -> bytes:
    """The bytes that the manifest's entry describes (E183)."""
    try:
        size = file.stat().st_size
        content = file.read_bytes() if size == entry["bytes"] else b""
    except OSError as error:
        raise damaged(path, file.name, (error.strerror or "").lower()) from error
    if size != entry["bytes"]:
        raise damaged(path, file.name, f"{size} bytes, not {entry['bytes']}")
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        raise damaged(path, file.name, f"{size} bytes of another checksum")
    return content


def disk_error(path: Path, caught: OSError) -> Sim2GPError:
    """What the disk refused, as an error of ours: E190 (exit 74) or E130 (exit 2)."""
    reason = (caught.strerror or str(caught)).lower()
    if caught.errno in _FULL:
        return error("disk_failure", DiskError, where=str(path), got=reason)
    where = str(caught.filename or path)
    return error("output_cannot_be_written", where=where, got=reason)


def _plain(name: str) -> Path:
    """A name below the run directory, never outside it."""
    path = Path(name)
    if path.is_absolute() or ".." in path.parts or name in ("", "."):
        raise error("file_outside_run", Sim2GPError, got=name)
    return path


def _make_parents(folder: Path) -> list[Path]:
    """Make missing folders; returns those made, the deepest first."""
    missing = []
    while not folder.exists():
        missing.append(folder)
        folder = folder.parent
    for parent in reversed(missing):
        parent.mkdir(exist_ok=True)
    return missing


def _remove_if_empty(folder: Path) -> None:
    try:
        folder.rmdir()
    except OSError:
        return  # not empty, or not ours any more: it stays


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Nobody else writes this run while the block runs (E191 where somebody does)."""
    file = _lock_file(path)
    lock = FileLock(file, timeout=0)
    try:
        lock.acquire()
    except Timeout as caught:
        raise error("run_owned", RunOwned, where=str(path)) from caught
    try:
        yield
    finally:
        # Before it is released: who locks a file that is gone by then tries again.
        # Windows removes no open file; there the library does it.
        with suppress(OSError):
            file.unlink()
        lock.release()


@contextmanager
def _staging(path: Path, made: Sequence[Path]) -> Iterator[Path]:
    """The hidden sibling that the run is written into, made new, gone afterwards.

    ``made`` are the folders that go with it if the process is ended meanwhile.
    """
    folder = path.with_name(f".{path.name}.partial")
    if os.path.lexists(folder):  # left by a process that was killed
        shutil.rmtree(folder)

    def abandon() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        _lock_file(path).unlink(missing_ok=True)
        for parent in made:
            _remove_if_empty(parent)

    with cleanup.registered(abandon):
        try:
            folder.mkdir()
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)


def _lock_file(path: Path) -> Path:
    return path.with_name(f".{path.name}.lock")


def _commit(writer: Writer, path: Path, command: str) -> None:
    manifest = {
        "sim2gp": version("sim2gp"),
        "format": FORMAT,
        "command": command,
        "environment": environment(),
        "files": writer.files,
    }
    writer.write_bytes(MANIFEST, seal(manifest))
    for folder in sorted({(writer.folder / n).parent for n in writer.files}):
        _sync(folder)
    check_target(path)
    with cleanup.undisturbed():
        if path.exists():
            _swap(writer.folder, path)
        else:
            os.rename(writer.folder, path)
            _sync(path.parent)


def _swap(folder: Path, path: Path) -> None:
    """Put the new run in the place of an earlier one: the second rename decides."""
    previous = _previous(path)
    os.rename(path, previous)
    try:
        os.rename(folder, path)
    except BaseException:
        os.rename(previous, path)
        raise
    _sync(path.parent)
    _settle(path)


def _previous(path: Path) -> Path:
    return path.with_name(f".{path.name}.previous")


def _settle(path: Path) -> None:
    """Finish, or undo, a replacement: afterwards only ``path`` is there."""
    previous = _previous(path)
    if not previous.exists():
        return
    if not path.exists():
        os.rename(previous, path)
        return
    try:
        written = {*read_manifest(previous)["files"], MANIFEST}
    except InputError:
        written = {MANIFEST}  # damaged: nothing says what the run had written
    for file in [f for f in previous.rglob("*") if f.is_file()]:
        name = file.relative_to(previous)
        if str(name) not in written and not (path / name).exists():
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(file, path / name)
    shutil.rmtree(previous, ignore_errors=True)


def _sync(folder: Path) -> None:
    if not hasattr(os, "O_DIRECTORY"):
        return  # Windows opens no folder, and keeps renames by itself
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
