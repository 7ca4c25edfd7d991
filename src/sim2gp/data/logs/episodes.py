"""Folders of robot learning: LeRobot (v2.x, v3) and Minari, one log per episode.

LeRobot: ``meta/info.json`` and Parquet files, read with pyarrow alone; rows are split
by ``episode_index``, in any of the files. Minari: ``data/main_data.hdf5``, read with
h5py alone; an episode of T actions has T + 1 observations.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Shaped

from sim2gp.data.logs.arrays import LazyArray, read_columns, split
from sim2gp.data.logs.budget import Meter
from sim2gp.data.logs.file import (
    display_path,
    import_optional,
    read_bytes,
    unchanged_size,
)
from sim2gp.data.logs.hdf5 import entries_of
from sim2gp.data.logs.log import Note
from sim2gp.data.logs.parquet import read_parquet
from sim2gp.data.logs.table import LogTable, Rows
from sim2gp.errors import error

MAX_JSON = 16 * 1024**2
TOLERANCE = 1e-4  # s: how far LeRobot lets stamps be from frame_index / fps
_EPISODE = re.compile(r"episode_(\d+)/")


def read_lerobot(
    path: Path,
    wanted: Sequence[str] | None,
    time: str | None,
    stamped: bool,
    meter: Meter,
) -> list[tuple[str, LogTable]]:
    """The episodes of a LeRobot folder, by number (E103 to E136).

    ``stamped``: the time is the file's own, which is ``frame_index / fps`` where the
    stamps agree with it (they are float32).
    """
    info = _json(path / "meta" / "info.json", meter)
    where = display_path(path)
    version = str(info.get("codebase_version", ""))
    if info.get("storage_format", "parquet") != "parquet" or version[:2] not in (
        "v2",
        "v3",
    ):
        raise error(
            "not_lerobot_format",
            where=f"{where}/meta/info.json",
            got=f"{version or 'no version'}, {info.get('storage_format', 'parquet')}",
        )
    files = sorted((path / "data").glob("chunk-*/*.parquet"))
    if not files:
        raise error(
            "lerobot_without_data", where=where, got="no file data/chunk-*/*.parquet"
        )
    own = ["episode_index", "frame_index", "timestamp"] if stamped else []
    asked = None if wanted is None else [*dict.fromkeys([*wanted, *own])]
    if asked is not None and not stamped:
        asked += ["episode_index"]
    labels = _feature_labels(info)
    tables = [read_parquet(file, asked, time, meter, labels) for file in files]
    pieces = split(_join_tables(tables, where), "episode_index")
    notes = _announced(info.get("total_episodes"), [n for n, _ in pieces], where)
    pieces = [
        (n, _timed(t, info, stamped)) for n, t in sorted(pieces, key=_episode_number)
    ]
    number, first = pieces[0]
    pieces[0] = (number, replace(first, notes=(*first.notes, *notes)))
    return [(str(n), table) for n, table in pieces]


def _episode_number(piece: tuple[int, Any]) -> int:
    return piece[0]


def _json(path: Path, meter: Meter) -> dict[str, Any]:
    content = read_bytes(path, MAX_JSON)
    meter.place = path.name
    values = json.loads(content.decode("utf-8"))
    if not isinstance(values, dict):
        raise TypeError("no table of JSON")
    meter.place = ""
    return values


def _feature_labels(info: Mapping[str, Any]) -> dict[str, list[str]]:
    """The names of the entries of each feature, where the dataset gives them."""
    labels: dict[str, list[str]] = {}
    features = info.get("features")
    for name, feature in features.items() if isinstance(features, dict) else ():
        found = feature.get("names") if isinstance(feature, dict) else None
        if isinstance(found, dict):  # {"motors": [...]}, or {"shoulder": 0, ...}
            lists = [v for v in found.values() if isinstance(v, list)]
            found = lists[0] if len(lists) == 1 else list(found)
        if isinstance(found, list) and all(isinstance(n, str) for n in found):
            labels[name] = found if len(set(found)) == len(found) else []
    return labels


def _join_tables(tables: Sequence[LogTable], where: str) -> LogTable:
    """The rows of all files after each other, numbered as LeRobot's index does."""
    columns = {
        name: np.concatenate([table.columns[name] for table in tables])
        for name in tables[0].columns
    }
    rows = Rows(where, np.arange(len(columns["episode_index"])), "row")
    notes = tuple(note for table in tables for note in table.notes)
    return LogTable(rows, tables[0].header, columns, notes=notes)


