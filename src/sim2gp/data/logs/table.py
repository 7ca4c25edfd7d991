"""Text to numbers: one CSV file becomes a table of float64 columns, or one clear error.

The first line names the columns, the rest are rows of numbers separated by commas.
Spaces around names and a byte-order mark are accepted. Only the columns that are asked
for are parsed, by numpy; an error is then looked for cell by cell, to name its line.
Lines are counted as an editor counts them: the header is line 1.
"""

import csv
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.file import (
    COMPRESSED,
    MAGIC,
    PICKLED,
    compression_error,
    display_path,
    pickle_error,
    read_bytes,
)
from sim2gp.data.logs.log import Note
from sim2gp.errors import InputError, error, nearest

_BINARY = (*(m for k, m in MAGIC.items() if k != "npz"), b"\x93NUMPY")
BLOCK = 20_000  # rows that are parsed at once
_DATE = re.compile(
    r"\d{4}-\d\d-\d\d|\d{1,2}:\d\d(:\d\d)?|\d{1,2}[/.]\d{1,2}[/.]\d{2,4}"
)


@dataclass(frozen=True)
class Rows:
    """What the rows of a table are called in messages: ``run.csv:line 9``."""

    source: str
    numbers: Int[np.ndarray, " N"]
    word: str = "line"

    def at(self, i: int) -> str:
        """The place of the row at position ``i``."""
        return f"{self.source}:{self.word} {self.numbers[i]}"

    def kept(self, which: Int[np.ndarray, " K"] | slice) -> "Rows":
        """Some of the rows, by their positions."""
        return replace(self, numbers=self.numbers[which])


@dataclass(frozen=True)
class LogTable:
    """Columns of one clock: ``columns[name]`` (N,), and what their rows are called.

    ``clock`` is in s where the format has stamps of its own, None where a column or the
    user says the time. ``stream`` names a table among several of one recording.
    """

    rows: Rows
    header: tuple[str, ...]
    columns: dict[str, Float[np.ndarray, " N"]]
    clock: Float[np.ndarray, " N"] | None = None
    stream: str = ""
    notes: tuple[Note, ...] = ()

    def kept(self, which: Int[np.ndarray, " K"] | slice) -> "LogTable":
        """Some of the rows, by their positions."""
        columns = {name: values[which] for name, values in self.columns.items()}
        clock = None if self.clock is None else self.clock[which]
        return replace(self, rows=self.rows.kept(which), columns=columns, clock=clock)


def decode(content: bytes, where: str) -> str:
    """Bytes to text: UTF-8 with or without a byte-order mark, no NUL bytes (E120)."""
    if content.startswith(PICKLED):
        raise pickle_error(where, "a pickle")
    if content.startswith(COMPRESSED):
        raise compression_error(where, content)
    nul = content.find(b"\x00")
    faults = [0] if content.startswith(_BINARY) else [nul] if nul >= 0 else []
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as caught:
        faults.append(caught.start)
    if not faults:
        return text
    offset = min(faults)
    raise error(
        "not_utf8_text",
        where=f"{where}:byte {offset}",
        got=f"byte 0x{content[offset]:02x}",
    )


def read_table(
    path: Path, wanted: Sequence[str] | None, time: str | None, meter: Meter
) -> LogTable:
    """Read the wanted columns of a CSV file as float64; empty cells become NaN.

    None wants every named column whose first cell is a number.
    """
    where = display_path(path)
    text = decode(read_bytes(path, meter.budget.bytes), where)
    lines = text.splitlines()
    filled = [i for i, line in enumerate(lines) if line and not line.isspace()]
    if not filled:
        raise error("empty_table", where=where, got="no text")
    numbers = np.asarray(filled, dtype=np.int64) + 1
    header = _split_header(lines[filled[0]], Rows(where, numbers[:1]))
    if len(filled) == 1:
        raise error("no_rows_below_header", where=where, got="0 rows")
    table = Rows(where, numbers[1:])
    rows = [lines[i] for i in filled[1:]]
    if wanted is None:
        wanted = _numeric(header, rows[0], table)
    places = {name: i for i, name in enumerate(header)}
    for name in wanted:
        if name not in places:
            raise missing_column(name, header, f"{where}:line 1")
    quoted = '"' in text
    meter.spend(8 * len(rows) * len(wanted))
    values = np.empty((len(rows), len(wanted)))
    _check_widths(rows, header, table, quoted, meter)
    columns = [places[name] for name in wanted]
    for i in range(0, len(rows), BLOCK):
        meter.tick()
        part = slice(i, i + BLOCK)
        kept = table.kept(part)
        values[part] = _parse(rows[part], columns, header, kept, quoted, time)
    found = {name: values[:, i] for i, name in enumerate(wanted)}
    return LogTable(table, header, found)


