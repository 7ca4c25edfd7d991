"""A project file takes its place once it has been read back."""

import json
import re
from collections.abc import Callable
from pathlib import Path

from sim2gp.cleanup import replace_file
from sim2gp.project.project import Project, load_project

_BARE = re.compile(r"[A-Za-z0-9_-]+")


def quote(text: str) -> str:
    """A text as TOML writes it."""
    return json.dumps(text, ensure_ascii=False)


def key(name: str) -> str:
    """A name as a key of TOML: quoted where it must be."""
    return name if _BARE.fullmatch(name) else quote(name)


def replace_project(path: Path, text: str, check: Callable[[Project], object]) -> None:
    """Write ``text`` next to ``path``, load and check it there, then put it in place.

    Raises what the loading or ``check`` raises; the old file is then untouched.
    """
    replace_file(path, text.encode(), lambda aside: check(load_project(aside)))
