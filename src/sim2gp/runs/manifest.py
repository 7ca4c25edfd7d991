"""The manifest of a run: what was written, with the checksum of every file.

Since format 2 it carries its own (`sim2gp.runs.sealed`).
"""

import re
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim2gp.errors import InputError, error
from sim2gp.runs.sealed import is_sealed, parse, unseal

FORMAT = 2
SEALED = 2  # the first format with a checksum of its own
MANIFEST = "manifest.json"
#: Of a manifest, bytes: that of a run of ten thousand files has two million.
LARGEST = 2**24


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_table_of_text(value: Any) -> bool:
    return isinstance(value, dict) and all(map(_is_text, value.values()))


def _is_table_of_files(value: Any) -> bool:
    """``{name: {"bytes": size, "sha256": digest}}``."""
    return isinstance(value, dict) and all(map(_is_entry, value.values()))


def _is_entry(value: Any) -> bool:
    if not isinstance(value, dict) or set(value) != {"bytes", "sha256"}:
        return False
    size, digest = value["bytes"], value["sha256"]
    good = type(size) is int and size >= 0 and isinstance(digest, str)
    return good and re.fullmatch("[0-9a-f]{64}", digest) is not None


#: What a manifest must hold: of each entry the rule, and the rule in words.
_ENTRIES: dict[str, tuple[Callable[[Any], bool], str]] = {
    "format": (lambda x: type(x) is int and x >= 1, "a whole number from 1"),
    "sim2gp": (_is_text, "a version"),
    "command": (_is_text, "the words of a command"),
    "environment": (_is_table_of_text, "a table of versions"),
    "files": (_is_table_of_files, "a table of sizes and checksums"),
}


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of the run at ``path``.

    Raises `InputError` E130 where there is none, E183 for anything but what `new_run`
    writes, E185 for a newer format.
    """
    target = path / MANIFEST
    try:
        status = target.stat()
        if not stat.S_ISREG(status.st_mode):
            raise not_a_run(path, f"{MANIFEST}: not a file")
        content = target.read_bytes() if status.st_size <= LARGEST else b""
    except OSError as caught:
        got = f"{MANIFEST}: {(caught.strerror or '').lower()}"
        raise not_a_run(path, got) from caught
    try:
        if status.st_size > LARGEST:
            raise ValueError(f"{status.st_size} bytes, more than {LARGEST}")
        sealed = is_sealed(content)
        manifest = unseal(content) if sealed else parse(content)
    except ValueError as caught:
        raise damaged(path, MANIFEST, str(caught)) from caught
    number = manifest.get("format")
    if type(number) is int and number > FORMAT:
        raise error("newer_run", where=str(target), got=number, newest=FORMAT)
    for name, (rule, expected) in _ENTRIES.items():
        if name not in manifest or not rule(manifest[name]):
            raise damaged(path, MANIFEST, f"an entry {name} that is not {expected}")
    if sealed != (manifest["format"] >= SEALED):
        raise damaged(path, MANIFEST, "no checksum of its own")
    return manifest


def not_a_run(path: Path, got: str) -> InputError:
    """E130: nothing that a command of ours wrote."""
    if path.is_file():
        where, stem, got = str(path), path.stem, "a file"
        return error("file_in_place_of_a_run", where=where, got=got, stem=stem)
    return error("not_a_run", where=str(path), got=got)


def damaged(path: Path, name: str, got: str) -> InputError:
    """E183: a file of a run is not as it was written."""
    return error("damaged_run", where=f"{path}/{name}", got=got)