def _split_lines(lines: Sequence[str], table: Rows) -> Iterator[list[str]]:
    """The fields of each line; one that Python's parser does not take is E121."""
    reader = csv.reader(lines, skipinitialspace=True)
    try:
        yield from reader
    except csv.Error as caught:
        i = min(max(reader.line_num, 1), len(lines)) - 1
        raise error(
            "line_not_split",
            where=table.at(i),
            got=f"{caught}, in a line of {len(lines[i])} characters",
            limit=csv.field_size_limit(),
        ) from caught


def _split_header(line: str, table: Rows) -> tuple[str, ...]:
    where = table.at(0)
    (found,) = _split_lines([line], table)
    names = [name.strip() for name in found]
    if len(names) == 1:
        for mark, word in ((";", "semicolons"), ("\t", "tabs"), ("|", "bars")):
            if mark in line:
                raise _delimiter(line, where, word)
    if all(_is_number(name) for name in names if name):
        raise error("no_header", where=where, got=repr(_shorten(line)))
    first: dict[str, int] = {}
    for i, name in enumerate(names):
        if name and first.setdefault(name, i) != i:
            raise error(
                "repeated_column",
                where=where,
                got=f"columns {first[name] + 1} and {i + 1}",
                name=name,
            )
    return tuple(names)


def _numeric(header: tuple[str, ...], row: str, table: Rows) -> list[str]:
    (found,) = _split_lines([row], table)
    cells = [cell.strip() for cell in found]
    pairs = zip(header, cells, strict=False)
    return [name for name, cell in pairs if name and (not cell or _is_number(cell))]


def _delimiter(line: str, where: str, word: str) -> InputError:
    return error("wrong_delimiter", where=where, got=f"{word} in {_shorten(line)!r}")


def missing_column(
    name: str, header: Sequence[str], where: str, is_time: bool = False
) -> InputError:
    """E103 for a column, with the name that was probably meant."""
    entries = [n for n in header if n.startswith((f"{name}[", f"{name}/"))]
    close = entries[0] if entries else nearest(name, header)
    fix = f"did you mean {close}" if close else "name a column of the file"
    return error(
        "missing_column",
        where=where,
        got=_shorten(", ".join(header[:60]), 120) or "no columns",
        name=name,
        fix=fix + (", or state period (in s)" if is_time else ""),
    )


def _check_widths(
    rows: list[str],
    header: tuple[str, ...],
    table: Rows,
    quoted: bool,
    meter: Meter,
) -> None:
    """Every row has as many fields as the header (E121), and commas between them."""
    if quoted:
        widths = []
        for fields in _split_lines(rows, table):
            meter.tick()
            widths.append(len(fields))
        if len(widths) != len(rows):
            raise error(
                "quote_never_closes",
                where=table.source,
                got=f"{len(widths)} records on {len(rows)} lines",
            )
    else:
        widths = [row.count(",") + 1 for row in rows]
    want = len(header)
    wrong = np.flatnonzero(np.asarray(widths) != want)
    if wrong.size == 0:
        return
    i = int(wrong[0])
    place, line = table.at(i), rows[i]
    if wrong.size == len(rows) and not quoted:
        if widths[i] == 1 and any(mark in line for mark in ";\t"):
            raise _delimiter(line, place, "semicolons or tabs")
        if set(widths) == {2 * want}:
            raise _delimiter(line, place, "decimal commas")
    raise error(
        "ragged_row",
        where=place,
        got=f"{widths[i]} fields",
        want=want,
        count=wrong.size,
    )


def _parse(
    rows: list[str],
    columns: list[int],
    header: tuple[str, ...],
    table: Rows,
    quoted: bool,
    time: str | None,
) -> Float[np.ndarray, "N k"]:
    if not quoted:
        try:
            return np.loadtxt(
                rows,
                delimiter=",",
                usecols=columns,
                ndmin=2,
                comments=None,
                dtype=np.float64,
            )
        except ValueError:
            pass  # some cell is not a number: the search below says which
    out = np.empty((len(rows), len(columns)))
    lines = _split_lines(rows, table)
    for r, fields in enumerate(lines):
        for c, column in enumerate(columns):
            cell = fields[column].strip()
            if not cell:
                out[r, c] = np.nan
            elif _is_number(cell):
                out[r, c] = float(cell)
            else:
                name = header[column]
                place = f"{table.at(r)}, column {name}"
                raise _not_a_number(cell, place, name == time)
    return out


def _not_a_number(cell: str, place: str, is_time: bool) -> InputError:
    got = repr(_shorten(cell))
    if is_time and _DATE.search(cell):
        return error("time_as_date", where=place, got=got)
    if cell.lower() in ("true", "false") or _is_complex(cell):
        return error("truth_or_complex_cell", where=place, got=got)
    if "," in cell:
        return error("thousands_separators", where=place, got=got)
    return error("text_in_cell", where=place, got=got)


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell


def _is_complex(cell: str) -> bool:
    try:
        complex(cell.replace("i", "j"))
    except ValueError:
        return False
    return True


def _shorten(text: str, width: int = 40) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."