def _timed(table: LogTable, info: Mapping[str, Any], stamped: bool) -> LogTable:
    """The episode with its clock: frames over their rate where the stamps agree."""
    if not stamped:
        return table
    columns = dict(table.columns)
    stamps, frames = columns["timestamp"], columns["frame_index"]
    fps = info.get("fps")
    if isinstance(fps, int | float) and fps > 0:
        even = frames / float(fps)
        if np.max(np.abs(even - stamps), initial=0.0) < TOLERANCE:
            return replace(table, clock=even)
    text = f"the stamps of {table.rows.source} are not frame_index / fps: they are used"
    return replace(table, clock=stamps, notes=(*table.notes, Note("W154", text)))


def _announced(total: Any, found: Sequence[int], where: str) -> list[Note]:
    if not isinstance(total, int) or total == len(found):
        return []
    text = f"{where} announces {total} episodes and holds {len(found)}"
    return [Note("W127", text)]


def read_minari(
    path: Path, wanted: Sequence[str] | None, time: str | None, meter: Meter
) -> list[tuple[str, LogTable]]:
    """The episodes of a Minari folder; the last action is held (E103 to E140).

    Columns are ``observations[0]`` or, of a space of names, ``observations/arm[0]``.
    """
    folder = path / "data" if (path / "data" / "metadata.json").is_file() else path
    where = display_path(path)
    info = _json(folder / "metadata.json", meter)
    kind = info.get("data_format", "hdf5")
    if kind != "hdf5" or not (folder / "main_data.hdf5").is_file():
        raise error(
            "not_minari_format",
            where=f"{display_path(folder)}/metadata.json",
            got=f"data_format {kind!r}",
        )
    h5py = import_optional("h5py", "hdf5", "a Minari dataset")
    main = folder / "main_data.hdf5"
    with unchanged_size(main), h5py.File(main, "r") as file:
        episodes: dict[int, dict[str, LazyArray]] = {}
        for name, entry in entries_of(file, where, meter).items():
            if found := _EPISODE.match(name):
                inner = episodes.setdefault(int(found[1]), {})
                inner[name[found.end() :]] = entry
        pieces = []
        for number, inner in sorted(episodes.items(), key=_episode_number):
            source = f"{where} episode {number}"
            aligned = _aligned(inner, source)
            table = read_columns(aligned, source, wanted, time=time, meter=meter)
            pieces.append((str(number), table))
    notes = _announced(info.get("total_episodes"), [*episodes], where)
    if not pieces:
        raise error("no_episodes", where=where, got="no group episode_0")
    name, first = pieces[0]
    pieces[0] = (name, replace(first, notes=(*first.notes, *notes)))
    return pieces


def _aligned(entries: Mapping[str, LazyArray], source: str) -> dict[str, LazyArray]:
    """Observations and actions in rows of one length: the last action is held (E140).

    Rewards and flags belong to the steps between the rows and are left out.
    """
    seen = {e.shape[0] for n, e in entries.items() if _is(n, "observations")}
    acted = {e.shape[0] for n, e in entries.items() if _is(n, "actions")}
    rows, steps = max(seen, default=0), max(acted, default=0)
    if len(seen) != 1 or len(acted) != 1 or rows != steps + 1:
        raise error(
            "episode_of_unequal_lengths",
            where=source,
            got=f"{rows} observations, {steps} actions",
        )
    kept = {n: e for n, e in entries.items() if _is(n, "observations", "infos")}
    held = {n: _repeat_last(e) for n, e in entries.items() if _is(n, "actions")}
    return kept | held


def _is(name: str, *groups: str) -> bool:
    return name.split("/", 1)[0] in groups


def _repeat_last(entry: LazyArray) -> LazyArray:
    def values() -> Shaped[np.ndarray, "..."]:
        read = entry.read()
        return np.concatenate([read, read[-1:]])

    return replace(entry, shape=(entry.shape[0] + 1, *entry.shape[1:]), read=values)
