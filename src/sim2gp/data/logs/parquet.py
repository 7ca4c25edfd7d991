"""Parquet files: scalar columns, and list columns entry by entry, through pyarrow.

The footer says how many rows and bytes there are before a page is decoded. Columns that
nobody asks for are not touched.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.data.logs.arrays import LazyArray, distinct, read_columns
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.file import MAGIC, display_path, import_optional, unchanged_size
from sim2gp.data.logs.table import LogTable
from sim2gp.errors import error

Labels = Mapping[str, Sequence[str]]
BATCH = 2**20  # numbers that are decoded at once


def read_parquet(
    path: Path,
    wanted: Sequence[str] | None,
    time: str | None,
    meter: Meter,
    labels: Labels | None = None,
) -> LogTable:
    """The wanted columns of a file (E103 to E126, E140); ``labels`` names list entries.

    A footer that is not there is a recording that was cut off (E125).
    """
    where = display_path(path)
    import_optional("pyarrow", "parquet", "a Parquet file")
    parquet = import_optional("pyarrow.parquet", "parquet", "a Parquet file")
    with unchanged_size(path) as size:
        _check_end(path, size, where)
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            meter.claim(8 * file.metadata.num_rows, "rows")
            distinct(file.schema_arrow.names, where)
            entries, leaf = {}, 0
            for field in file.schema_arrow:
                leaves = range(leaf, leaf + _leaf_count(field.type))
                found = (labels or {}).get(field.name)
                entries[field.name] = _lazy_column(file, field, leaves, meter, found)
                leaf = leaves.stop
            if leaf != file.metadata.num_columns:
                raise ValueError(
                    f"{file.metadata.num_columns} columns, {leaf} in types"
                )
            return read_columns(entries, where, wanted, time=time, meter=meter)


def _check_end(path: Path, size: int, where: str) -> None:
    with path.open("rb") as file:
        file.seek(max(size - 4, 0))
        end = file.read()
    if end != MAGIC["parquet"] or size < 12:
        raise error("no_footer", where=where, got=f"{size} bytes without a footer")


def _leaf_count(kind: Any) -> int:
    """How many columns of the file hold a field: those of a record count each."""
    types = import_optional("pyarrow.types", "parquet", "a Parquet file")
    kind = getattr(kind, "storage_type", kind)
    if not types.is_nested(kind):
        return 1
    return sum(_leaf_count(kind.field(i).type) for i in range(kind.num_fields))


def _lazy_column(
    file: Any, field: Any, leaves: range, meter: Meter, labels: Sequence[str] | None
) -> LazyArray:
    """A column's shape and dtype; the width of a list is what the footer counts."""
    types = import_optional("pyarrow.types", "parquet", "a Parquet file")
    meter.tick()
    rows, kind = file.metadata.num_rows, field.type
    lists = (types.is_list, types.is_large_list, types.is_fixed_size_list)
    is_list = any(test(kind) for test in lists)
    width = _width(file.metadata, leaves.start) if is_list else 1

    def values() -> Shaped[np.ndarray, "..."]:
        return _read_column(file, field.name, leaves, width, meter)

    if not is_list:
        return LazyArray((rows,), _dtype(kind), values)
    names = tuple(labels or ())
    if len(names) != width:
        names = ()
    return LazyArray((rows, width), _dtype(kind.value_type), values, names)


def _width(metadata: Any, leaf: int) -> int:
    """Entries in the longest row, if they are all alike: ragged ones are seen later."""
    for g in range(metadata.num_row_groups):
        group = metadata.row_group(g)
        if group.num_rows > 0:
            return int(-(-group.column(leaf).num_values // group.num_rows))
    return 0


def _dtype(kind: Any) -> np.dtype:
    """The dtype that an Arrow type has in numpy; records and lists count as such."""
    types = import_optional("pyarrow.types", "parquet", "a Parquet file")
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


def _read_column(
    file: Any, name: str, leaves: range, width: int, meter: Meter
) -> Shaped[np.ndarray, "..."]:
    """All values of a column, and of no other that its name is a part of."""
    parts = []
    for group in range(file.metadata.num_row_groups):
        meter.place = f"column {name[:60]}, row group {group}"
        columns = [file.metadata.row_group(group).column(leaf) for leaf in leaves]
        meter.claim(sum(column.total_uncompressed_size for column in columns))
        batches = file.reader.iter_batches(
            max(1, BATCH // max(1, width)),
            row_groups=[group],
            column_indices=list(leaves),
            use_threads=False,
        )
        for batch in batches:
            meter.spend(batch.nbytes)
            if len(batch):
                parts.append(_array(batch.column(0), name, meter.where))
    return np.concatenate(parts)


def _array(chunk: Any, name: str, where: str) -> Shaped[np.ndarray, "..."]:
    """One chunk as numpy; nulls are NaN, lists are rows of one width (E140)."""
    types = import_optional("pyarrow.types", "parquet", "a Parquet file")
    if not (types.is_nested(chunk.type)):
        return _chunk_values(chunk)
    if chunk.null_count == 0:
        inner = chunk.flatten()
        width = len(inner) // len(chunk)
        widths = chunk.value_lengths() if hasattr(chunk, "value_lengths") else None
        if widths is None or set(widths.unique().to_pylist()) == {width}:
            return _chunk_values(inner).reshape(len(chunk), width)
    raise error(
        "lists_of_different_lengths",
        where=f"{where}:column {name}",
        got=f"{chunk.null_count} empty rows" if chunk.null_count else "ragged rows",
    )


def _chunk_values(chunk: Any) -> Shaped[np.ndarray, " N"]:
    types = import_optional("pyarrow.types", "parquet", "a Parquet file")
    if types.is_dictionary(chunk.type):
        chunk = chunk.dictionary_decode()
    if types.is_decimal(chunk.type):
        chunk = chunk.cast("float64")
    values: np.ndarray = chunk.to_numpy(zero_copy_only=False)
    return values
