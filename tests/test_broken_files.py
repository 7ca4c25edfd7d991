"""Recordings cut off or with bytes changed: columns, or one line that says so."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recordings as rec
from sim2gp.errors import InputError
from sim2gp.logs import columns_of

TABLE = rec.motion(rows=120)
WRITTEN: dict[str, Callable[[Path], Any]] = {
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
    lines = []
    for content in spoilt:
        path.write_bytes(content)
        try:
            columns_of(path)
        except InputError as error:
            lines.append(str(error))
    assert len(lines) >= 3
    assert not any("\n" in line for line in lines)
