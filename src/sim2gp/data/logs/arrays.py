"""Named arrays of a file become columns: ``q`` of shape (N,), ``state`` (N, k) as
``state[0]``, ``state[1]``, ... or by the names that the format gives them.

Shapes and dtypes are known before anything is read, so that what cannot be a column is
refused, and what does not fit in memory is never allocated.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Shaped

from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.log import Note
from sim2gp.data.logs.table import LogTable, Rows, missing_column
from sim2gp.errors import error

MAX_WIDTH = 256  # columns of one array; above, it is a picture or a cloud of points
EXACT = 2**53  # whole numbers beyond lose digits in float64


@dataclass(frozen=True)
class LazyArray:
    """An array of a file that is not read yet, rows first; ``labels`` its columns."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], Shaped[np.ndarray, "..."]]
    labels: tuple[str, ...] = ()

    def names(self, name: str) -> list[str]:
        """What the columns of the array are called."""
        if len(self.shape) != 2:
            return [name]
        if self.labels:
            return [f"{name}/{label}" for label in self.labels]
        return [f"{name}[{i}]" for i in range(min(self.shape[1], MAX_WIDTH))]

    @property
    def is_numeric(self) -> bool:
        """Whether its columns are real numbers of at least 32 bits (or integers)."""
        narrow = self.dtype.kind == "f" and self.dtype.itemsize < 4
        fits = len(self.shape) == 1 or self.shape[1:2] <= (MAX_WIDTH,)
        return self.dtype.kind in "fiumM" and not narrow and self.is_flat and fits

    @property
    def is_flat(self) -> bool:
        """Whether it is a column or a table of columns."""
        return len(self.shape) in (1, 2)


def read_columns(
    entries: Mapping[str, LazyArray],
    source: str,
    wanted: Sequence[str] | None,
    *,
    time: str | None,
    meter: Meter,
) -> LogTable:
    """Read the wanted columns (None: all that are numbers) as float64.

    Nothing is read of the others. Raises `InputError` E103, E115, E121, E123, E124,
    E126, E140, E180.
    """
    places = {
        name: (base, k)
        for base, entry in entries.items()
        for k, name in enumerate(entry.names(base))
    }
    meter.tick()
    header = tuple(places)
    if wanted is None:
        wanted = [n for n, (base, _) in places.items() if entries[base].is_numeric]
    for name in wanted:
        if name not in places:
            raise missing_column(name, header, source, name == time)
        _check_kind(entries[places[name][0]], name, source)
    bases = list(dict.fromkeys(places[name][0] for name in wanted))
    rows = _row_count(
        entries, bases, places[time][0] if time in places else None, source
    )
    used = [entries[base] for base in bases]
    meter.place = ""
    meter.claim(sum(math.prod(e.shape) * max(e.dtype.itemsize, 8) for e in used))
    of: dict[str, list[str]] = {base: [] for base in bases}
    for name in wanted:
        of[places[name][0]].append(name)
    columns: dict[str, Float[np.ndarray, " N"]] = {}
    notes: list[Note] = []
    for base, names in of.items():
        meter.place = f"column {base[:60]}"
        read = entries[base].read()
        for name in names:
            raw = read if read.ndim == 1 else read[:, places[name][1]]
            columns[name], said = _as_float64(raw, name, source, name == time)
            notes += said
    meter.place = ""
    table_rows = Rows(source, np.arange(rows), "row")
    return LogTable(table_rows, header, columns, notes=tuple(notes))


def distinct(names: Sequence[str], source: str) -> None:
    """Each column is named once (E104)."""
    twice = next((n for n, count in Counter(names).items() if count > 1), None)
    if twice is not None:
        raise error(
            "repeated_column",
            where=source,
            got=f"{names.count(twice)} of this name",
            name=twice,
        )


