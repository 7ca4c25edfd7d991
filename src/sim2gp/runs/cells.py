"""Cells of a long study: finished ones are on the disk, and never computed again.

A cell is one JSON file in a folder beside the run. It is written aside, flushed and
renamed, so that an interrupted study goes on where it was; a cell that was computed
with other arguments counts as missing.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sim2gp.cleanup import replace_file
from sim2gp.runs.plain import to_json
from sim2gp.runs.store import disk_error


class Cells:
    """The finished cells of the run that will stand at ``out``."""

    def __init__(self, out: Path) -> None:
        self.folder = out.parent / f"{out.name}.cells"

    def load(self, name: str, arguments: Mapping[str, Any]) -> dict[str, Any] | None:
        """What the cell holds; None where it was not finished with these arguments."""
        try:
            text = (self.folder / f"{name}.json").read_text(encoding="utf-8")
        except FileNotFoundError:
            return None
        except OSError as error:
            raise disk_error(self.folder, error) from error
        try:
            found = json.loads(text)
        except json.JSONDecodeError:  # not ours, or damaged: computed again
            return None
        if not isinstance(found, dict) or found.get("arguments") != _plain(arguments):
            return None
        values: dict[str, Any] = found["values"]
        return values

    def save(
        self, name: str, arguments: Mapping[str, Any], values: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Put a finished cell on the disk; returns what `load` will."""
        content = {"arguments": _plain(arguments), "values": _plain(values)}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            replace_file(self.folder / f"{name}.json", to_json(content).encode())
        except OSError as error:
            raise disk_error(self.folder, error) from error
        plain: dict[str, Any] = content["values"]
        return plain


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """As it comes back from the disk: lists for tuples, floats for scalars."""
    plain: dict[str, Any] = json.loads(to_json(dict(values)))
    return plain
