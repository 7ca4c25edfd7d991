"""A file takes its place whole or not at all, a project once it has been read back."""

import json
import os
import re
import tempfile
from collections.abc import Callable
from pathlib import Path

from sim2gp.project.project import Project, load_project

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def quoted(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)


def key(name: str) -> str:
    """A name as a key of TOML: quoted where it must be."""
    return name if _BARE.fullmatch(name) else quoted(name)


def replace_project(path: Path, text: str, check: Callable[[Project], object]) -> None:
    """Write ``text`` beside ``path``, load and check it there, then put it in place.

    Raises whatever the loading or ``check`` raises; the old file is then untouched.
    """
    replace_file(path, text.encode(), lambda aside: check(load_project(aside)))


def replace_file(
    path: Path, data: bytes, check: Callable[[Path], object] = lambda aside: None
) -> None:
    """Write ``data`` beside ``path``, and put it in place once ``check`` has passed."""
    handle, aside = tempfile.mkstemp(
        dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix
    )
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        check(Path(aside))
        mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
        os.chmod(aside, mode)
        os.replace(aside, path)
    finally:
        if os.path.exists(aside):
            os.unlink(aside)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
