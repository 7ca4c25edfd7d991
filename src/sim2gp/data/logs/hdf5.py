"""HDF5 files: datasets by their path, groups of alike datasets as episodes (h5py).

Only what lies in the file itself is read: links to other files, and data that a file
says to lie elsewhere, are refused. The library unpacks a chunk as a whole, as far as
its bytes go, and not only to its declared size: each chunk is measured before.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.data.logs.arrays import LazyArray, read_columns
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.file import display_path, import_optional, unchanged_size
from sim2gp.data.logs.table import LogTable
from sim2gp.data.logs.unpack import inflate, lzf_pieces
from sim2gp.errors import error

#: Groups whose names are one of these words and a number hold an episode each.
_EPISODE = re.compile(
    r"(episode|ep|demo|traj|trajectory|trial|rollout|run|seq|sequence|log)[_-]?(\d+)$"
)


#: Filters of HDF5 that its own library has, and that lose nothing, by their numbers.
_GZIP, _LZF = 1, 32000
_CHECKSUM = 3
_FILTERS = {_GZIP: "gzip", 2: "shuffle", _CHECKSUM: "fletcher32", _LZF: "lzf"}
_LZF_RATIO = 88  # three bytes copy at most 264
STEP = 2**22  # bytes that are read at once


def read_hdf5(
    path: Path, wanted: Sequence[str] | None, time: str | None, meter: Meter
) -> list[tuple[str, LogTable]]:
    """The wanted datasets, one table for each episode, with the episode's name.

    Columns are named by their path in the file, or in each episode's group. Raises
    `InputError` E103 to E126, E131, E140.
    """
    where = display_path(path)
    h5py = import_optional("h5py", "hdf5", "an HDF5 file")
    with unchanged_size(path), h5py.File(path, "r") as file:
        entries = entries_of(file, where, meter)
        bases = {re.sub(r"\[\d+\]$", "", name) for name in wanted or ()}
        groups = {} if bases & {*entries} else episodes_of(entries, bases)
        if not groups:
            return [("", read_columns(entries, where, wanted, time=time, meter=meter))]
        return [
            (
                name.rsplit("/", 1)[-1],
                read_columns(inner, f"{where} {name}", wanted, time=time, meter=meter),
            )
            for name, inner in groups.items()
        ]


def entries_of(file: Any, where: str, meter: Meter) -> dict[str, LazyArray]:
    """Every dataset with rows, by its path; hard links alone are followed."""
    h5py = import_optional("h5py", "hdf5", "an HDF5 file")
    found: dict[str, LazyArray] = {}

    def visit(name: str | bytes, item: Any) -> None:
        meter.tick()
        if isinstance(name, bytes):  # what h5py makes of a name that is not UTF-8
            raise ValueError(f"dataset {name[:40]!r}")
        if isinstance(item, h5py.Dataset) and item.shape:
            found[name] = _lazy_dataset(item, f"{where}:dataset {name}", meter)

    file.visititems(visit)
    return found


def _lazy_dataset(dataset: Any, where: str, meter: Meter) -> LazyArray:
    def values() -> Shaped[np.ndarray, "..."]:
        if dataset.external or dataset.is_virtual:
            raise error(
                "data_in_another_file",
                where=where,
                got="an external or virtual dataset",
            )
        size = math.prod(dataset.shape) * dataset.dtype.itemsize
        meter.claim(size)
        _check_chunks(dataset, where, meter)
        read = np.empty(dataset.shape, dataset.dtype)
        rows = len(dataset)
        step = max(1, STEP * rows // max(size, 1))
        if dataset.chunks:  # whole chunks: each is unpacked once
            step = max(step - step % dataset.chunks[0], dataset.chunks[0])
        for row in range(0, rows, step):
            part = dataset[row : row + step]
            meter.spend(part.nbytes)
            read[row : row + step] = part
        return read

    dtype = dataset.dtype
    if dtype.hasobject:  # texts, or rows of different lengths
        is_text = import_optional("h5py", "hdf5", where).check_string_dtype(dtype)
        dtype = np.dtype(str) if is_text else np.dtype([("field", "f8")])
    return LazyArray(dataset.shape, dtype, values)


def _check_chunks(dataset: Any, where: str, meter: Meter) -> None:
    """Compressed chunks unpack to what their shape says, no more (E126, E136)."""
    if not dataset.chunks:
        return
    declared = math.prod(dataset.chunks) * dataset.dtype.itemsize
    meter.piece(declared, "chunk")
    plist = dataset.id.get_create_plist()
    used = [plist.get_filter(i)[0] for i in range(plist.get_nfilters())]
    other = next((number for number in used if number not in _FILTERS), None)
    if other is not None:
        raise error(
            "unread_hdf5_filter",
            where=where,
            got=f"HDF5 filter {other}",
            filters=", ".join(_FILTERS.values()),
        )
    packed = [number for number in used if number in (_GZIP, _LZF)]
    if len(packed) > 1:
        raise ValueError("chunks that are compressed twice")
    chunks: list[Any] = []
    if packed:
        dataset.id.chunk_iter(chunks.append)
    for chunk in chunks:
        meter.piece(chunk.size, "chunk")
        if chunk.filter_mask & (1 << used.index(packed[0])):
            continue  # this chunk was stored as it is
        if packed == [_LZF] and _LZF_RATIO * chunk.size <= meter.limit:
            continue
        _, content = dataset.id.read_direct_chunk(chunk.chunk_offset)
        if used[-1] == _CHECKSUM:
            content = content[:-4]
        unpacked = inflate(content) if packed == [_GZIP] else lzf_pieces(content)
        # A checksum may lie inside. What is read is counted when it is read.
        meter.again().measure(unpacked, declared + 64, "chunk")


def episodes_of(
    entries: Mapping[str, LazyArray], bases: set[str]
) -> dict[str, dict[str, LazyArray]]:
    """Groups that hold the wanted datasets, by name, in the order of their numbers.

    Without wanted names, groups that are called episodes. One that lacks a dataset of
    the others is named when it is read.
    """
    groups: dict[str, None] = {}
    for name in entries:
        parts = name.split("/")
        for depth in range(1, len(parts)):
            group, inner = "/".join(parts[:depth]), "/".join(parts[depth:])
            called = _EPISODE.match(parts[depth - 1].lower())
            if inner in bases if bases else called:
                groups[group] = None
    top = min((name.count("/") for name in groups), default=0)
    names = sorted((n for n in groups if n.count("/") == top), key=_natural)
    found: dict[str, dict[str, LazyArray]] = {name: {} for name in names}
    for name, entry in entries.items():
        parts = name.split("/")
        group, inner = "/".join(parts[: top + 1]), "/".join(parts[top + 1 :])
        if inner and group in found:
            found[group][inner] = entry
    return found


def _natural(name: str) -> list[tuple[int, str]]:
    """Names sort by their numbers: demo_2 before demo_10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
