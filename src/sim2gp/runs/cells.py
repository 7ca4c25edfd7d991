"""Cells of a long study: finished ones are on the disk, and never computed again.

A cell is one JSON file in a folder next to the run. It is written aside, flushed and
renamed, so that an interrupted study goes on where it was. It carries the checksum of
its bytes, its arguments, and the digest of the source that computed it: the modules
and the versions of `sim2gp.runs.sources`, which ``sources/DIGEST.json`` lists. A cell
that is damaged, of another source or of other arguments is refused until the user says
what to do with it. The cells of a finished study may be one file
(`sim2gp.runs.packed_cells`).
"""

import json
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sim2gp.cleanup import replace_file
from sim2gp.errors import error
from sim2gp.runs.packed_cells import unpacked
from sim2gp.runs.plain import to_json
from sim2gp.runs.sealed import is_sealed, parse, seal, unseal
from sim2gp.runs.sources import Source, digest_of, source_of
from sim2gp.runs.store import disk_error

#: What to do with cells that this source did not compute: refuse them, compute them
#: again, or use them. Damaged ones and those of other arguments are never used.
Old = Literal["refuse", "refresh", "keep"]

_SOURCE = "of another source"
_UNMARKED = "without a checksum, of an earlier version"
_ARGUMENTS = "with other arguments"
_DAMAGED = "damaged"
_KEPT = (_SOURCE, _UNMARKED)


@dataclass(frozen=True)
class _Found:
    """What a cell holds, and the reason not to trust it (empty for none)."""

    name: str
    values: dict[str, Any] | None
    reason: str = ""
    source: str = ""