def _check_kind(entry: LazyArray, name: str, source: str) -> None:
    """Real numbers with digits enough, in rows and columns (E121, E123, E124, E140)."""
    where, kind = f"{source}:column {name}", entry.dtype.kind
    if kind == "O":
        raise error("array_of_objects", where=where, got="dtype object")
    if kind in "SUT":
        raise error("text_in_array", where=where, got=f"dtype {entry.dtype}")
    if kind not in "fiumM":
        raise error("array_not_real", where=where, got=f"dtype {entry.dtype}")
    if kind == "f" and entry.dtype.itemsize < 4:
        raise error("too_few_digits", where=where, got=f"{entry.dtype} (three digits)")
    if not entry.is_flat:
        raise error("not_a_table", where=where, got=f"shape {entry.shape}")


def _row_count(
    entries: Mapping[str, LazyArray],
    bases: Sequence[str],
    time: str | None,
    source: str,
) -> int:
    """The number of rows of all arrays (E115, E140)."""
    shapes = {base: entries[base].shape for base in bases}
    rows = entries[time].shape[0] if time else max(s[0] for s in shapes.values())
    if rows == 0:
        raise error("no_rows", where=source, got="0 rows")
    for base, shape in shapes.items():
        wide = len(shape) == 2 and shape[0] < shape[1]
        if wide and (time is None or shape[1] == rows):
            raise error(
                "array_transposed",
                where=source,
                got=f"{shape[0]} rows of {shape[1]} columns",
                base=base,
                rows=shape[1],
                columns=shape[0],
            )
    other = next((base for base, shape in shapes.items() if shape[0] != rows), None)
    if other is None:
        return rows
    first = time or next(base for base, shape in shapes.items() if shape[0] == rows)
    off = " (one more observation than actions is Minari's alone)"
    raise error(
        "columns_of_different_lengths",
        where=source,
        got=f"{rows} rows of {first}, {shapes[other][0]} of {other}",
        hint=off if abs(rows - shapes[other][0]) == 1 else "",
    )


def _as_float64(
    raw: Shaped[np.ndarray, " N"], name: str, source: str, is_time: bool
) -> tuple[Float[np.ndarray, " N"], list[Note]]:
    """As float64; dates, and whole numbers too large for it, count from the first."""
    dated = raw.dtype.kind in "mM"
    if dated:
        undated = np.isnat(raw)
        raw = raw.astype(f"{raw.dtype.kind}8[ns]").astype(np.int64)
    large = is_time and raw.dtype.kind in "iu" and int(np.max(raw, initial=0)) > EXACT
    if not (dated or large):
        return raw.astype(np.float64), []
    if raw.dtype.kind == "u":
        raw = raw.astype(np.int64)
    values = (raw - raw[0]).astype(np.float64)
    if dated:
        values = np.where(undated, np.nan, values / 1e9)
    text = f"{name} in {source} counts from its first row"
    return values, [Note("W154", text + (", in s" if dated else ""))]


def split(table: LogTable, episode: str) -> list[tuple[int, LogTable]]:
    """Cut at the borders of episodes, by their ids in a column (E127)."""
    ids = table.columns[episode]
    bad = np.flatnonzero(~(np.isfinite(ids) & (ids == np.round(ids))))
    if bad.size:
        where, got = table.rows.at(int(bad[0])), f"{ids[bad[0]]:g}"
        raise error("episode_id_missing", where=where, got=got)
    edges = [0, *(np.flatnonzero(np.diff(ids)) + 1).tolist(), len(ids)]
    pieces: dict[int, LogTable] = {}
    for start, end in pairwise(edges):
        number = int(ids[start])
        if number in pieces:
            where, got = table.rows.at(start), f"{number} again"
            raise error("episodes_interleaved", where=where, got=got)
        piece = table.kept(slice(start, end))
        source = f"{table.rows.source} episode {number}"
        pieces[number] = replace(piece, rows=replace(piece.rows, source=source))
    return list(pieces.items())
