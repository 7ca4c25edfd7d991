"""Parquet files: scalar columns, and list columns entry by entry, through pyarrow.

The footer says how many rows and bytes there are before a page is decoded.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.errors import InputError
from sim2gp.logs.arrays import Entry, distinct, table_of
from sim2gp.logs.file import MAGIC, check_declared, library, readable, shown, steady
from sim2gp.logs.table import Table

Labels = Mapping[str, Sequence[str]]


def read_parquet(
    path: Path,
    wanted: Sequence[str] | None,
    time: str | None,
    labels: Labels | None = None,
) -> Table:
    """The wanted columns of a file (E103 to E126, E140); ``labels`` names list entries.

    A footer that is not there is a recording that was cut off (E125).
    """
    where = shown(path)
    pa = library("pyarrow", "parquet", "a Parquet file")
    parquet = library("pyarrow.parquet", "parquet", "a Parquet file")
    with steady(path) as size, readable(where, pa.ArrowException):
        _check_end(path, size, where)
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            rows = file.metadata.num_rows
            check_declared(8 * rows, size, where, "rows")
            distinct(file.schema_arrow.names, where)
            entries = {
                field.name: _entry(file, field, where, (labels or {}).get(field.name))
                for field in file.schema_arrow
            }
            return table_of(entries, where, wanted, time=time, size=size)


def _check_end(path: Path, size: int, where: str) -> None:
    with path.open("rb") as file:
        file.seek(max(size - 4, 0))
        end = file.read()
    if end != MAGIC["parquet"] or size < 12:
        raise InputError(
            "E125",
            "file incomplete",
            where=where,
            got=f"{size} bytes without a footer",
            expected="a footer at the end",
            fix="close the writer before copying, or record it again",
        )


def _entry(file: Any, field: Any, where: str, labels: Sequence[str] | None) -> Entry:
    """A column's shape and dtype: of a list, the width of its first row."""
    types = library("pyarrow.types", "parquet", "a Parquet file")
    rows, kind = file.metadata.num_rows, field.type
    lists = (types.is_list, types.is_large_list, types.is_fixed_size_list)
    name = field.name

    def values() -> Shaped[np.ndarray, "..."]:
        return _column(file, name, where)

    if not any(test(kind) for test in lists):
        return Entry((rows,), _dtype(kind), values)
    first = next(file.iter_batches(1, columns=[name]), None)
    lead = first.column(name)[0].as_py() if first is not None and len(first) else None
    shape = (rows, len(lead or ()))
    names = tuple(labels or ())
    if len(names) != shape[1]:
        names = ()
    return Entry(shape, _dtype(kind.value_type), values, names)


def _dtype(kind: Any) -> np.dtype:
    """The dtype that an Arrow type has in numpy; records and lists count as such."""
    types = library("pyarrow.types", "parquet", "a Parquet file")
    if types.is_nested(kind):
        return np.dtype([("field", "f8")])
    if types.is_dictionary(kind):
        return _dtype(kind.value_type)
    if types.is_decimal(kind):
        return np.dtype(np.float64)
    if types.is_timestamp(kind):
        return np.dtype("M8[ns]")
    if types.is_date(kind) or types.is_time(kind):
        return np.dtype(str)
    if types.is_string(kind) or types.is_binary(kind) or types.is_large_string(kind):
        return np.dtype(str)
    return np.dtype(kind.to_pandas_dtype())


def _column(file: Any, name: str, where: str) -> Shaped[np.ndarray, "..."]:
    """All values of a column; a page that cannot be decoded is named (E125)."""
    pa = library("pyarrow", "parquet", "a Parquet file")
    parts = []
    for group in range(file.metadata.num_row_groups):
        try:
            table = file.read_row_group(group, columns=[name])
        except (pa.ArrowException, OSError) as error:
            text = " ".join(str(error).split())
            raise InputError(
                "E125",
                "damaged page",
                where=f"{where}:column {name}, row group {group}",
                got=text[:120].rstrip("."),
                expected="pages as they were written",
                fix="copy the file again, or record it again",
            ) from error
        parts.append(table.column(name))  # dotted names may bring others
    chunks = [chunk for part in parts for chunk in part.chunks if len(chunk)]
    return np.concatenate([_array(chunk, name, where) for chunk in chunks])


def _array(chunk: Any, name: str, where: str) -> Shaped[np.ndarray, "..."]:
    """One chunk as numpy; nulls are NaN, lists are rows of one width (E140)."""
    types = library("pyarrow.types", "parquet", "a Parquet file")
    if not (types.is_nested(chunk.type)):
        return _plain(chunk)
    if chunk.null_count == 0:
        inner = chunk.flatten()
        width = len(inner) // len(chunk)
        widths = chunk.value_lengths() if hasattr(chunk, "value_lengths") else None
        if widths is None or set(widths.unique().to_pylist()) == {width}:
            return _plain(inner).reshape(len(chunk), width)
    raise InputError(
        "E140",
        "lists of different lengths",
        where=f"{where}:column {name}",
        got=f"{chunk.null_count} empty rows" if chunk.null_count else "ragged rows",
        expected="the same number of entries in every row",
        fix="write fixed-size lists",
    )


def _plain(chunk: Any) -> Shaped[np.ndarray, " N"]:
    types = library("pyarrow.types", "parquet", "a Parquet file")
    if types.is_dictionary(chunk.type):
        chunk = chunk.dictionary_decode()
    if types.is_decimal(chunk.type):
        chunk = chunk.cast("float64")
    values: np.ndarray = chunk.to_numpy(zero_copy_only=False)
    return values