class Cells:
    """The finished cells of the run that will be at ``out``.

    code: the file of the function that computes a cell (its module's ``__file__``).
    """

    def __init__(self, out: Path, code: str | Path, old: Old = "refuse") -> None:
        self.folder = out.parent / f"{out.name}.cells"
        self.source: Source = source_of(code)
        self.old = old

    def load(self, name: str, arguments: Mapping[str, Any]) -> dict[str, Any] | None:
        """What the cell holds; None where it is to be computed. Raises as `check`."""
        found = self._read(name, arguments)
        self._refuse([found])
        return None if found.reason and self.old == "refresh" else found.values

    def save(
        self, name: str, arguments: Mapping[str, Any], values: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Put a finished cell on the disk; returns what `load` will."""
        digest, plain = self.source.digest, _plain(values)
        content = {"arguments": _plain(arguments), "source": digest, "values": plain}
        listed = f"sources/{digest}.json"
        if self._content(listed) is None:
            _write(self.folder / listed, self.source.content.encode("utf-8"))
        _write(self.folder / f"{name}.json", seal(content))
        return plain

    def adopt(
        self, other: "Cells", cells: Iterable[tuple[str, Mapping[str, Any]]]
    ) -> None:
        """Copy those of the cells that are there and not here, with their source."""
        for name, arguments in cells:
            if self.load(name, arguments) or not other.load(name, arguments):
                continue
            source = other._read(name, arguments).source or other.source.digest
            for file in (f"{name}.json", f"sources/{source}.json"):
                if content := other._content(file):
                    _write(self.folder / file, content)

    def check(self, cells: Iterable[tuple[str, Mapping[str, Any]]]) -> None:
        """Refuse names and arguments of cells before any of them is computed.

        Raises `InputError` E186 with the counts, and the modules and versions that
        differ, for cells that ``old`` does not allow.
        """
        self._refuse([self._read(*cell) for cell in cells])

    def summary(self, cells: Iterable[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
        """What a summary says of a study's cells: their source, how many are older."""
        found = [self._read(*cell) for cell in cells]
        count = Counter(cell.reason for cell in found)
        older = count[_SOURCE] + count[_UNMARKED]
        about: dict[str, Any] = {
            "source": self.source.digest,
            "cells_of_other_source": older,
            "cells_without_checksum": count[_UNMARKED],
        }
        if older:
            text = f"{older} of {len(found)} cells are of another source (--keep-old)"
            about["warnings"] = [text]
        return about

    def _read(self, name: str, arguments: Mapping[str, Any]) -> _Found:
        content = self._content(f"{name}.json")
        if content is None:
            return _Found(name, None)
        record = _record(content)
        if record is None:
            return _Found(name, None, _DAMAGED)
        source, values = record.get("source", ""), record["values"]
        if record["arguments"] != _plain(arguments):
            return _Found(name, None, _ARGUMENTS)
        if not source:
            return _Found(name, values, _UNMARKED)
        reason = "" if source == self.source.digest else _SOURCE
        return _Found(name, values, reason, source)

    def _content(self, name: str) -> bytes | None:
        """A file of the folder, or of the pack of a finished study."""
        try:
            return (self.folder / name).read_bytes()
        except FileNotFoundError:
            return unpacked(self.folder).get(name)
        except OSError as caught:
            raise disk_error(self.folder, caught) from caught

    def _refuse(self, found: Iterable[_Found]) -> None:
        """Raise E186 where the user has not said what to do with one of them."""
        kept = _KEPT if self.old == "keep" else ()
        refused = [cell for cell in found if cell.reason and cell.reason not in kept]
        if not refused or self.old == "refresh":
            return
        parts = []
        for reason, count in sorted(Counter(cell.reason for cell in refused).items()):
            first = next(cell.name for cell in refused if cell.reason == reason)
            parts.append(f"{count} {reason} ({first}{', ...' * (count > 1)})")
        differ = self._differences({cell.source for cell in refused if cell.source})
        keep = all(cell.reason in _KEPT for cell in refused)
        other = (
            "--keep-old uses them" if keep else "remove them, or choose another --out"
        )
        got = ", ".join(parts) + (f"; other: {differ}" if differ else "")
        raise error("cells_of_others", where=str(self.folder), got=got, other=other)

    def _differences(self, digests: Iterable[str]) -> str:
        """The modules and versions in which other sources differ from this one."""
        modules: set[str] = set()
        packages: set[str] = set()
        for digest in digests:
            other = self._listed(digest)
            if other is None:
                return "an unknown source"
            modules |= _unlike(self.source.modules, other.modules)
            packages |= {
                f"{name} {other.versions.get(name, 'none')}"
                for name in _unlike(self.source.versions, other.versions)
            }
        named, more = sorted(modules)[:5], max(len(modules) - 5, 0)
        words = [*named, f"{more} more modules"] if more else named
        return ", ".join([*sorted(packages), *words])

    def _listed(self, digest: str) -> Source | None:
        """The source that a digest names; None where its list is gone or damaged."""
        content = self._content(f"sources/{digest}.json")
        if content is None:
            return None
        try:
            found = parse(content)
        except ValueError:
            return None
        if digest_of(content.decode("utf-8")) != digest:
            return None
        return Source(found["modules"], found["versions"])


def add_options(parser: ArgumentParser) -> None:
    """The options of a study's script, as ``sim2gp reproduce`` has them: ``old``."""
    group = parser.add_mutually_exclusive_group()
    for option, old, text in (
        ("--refresh", "refresh", "compute stored cells of another source again"),
        ("--keep-old", "keep", "use stored cells of another source"),
    ):
        group.add_argument(
            option,
            dest="old",
            action="store_const",
            const=old,
            default="refuse",
            help=text,
        )


def _record(content: bytes) -> dict[str, Any] | None:
    """A cell's record, without ``source`` if an earlier version wrote it; or None."""
    sealed = is_sealed(content)
    try:
        found = unseal(content) if sealed else parse(content)
    except ValueError:
        return None
    names = ["arguments", "source", "values"] if sealed else ["arguments", "values"]
    tables = found.get("arguments"), found.get("values")
    whole = sorted(found) == names and all(isinstance(x, dict) for x in tables)
    return found if whole else None


def _unlike(mine: Mapping[str, str], other: Mapping[str, str]) -> set[str]:
    """The names whose values are not the same in both."""
    return {name for name, _ in mine.items() ^ other.items()}


def _write(path: Path, content: bytes) -> None:
    """The file is there whole or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)
    except OSError as error:
        raise disk_error(path.parent, error) from error


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    """As it comes back from the disk: lists for tuples, floats for scalars."""
    plain: dict[str, Any] = json.loads(to_json(dict(values)))
    return plain
