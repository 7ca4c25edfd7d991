"""The text of a project file: parsed safely, and every key remembered with its line.

TOML runs no code; what remains is size, depth, and values that other tools would
evaluate. Python's parser forgets where a key was, so the text is scanned once more:
`Source.where` names the line of the longest part of a key's path that the file spells.
"""

import re
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim2gp.data.logs.file import display_path, read_bytes
from sim2gp.data.logs.table import decode
from sim2gp.errors import InputError, error
from sim2gp.project.syntax import fix_for_repeated, fix_for_syntax

MAX_BYTES = 1_000_000
MAX_DEPTH = 64
Path_ = tuple[str | int, ...]

_KEY = r"""(?:[A-Za-z0-9_-]+|"(?:[^"\\]|\\.)*"|'[^']*')"""
_DOTTED = re.compile(rf"\s*({_KEY}(?:\s*\.\s*{_KEY})*)\s*")
#: Strings and comments. A string that never closes is one to the end of its line, or of
#: the file: from each of many such the rest would be looked through again.
_TOKEN = re.compile(
    r'"""(?:[^\\]|\\.?)*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)'
    r'|"(?:[^"\\\n]|\\.?+)*+(?:"|(?=\n)|\Z)|\'[^\'\n]*\'|#[^\n]*',
    re.DOTALL,
)
#: Keys, dots, brackets and what lies between them, each character looked at once.
_PIECE = re.compile(
    r"""(?P<key>[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')|(?P<space>\s++)|.""", re.DOTALL
)
#: A line that TOML has not, as a file of YAML begins.
_YAML = re.compile(r"^(---|%YAML|-\s|[\w\"'-]+\s*:(\s|$))")
_HOSTILE = re.compile(r"\$\{|^\s*(eval|exec|import|env|file|python)\s*:|^\s*!!")


@dataclass(frozen=True)
class ProjectSource:
    """A parsed project file: its text, its values, and the line of each key."""

    name: str
    text: str
    values: dict[str, Any]
    lines: dict[Path_, int]

    def where(self, *path: str | int) -> str:
        """``file:line 7, key parameters.m2.sd`` for the key at a path."""
        spelt = path
        while spelt and spelt not in self.lines:
            spelt = spelt[:-1]
        line = self.lines.get(spelt, 1)
        key = ".".join(str(part) for part in path if isinstance(part, str))
        return f"{self.name}:line {line}" + (f", key {key}" if key else "")


def read_source(path: Path) -> ProjectSource:
    """Read and parse a project file (E120, E130, E160, E161, E162)."""
    name = display_path(path)
    return parse_project(decode(read_bytes(path, limit=64 * MAX_BYTES), name), name)


def parse_project(text: str, name: str) -> ProjectSource:
    """Parse the text of a project file that is called ``name`` (E160, E161, E162)."""
    if len(text) > MAX_BYTES:
        raise _too_large(name, f"{len(text)} characters", f"at most {MAX_BYTES}")
    # Strings and comments keep their length and lines but lose their content.
    bare = _TOKEN.sub(_blank, text)
    depth = _depth(bare)
    if depth > MAX_DEPTH:
        raise _too_large(name, f"a nesting of {depth}", f"at most {MAX_DEPTH}")
    try:
        values = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as caught:
        raise _other_file(name, bare) or _syntax(name, text, str(caught)) from caught
    lines: dict[Path_, int] = {}
    for key, line in _key_lines(text, bare):
        lines.setdefault(key, line)  # of a table in pieces, the first
    source = ProjectSource(name, text, values, lines)
    for key, value in _key_paths(values, ()):
        if _is_hostile(key, value):
            where, got = source.where(*key), repr(value)[:40]
            raise error("code_in_project_file", where=where, got=got)
    return source


def _too_large(name: str, got: str, expected: str) -> InputError:
    return error("project_file_too_large", where=name, got=got, expected=expected)


def _other_file(name: str, bare: str) -> InputError | None:
    """A file that begins as a model does, or as YAML, is not read, under any name."""
    line = next((x for x in bare.splitlines() if x.strip()), "")
    if line.lstrip().startswith("<"):
        got = "XML, as of a model"
        return error("model_as_project_file", where=name, got=got, name=name)
    if not _YAML.match(line):
        return None
    got = "YAML, whose aliases and tags are not read"
    return error("project_file_in_yaml", where=name, got=got)


def _blank(match: re.Match[str]) -> str:
    token = match.group()
    if token.startswith(("#", '"""', "'''")):
        return re.sub(r"[^\n]", " ", token)
    # Keys may be quoted: the quotes stay so that a quoted key is still a key.
    inner = re.sub(r"[^\n]", "_", token[1:-1])
    return token[0] + inner + token[-1]


