"""Shares of a study: each computed alone, and joined to what one run computes."""

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2gp.cli import main
from sim2gp.errors import InputError, Sim2GPError
from sim2gp.runs import Progress, cell_work
from sim2gp.runs.cell_work import (
    AbstractCell,
    Values,
    compute_cells,
    run_cell,
    with_needed,
)
from sim2gp.runs.executors import Processes
from sim2gp.runs.plain import exact, from_exact, to_json
from sim2gp.runs.shares import Share, compute_share, join_shares
from sim2gp.studies import swingup

QUIET = Progress(quiet=True)


@dataclass(frozen=True)
class Root(AbstractCell):
    """Roots of a seed's numbers, some of which are not there."""

    seed: int
    first: bool = False

    @property
    def name(self) -> str:
        return f"root_{self.seed}{'_first' * self.first}"

    @property
    def arguments(self) -> Values:
        return {"seed": self.seed, "first": self.first}

    @property
    def needs(self) -> "Root | None":
        return None if self.first else Root(self.seed // 3, first=True)

    def compute(self, needed: Values | None) -> Values:
        x = np.random.default_rng(self.seed).standard_normal((3, 2))
        with np.errstate(invalid="ignore"):
            return exact({"root": np.sqrt(x), "needed": needed is not None})


CELLS = [Root(k) for k in range(10)]  # they need four others


@pytest.mark.parametrize("count", [1, 2, 4, 6])
def test_shares_joined_are_one_run_bit_for_bit(count: int, tmp_path: Path) -> None:
    """Each in a folder of its own, the last one computed first."""
    whole = tmp_path / "whole"
    for cell in CELLS:
        run_cell(cell, whole)
    outs = [tmp_path / f"share{k}" for k in range(count, 0, -1)]
    done = [
        compute_share(CELLS, out, Share(k, count), workers=1, progress=QUIET)
        for k, out in zip(range(count, 0, -1), outs, strict=True)
    ]
    sizes = [int(re.search(r": (\d+) of 14 cells", one["headline"])[1]) for one in done]
    assert sum(sizes) == 14, "a cell is in two shares"
    store = join_shares(CELLS, tmp_path / "joined", outs)
    names = sorted(p.relative_to(store.folder) for p in store.folder.rglob("*.json"))
    assert len(names) == 14 + 1
    for name in names:
        one = (tmp_path / "whole.cells" / name).read_bytes()
        assert (store.folder / name).read_bytes() == one
    values = compute_cells(CELLS, store, Fails())
    assert np.isnan(from_exact(values[CELLS[0]])["root"]).any()


class Fails(Processes):
    """Computes nothing."""

    def spread(self, work: Any, groups: Any) -> Iterator[Any]:
        assert not any(groups), "computed again"
        return iter(())


def test_what_is_missing_is_said_and_nothing_is_written(tmp_path: Path) -> None:
    compute_share(CELLS, tmp_path / "a", Share(1, 2), workers=1, progress=QUIET)
    with pytest.raises(InputError, match=r"E187 .* 6 of 14 are missing \(root_1_first"):
        join_shares(CELLS, tmp_path / "a")
    file = tmp_path / "a.cells" / "root_0.json"
    file.write_bytes(file.read_bytes().replace(b"base64", b"base65", 1))
    with pytest.raises(InputError, match=r"E186 .* 1 damaged"):
        join_shares(CELLS, tmp_path / "b", [tmp_path / "a"])
    assert not (tmp_path / "b.cells").exists()


class Elsewhere(Processes):
    """Another machine, with another version."""

    @property
    def count(self) -> int:
        return 2

    def spread(self, work: Any, groups: Any) -> Iterator[Any]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(cell_work, "_source", lambda cell: "0" * 16)
            yield from super().spread(work, groups)


def test_values_of_other_code_are_refused(tmp_path: Path) -> None:
    with pytest.raises(Sim2GPError, match=r"E209 .* code 0000"):
        compute_cells(CELLS, None, Elsewhere())


def test_cells_follow_those_that_they_need() -> None:
    every = with_needed(CELLS)
    assert len(every) == len(set(every)) == 14
    for cell in CELLS:
        assert every.index(cell.needs) < every.index(cell)


dtypes = st.sampled_from(["<f8", "<f4", "<i8", "|b1"])
shapes = st.lists(st.integers(0, 3), max_size=3)


@given(dtypes, shapes, st.binary(min_size=8 * 27, max_size=8 * 27))
def test_arrays_come_back_bit_by_bit(
    dtype: str, shape: list[int], content: bytes
) -> None:
    size = int(np.prod(shape, dtype=int))
    x = np.frombuffer(content, dtype)[:size].reshape(shape)
    if dtype == "|b1":
        x = np.asarray(x.view(np.uint8) % 2 == 1)
    there = json.loads(to_json(exact({"a": [x, 1.5, "b"], "c": {"d": None}})))
    back = from_exact(there)
    assert back["a"][0].dtype == x.dtype
    assert back["a"][0].shape == x.shape
    assert back["a"][0].tobytes() == x.tobytes()
    assert back["a"][1:] == [1.5, "b"]
    assert back["c"] == {"d": None}


def test_objects_are_no_arrays() -> None:
    with pytest.raises(ValueError, match="OBJECT"):
        from_exact({"dtype": "|O", "shape": [1], "base64": "AAAAAAAAAAA="})


ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 0, "returns": [150.0]}


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> None:
    """Returns that depend on the cell alone."""

    def learner(cell: swingup.Cell, redrawn: int) -> dict[str, Any]:
        one = float(np.random.default_rng(len(cell.name) + cell.seed).uniform(60, 150))
        returns = [one] * cell.episodes
        return {"returns": returns, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)


@pytest.mark.usefixtures("planted")
def test_the_command_line_computes_shares_and_joins_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def reproduce(out: str, *more: str) -> int:
        words = "reproduce mismatch --quick --workers 1 --json --quiet --out".split()
        return main([*words, str(tmp_path / out), *more])

    assert reproduce("whole") == 0
    whole = json.loads(capsys.readouterr().out)
    assert reproduce("a", "--shard", "1/2") == 0
    first = json.loads(capsys.readouterr().out)
    assert "share 1 of 2" in first["headline"]
    assert first["source"] == whole["source"]
    assert not (tmp_path / "a").exists()
    assert reproduce("a", "--merge") == 2
    assert "E187" in capsys.readouterr().err
    assert reproduce("b", "--shard", "2/2") == 0
    shutil.move(tmp_path / "b.cells", tmp_path / "moved.cells")
    capsys.readouterr()
    assert reproduce("a", "--merge", str(tmp_path / "moved")) == 0
    joined = json.loads(capsys.readouterr().out)
    for found in (whole, joined):  # when, and how long it took
        for name in ("command_line", "seconds", "started", "created", "time"):
            found.pop(name, None)
    assert joined["claims"] == whole["claims"]
    assert joined["returns"] == whole["returns"]
    arrays = [(tmp_path / name / "arrays.npz").read_bytes() for name in ("a", "whole")]
    assert arrays[0] == arrays[1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--shard 3/2", "I/N"),
        ("--shard half", "I/N"),
        ("--shard 1/2 --merge", "one of them"),
        ("--ray a b", "one address"),
        ("--cell-gpus -1", "from 0"),
    ],
)
def test_a_share_must_be_one(
    words: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["reproduce", "fig2", *words.split()]) == 2
    assert said in capsys.readouterr().err
