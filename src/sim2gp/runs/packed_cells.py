"""The files of a finished study's cells in one: NAME.cells.jsonl.gz.

Each line is a JSON object of a file's name and its text, byte for byte as in the folder
NAME.cells, so that checksums and digests keep their meaning. Reading stops at `LIMIT`,
even if the file claims less.
"""

import contextlib
import gzip
import json
from functools import lru_cache
from pathlib import Path

from sim2gp.cleanup import replace_file
from sim2gp.errors import InputError
from sim2gp.runs.manifest import damaged
from sim2gp.runs.store import disk_error

LIMIT = 1 << 30  # bytes of all cells of a study


def packed_at(folder: Path) -> Path:
    """Where the pack of a folder of cells is."""
    return folder.with_name(f"{folder.name}.jsonl.gz")


def pack(folder: Path) -> Path:
    """Put a folder's JSON files, and those of an earlier pack, into one; E183, E190.

    A file of the folder takes the place of the pack's, and is removed once the pack is
    on the disk; so is the folder where nothing else is in it. The same files give the
    same bytes.
    """
    target, files = packed_at(folder), dict(unpacked(folder))
    paths = sorted(folder.rglob("*.json"))
    for path in paths:
        files[path.relative_to(folder).as_posix()] = path.read_bytes()
    lines = (
        json.dumps({"file": name, "text": content.decode("utf-8")}) + "\n"
        for name, content in sorted(files.items())
    )
    data = gzip.compress("".join(lines).encode("ascii"), mtime=0)
    try:
        replace_file(target, data)
        for path in paths:
            path.unlink()
        for place in (folder / "sources", folder):
            with contextlib.suppress(OSError):  # there is more in it, or it is gone
                place.rmdir()
    except OSError as caught:
        raise disk_error(target, caught) from caught
    return target


def unpacked(folder: Path) -> dict[str, bytes]:
    """The files of a folder's pack by name; none where there is no pack (E183)."""
    target = packed_at(folder)
    try:
        stamp = target.stat()
    except FileNotFoundError:
        return {}
    return _read(target, stamp.st_mtime_ns, stamp.st_size)


@lru_cache(maxsize=2)
def _read(target: Path, changed: int, size: int) -> dict[str, bytes]:
    """As it is at that time and of that size: a study asks for each cell by itself."""
    found, total = {}, 0
    try:
        with gzip.open(target, "rb") as file:
            while line := file.readline(LIMIT - total + 1):
                total += len(line)
                if total > LIMIT:
                    raise _damaged(target, f"more than {LIMIT >> 20} MiB")
                entry = json.loads(line)
                found[str(entry["file"])] = str(entry["text"]).encode("utf-8")
    except (OSError, EOFError, ValueError, KeyError, TypeError) as caught:
        raise _damaged(target, str(caught) or type(caught).__name__) from caught
    return found


def _damaged(target: Path, got: str) -> InputError:
    return damaged(target.parent, target.name, got)
