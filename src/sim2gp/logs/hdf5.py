"""HDF5 files: datasets by their path, groups of alike datasets as episodes (h5py).

Only what lies in the file itself is read: links to other files, and data that a file
says to lie elsewhere, are refused.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.errors import InputError
from sim2gp.logs.arrays import Entry, table_of
from sim2gp.logs.file import check_declared, library, readable, shown, steady
from sim2gp.logs.table import Table

#: Groups whose names are one of these words and a number hold an episode each.
_EPISODE = re.compile(
    r"(episode|ep|demo|traj|trajectory|trial|rollout|run|seq|sequence|log)[_-]?(\d+)$"
)


def read_hdf5(
    path: Path, wanted: Sequence[str] | None, time: str | None
) -> list[tuple[str, Table]]:
    """The wanted datasets, one table for each episode, with the episode's name.

    Columns are named by their path in the file, or in each episode's group. Raises
    `InputError` E103 to E126, E131, E140.
    """
    where = shown(path)
    h5py = library("h5py", "hdf5", "an HDF5 file")
    with steady(path) as size, readable(where), h5py.File(path, "r") as file:
        entries = entries_of(file, where, size)
        bases = {re.sub(r"\[\d+\]$", "", name) for name in wanted or ()}
        groups = {} if bases & {*entries} else episodes_of(entries, bases)
        if not groups:
            return [("", table_of(entries, where, wanted, time=time, size=size))]
        return [
            (
                name.rsplit("/", 1)[-1],
                table_of(inner, f"{where} {name}", wanted, time=time, size=size),
            )
            for name, inner in groups.items()
        ]


def entries_of(file: Any, where: str, size: int) -> dict[str, Entry]:
    """Every dataset with rows, by its path; hard links alone are followed."""
    h5py = library("h5py", "hdf5", "an HDF5 file")
    found: dict[str, Entry] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.shape:
            found[name] = _entry(item, f"{where}:dataset {name}", size)

    file.visititems(visit)
    return found


def _entry(dataset: Any, where: str, size: int) -> Entry:
    def values() -> Shaped[np.ndarray, "..."]:
        if dataset.external or dataset.is_virtual:
            raise InputError(
                "E131",
                "data in another file",
                where=where,
                got="an external or virtual dataset",
                expected="data inside the file",
                fix="copy the data into the file (h5repack)",
            )
        declared = math.prod(dataset.shape) * dataset.dtype.itemsize
        check_declared(declared, size, where)
        read: np.ndarray = dataset[()]
        return read

    dtype = dataset.dtype
    if dtype.hasobject:  # texts, or rows of different lengths
        is_text = library("h5py", "hdf5", where).check_string_dtype(dtype)
        dtype = np.dtype(str) if is_text else np.dtype([("field", "f8")])
    return Entry(dataset.shape, dtype, values)


def episodes_of(
    entries: Mapping[str, Entry], bases: set[str]
) -> dict[str, dict[str, Entry]]:
    """Groups that hold the wanted datasets, by name, in the order of their numbers.

    Without wanted names, groups that are called episodes. One that lacks a dataset of
    the others is named when it is read.
    """
    groups: dict[str, dict[str, Entry]] = {}
    for name in entries:
        parts = name.split("/")
        for depth in range(1, len(parts)):
            group, inner = "/".join(parts[:depth]), "/".join(parts[depth:])
            called = _EPISODE.match(parts[depth - 1].lower())
            if inner in bases if bases else called:
                groups.setdefault(group, {})
    for group, inside in groups.items():
        prefix = f"{group}/"
        inside |= {
            name.removeprefix(prefix): entry
            for name, entry in entries.items()
            if name.startswith(prefix)
        }
    top = min((name.count("/") for name in groups), default=0)
    names = sorted((n for n in groups if n.count("/") == top), key=_natural)
    return {name: groups[name] for name in names}


def _natural(name: str) -> list[tuple[int, str]]:
    """Names sort by their numbers: demo_2 before demo_10."""
    parts = re.findall(r"\d+|\D+", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