def _depth(bare: str) -> int:
    """Deepest nesting of brackets, or longest dotted key."""
    depth = deepest = keys = 0
    dotted = False
    for piece in _PIECE.finditer(bare):
        if piece["space"]:
            continue
        mark = piece.group()
        if piece["key"]:
            keys = keys + 1 if dotted else 1
        elif mark in "[{":
            depth += 1
        elif mark in "]}":
            depth = max(0, depth - 1)
        dotted = mark == "." and keys > 0
        deepest = max(deepest, depth, keys)
    return deepest


def _syntax(name: str, text: str, message: str) -> InputError:
    place = re.search(r"at line (\d+), column (\d+)", message)
    line = int(place.group(1)) if place else len(text.splitlines())
    column = int(place.group(2)) if place else 1
    rows = text.splitlines()
    row = rows[line - 1] if 0 < line <= len(rows) else ""
    reason = re.sub(r"\s*\(at .*\)", "", message)
    twice = re.search(r"overwrite|twice|redefine|already", reason, re.IGNORECASE)
    where, got = f"{name}:line {line}", repr(row.strip()[:60])
    if not twice:
        fix, said = fix_for_syntax(reason, row, column), reason[:80].lower()
        return error("not_valid_toml", where=where, got=got, reason=said, fix=fix)
    if _table_at(text, line).startswith("parameters"):
        return error(
            "duplicate_parameter", where=where, got=got, fix=fix_for_repeated(row)
        )
    return error("repeated_key", where=where, got=got, fix=fix_for_repeated(row))


def _table_at(text: str, line: int) -> str:
    headers = [m for m in text.splitlines()[:line] if m.lstrip().startswith("[")]
    return headers[-1].strip(" []") if headers else ""


def _key_lines(text: str, bare: str) -> Iterator[tuple[Path_, int]]:
    """The path and line of each table header and each key at a line's start."""
    table: Path_ = ()
    counts: dict[Path_, int] = {}
    depth = 0
    for number, (line, shape) in enumerate(
        zip(text.split("\n"), bare.split("\n"), strict=True), 1
    ):
        stripped = line.strip()
        if not shape.strip():
            continue  # blank, a comment, or inside a long string
        if depth == 0 and stripped.startswith("["):
            double = stripped.startswith("[[")
            found = _DOTTED.match(stripped.lstrip("["))
            if found:
                parts = _split_key(found.group(1))
                table = _resolve(parts, counts, double)
                for end in range(1, len(table) + 1):
                    yield table[:end], number
            continue
        found = _DOTTED.match(line) if depth == 0 else None
        if found and line[found.end() :].startswith("="):
            key = (*table, *_split_key(found.group(1)))
            for end in range(len(table) + 1, len(key) + 1):
                yield key[:end], number
            yield from _inline(key, line[found.end() + 1 :], number)
        marks = re.sub(r'"[^"]*"|\'[^\']*\'', "", shape)
        depth += sum(marks.count(c) for c in "[{") - sum(marks.count(c) for c in "]}")
        depth = max(depth, 0)


def _inline(key: Path_, rest: str, number: int) -> Iterator[tuple[Path_, int]]:
    """Keys of a one-line inline table share its line."""
    if rest.lstrip().startswith("{"):
        for inner in re.findall(rf"[{{,]\s*({_KEY})\s*=", rest):
            yield (*key, *_split_key(inner)), number


def _resolve(parts: Path_, counts: dict[Path_, int], double: bool) -> Path_:
    """A header's path with the index of each array of tables that it passes."""
    table: Path_ = ()
    for i, part in enumerate(parts):
        table = (*table, part)
        if double and i == len(parts) - 1:
            counts[table] = counts.get(table, -1) + 1
        if table in counts:
            table = (*table, counts[table])
    return table


def _split_key(dotted: str) -> Path_:
    return tuple(part.strip("\"'") for part in re.findall(_KEY, dotted))


def _key_paths(value: Any, path: Path_) -> Iterator[tuple[Path_, Any]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            yield (*path, key), ""
            yield from _key_paths(inner, (*path, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from _key_paths(inner, (*path, i))
    else:
        yield path, value


def _is_hostile(path: Path_, value: Any) -> bool:
    key = str(path[-1])
    spelt = isinstance(value, str) and _HOSTILE.search(value) is not None
    return key in ("_target_", "__class__", "_partial_") or spelt
