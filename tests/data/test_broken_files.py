"""Recordings cut off or with bytes changed: columns, or one line that says so."""

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recordings as rec
from sim2gp.data.logs import columns_of
from sim2gp.data.logs.arrays import LazyArray, distinct
from sim2gp.data.logs.file import MAGIC, SUFFIXES
from sim2gp.data.logs.hdf5 import episodes_of
from sim2gp.errors import InputError
from sim2gp.project.project import read_spec
from sim2gp.project.source import read_source

TABLE = rec.motion(rows=120)
WRITTEN: dict[str, Callable[[Path], Any]] = {
    "a.csv": lambda path: rec.write_csv(path, TABLE),
    "a.npz": lambda path: rec.write_npz(path, TABLE),
    "a.parquet": lambda path: rec.write_parquet(path, TABLE),
    "a.h5": lambda path: rec.write_hdf5(path, [TABLE, TABLE]),
    "a.bag": lambda path: rec.write_bag(path, TABLE, "ros1"),
    "a.mcap": lambda path: rec.write_mcap(path, TABLE),
    "ros.mcap": lambda path: rec.write_bag(path.with_suffix(""), TABLE, "mcap"),
    "ros.db3": lambda path: rec.write_bag(path.with_suffix(""), TABLE, "sqlite3"),
}


@pytest.mark.parametrize("rounds", [12, pytest.param(400, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", WRITTEN)
def test_no_bytes_break_a_reader(name: str, rounds: int, tmp_path: Path) -> None:
    """Cut off and with bytes changed: columns or one line, never anything else."""
    path = tmp_path / name
    WRITTEN[name](path)
    if not path.exists():
        (inside,) = path.with_suffix("").glob(f"*{path.suffix}")
        path = inside
    whole = path.read_bytes()
    rng = np.random.default_rng(len(name))
    spoilt = [whole[: int(share * len(whole))] for share in (0.02, 0.3, 0.9, 0.999)]
    for _ in range(rounds):
        changed = bytearray(whole)
        for place in rng.integers(16, len(whole), 4):
            changed[place] ^= int(rng.integers(1, 256))
        spoilt.append(bytes(changed))
        # Garbage behind the first bytes, and in the middle.
        magic = MAGIC.get(SUFFIXES.get(path.suffix, ""), b"")
        noise = rng.integers(0, 256, int(rng.integers(1, 2000))).astype(np.uint8)
        spoilt.append(magic + noise.tobytes())
        place = int(rng.integers(len(magic), len(whole)))
        spoilt.append(whole[:place] + noise.tobytes() + whole[place:])
    lines = []
    for content in spoilt:
        path.write_bytes(content)
        try:
            columns_of(path)
        except InputError as error:
            lines.append(str(error))
    assert len(lines) >= 3
    assert not any("\n" in line for line in lines)


def project(text: str, read: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def run(folder: Path) -> None:
        (folder / "p.toml").write_text(text)
        read(folder / "p.toml")

    return run


def wide(columns: int) -> Callable[[Path], Any]:
    """A table of so many columns, of which one is read."""
    names = ",".join(f"c{i}" for i in range(columns))
    rows = "\n".join(",".join(["1"] * columns) for _ in range(2))

    def run(folder: Path) -> None:
        (folder / "a.csv").write_text(f"{names}\n{rows}\n")
        columns_of(folder / "a.csv")

    return run


def grouped(episodes: int) -> Callable[[Path], Any]:
    entry = LazyArray((1,), np.dtype(float), lambda: np.zeros(1))
    entries = {f"demo_{i}/q": entry for i in range(episodes)}
    return lambda folder: episodes_of(entries, {"q"})


#: Work whose time must grow as its size does: a size, and what is done at it.
WORK: dict[str, tuple[int, Callable[[int], Callable[[Path], Any]]]] = {
    "one word": (3000, lambda n: project("a" * n, read_source)),
    "open strings": (3000, lambda n: project('"""' + '\\"""' * n, read_source)),
    "unknown keys": (
        700,
        lambda n: project("".join(f"k{i} = 1\n" for i in range(n)), read_spec),
    ),
    "wide CSV": (8000, wide),
    "names": (8000, lambda n: lambda _: distinct([f"c{i}" for i in range(n)], "a")),
    "episodes": (1000, grouped),
}


@pytest.mark.parametrize("name", WORK)
def test_time_grows_as_the_size_does(name: str, tmp_path: Path) -> None:
    """Four times as much takes about four times as long, where sixteen would show."""
    size, make = WORK[name]

    def seconds(n: int) -> float:
        run, least = make(n), np.inf
        for _ in range(3):
            started = time.process_time()
            with contextlib.suppress(InputError):
                run(tmp_path)
            least = min(least, time.process_time() - started)
        return least

    small = max(seconds(size), 0.01)
    assert seconds(4 * size) < 9.0 * small
