"""One door to the recordings of every format: by suffix, checked by the first bytes.

A recording is one episode: a table for each clock in it. CSV, npz, Parquet and HDF5
leave the time to a column or a stated period; LeRobot and bags bring their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sim2gp.data.logs.arrays import LazyArray, read_columns, split
from sim2gp.data.logs.budget import Budget, Meter, readable
from sim2gp.data.logs.episodes import read_lerobot, read_minari
from sim2gp.data.logs.file import display_path, kind_of
from sim2gp.data.logs.hdf5 import read_hdf5
from sim2gp.data.logs.log import RawLog
from sim2gp.data.logs.npz import read_npz
from sim2gp.data.logs.parquet import read_parquet
from sim2gp.data.logs.ros import read_bag
from sim2gp.data.logs.table import LogTable, read_table
from sim2gp.errors import error

BAGS = ("rosbag1", "rosbag2", "mcap")
CLOCKS = ("header", "log")  # what ``time`` may be in a bag
#: What LeRobot numbers its rows by.
BOOKKEEPING = ("timestamp", "frame_index", "episode_index", "index", "task_index")
#: Formats of one table, by their kind (`sim2gp.data.logs.file.SUFFIXES`).
ONE_TABLE = {"csv": read_table, "npz": read_npz, "parquet": read_parquet}
TIME = "time"  # the column of time, where nothing else is said


@dataclass(frozen=True)
class Recording:
    """One episode: a table for each of its clocks; ``episode`` is its name or empty."""

    episode: str
    tables: tuple[LogTable, ...]


def read_recordings(
    path: Path | RawLog,
    wanted: Sequence[str] | None,
    *,
    time: str | None = None,
    period: float | None = None,
    episode: str | None = None,
    budget: Budget | None = None,
) -> tuple[Recording, ...]:
    """The wanted columns of a file or folder, episode by episode (None: all numbers).

    ``time`` names the column of time, or in a bag the stamps ("header", "log");
    ``episode`` a column of episode numbers; ``budget`` is what reading may take, 2 GiB
    and 60 s if None. Raises `InputError` E101 to E140, E180, E182.
    """
    if isinstance(path, RawLog):
        kind, name = "memory", path.name
    else:
        kind, name = kind_of(path), display_path(path)
    meter = Meter(name, budget or Budget())
    with readable(meter):
        return _recordings(path, kind, wanted, time, period, episode, meter)


def _recordings(
    path: Path | RawLog,
    kind: str,
    wanted: Sequence[str] | None,
    time: str | None,
    period: float | None,
    episode: str | None,
    meter: Meter,
) -> tuple[Recording, ...]:
    clock = None if period is not None else (time or TIME)
    if isinstance(path, RawLog):
        asked = _wanted_with(wanted, clock, episode)
        pieces = [("", _in_memory(path, asked, clock, meter))]
        return _by_episode(pieces, episode)
    if kind in BAGS:
        _check_bag(path, time, period, episode)
        return (Recording("", tuple(read_bag(path, kind, wanted, time, meter))),)
    if kind == "lerobot":
        _check_no_episode(path, episode, kind)
        stamped = time is None and period is None
        asked = _wanted_with(wanted, time)
        found = read_lerobot(path, asked, time, stamped, meter)
        return tuple(Recording(name, (table,)) for name, table in found)
    asked = _wanted_with(wanted, clock, episode)
    if kind == "minari":
        _check_no_episode(path, episode, kind)
        pieces = read_minari(path, asked, clock, meter)
    elif kind == "hdf5":
        pieces = read_hdf5(path, asked, clock, meter)
    else:
        pieces = [("", ONE_TABLE[kind](path, asked, clock, meter))]
    return _by_episode(pieces, episode)


def _in_memory(
    log: RawLog, wanted: Sequence[str] | None, time: str | None, meter: Meter
) -> LogTable:
    """Columns that are arrays already, checked as those of a file."""

    def entry(values: np.ndarray) -> LazyArray:
        return LazyArray(values.shape, values.dtype, lambda: values)

    entries = {name: entry(values) for name, values in log.columns.items()}
    return read_columns(entries, log.name, wanted, time=time, meter=meter)


def _by_episode(
    pieces: list[tuple[str, LogTable]], episode: str | None
) -> tuple[Recording, ...]:
    """Each piece cut at the borders of its episodes, where a column numbers them."""
    if episode is not None:
        pieces = [
            (f"{name} {number}".strip(), part)
            for name, table in pieces
            for number, part in split(table, episode)
        ]
    return tuple(Recording(name, (table,)) for name, table in pieces)


def columns_of(
    path: Path | str, budget: Budget | None = None
) -> dict[str, Float[np.ndarray, " _"]]:
    """Every numeric column of a file or folder by name, of its first episode.

    Columns of streams with clocks of their own have lengths of their own. Raises
    `InputError`, E126 for a file beyond the ``budget``, 2 GiB and 60 s if None.
    """
    tables = read_recordings(Path(path), None, budget=budget)[0].tables
    return {name: v for table in tables for name, v in table.columns.items()}


def _wanted_with(wanted: Sequence[str] | None, *names: str | None) -> list[str] | None:
    if wanted is None:
        return None
    return list(dict.fromkeys([*(n for n in names if n is not None), *wanted]))


def _check_bag(
    path: Path, time: str | None, period: float | None, episode: str | None
) -> None:
    if period is not None:
        raise error(
            "period_with_stamps",
            where=display_path(path),
            got=f"period = {period:g}",
            period=f"{period:g}",
        )
    if time is not None and time not in CLOCKS:
        raise error("no_such_clock", where=display_path(path), got=f"time = {time!r}")
    _check_no_episode(path, episode, "bag")


def _check_no_episode(path: Path, episode: str | None, kind: str) -> None:
    if episode is not None:
        raise error(
            "column_of_episodes_unneeded",
            where=display_path(path),
            got=f"episode = {episode!r}",
            format=kind,
        )
