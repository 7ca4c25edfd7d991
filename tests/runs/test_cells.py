"""Cells of studies: whole, of this source, and otherwise the user's decision."""

import gzip
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sim2gp.cli import main
from sim2gp.errors import InputError
from sim2gp.runs import Progress, packed_cells
from sim2gp.runs.cell_work import run_cell
from sim2gp.studies import swingup
from sim2gp.studies.study import run_cells
from sim2gp.studies.swingup import Cell

ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 0, "returns": [150.0]}
CELL = Cell("furuta", "nominal", "SIM2GP", 3, 2)


class Computed(Exception):
    """A cell was computed that was there."""


@pytest.fixture
def names(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Studies of planted returns; the cells that were computed, as they are."""
    found: list[str] = []

    def learner(cell: Cell, redrawn: int) -> dict[str, Any]:
        found.append(cell.name)
        returns = [60.0 + 10.0 * e for e in range(cell.episodes)]
        return {"returns": returns, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)
    return found


def draw(out: Path, *old: str) -> dict[str, Any]:
    """What a study of three learners and two seeds says of its cells."""
    rows = {
        (m,): [Cell("furuta", "nominal", m, seed, 2) for seed in (0, 1)]
        for m in ("SIM2GP", "RES", "NLM")
    }
    quiet = Progress(quiet=True)
    more = dict(zip(("old",), old, strict=False))
    return run_cells(rows, out, workers=1, progress=quiet, **more)[1]


def flips(good: bytes, every: int = 1) -> Iterator[bytes]:
    """With one bit flipped."""
    for bit in range(0, 8 * len(good), every):
        flipped = bytearray(good)
        flipped[bit // 8] ^= 1 << bit % 8
        yield bytes(flipped)


@pytest.mark.usefixtures("names")
def test_no_flipped_bit_of_a_stored_cell_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bit of every byte, one after the other, and many an end cut off."""
    run_cell(CELL, tmp_path / "fig2")
    path = tmp_path / "fig2.cells" / f"{CELL.name}.json"
    good = path.read_bytes()

    def again(cell: Cell, redrawn: int) -> dict[str, Any]:
        raise Computed

    monkeypatch.setattr(swingup, "learner_cell", again)
    assert run_cell(CELL, tmp_path / "fig2")["returns"] == [60.0, 70.0]
    bad = [good[:end] for end in range(0, len(good), 32)]
    accepted = 0
    for content in [*bad, *flips(good, 9)]:
        path.write_bytes(content)
        try:
            run_cell(CELL, tmp_path / "fig2")
            accepted += 1
        except (InputError, Computed):
            continue
    assert accepted == 0
    # Nor is a damaged one used because older ones are; computed again it may be.
    path.write_bytes(bad[-1])
    with pytest.raises(InputError, match=r"E186 .* 1 damaged"):
        run_cell(CELL, tmp_path / "fig2", "keep")
    with pytest.raises(Computed):
        run_cell(CELL, tmp_path / "fig2", "refresh")


def unmarked(path: Path) -> None:
    """As an earlier version wrote it."""
    found = json.loads(path.read_text())
    old = {"arguments": found["arguments"], "values": found["values"]}
    path.write_text(json.dumps(old, indent=2) + "\n")


def test_a_study_refuses_older_cells_until_the_user_decides(
    names: list[str], tmp_path: Path
) -> None:
    """Before the first cell is computed; by their count; then as the user says."""
    draw(tmp_path / "a")
    whole, count = list(names), len(names)
    older = [f"{name}.json" for name in whole[3:6]]
    for name in older:
        unmarked(tmp_path / "a.cells" / name)
    (tmp_path / "a.cells" / f"{whole[0]}.json").unlink()
    names.clear()
    with pytest.raises(InputError, match=r"E186 .* 3 without a checksum") as refused:
        draw(tmp_path / "a")
    assert "--keep-old" in str(refused.value)
    assert names == []
    kept = draw(tmp_path / "a", "keep")
    assert names == whole[:1]
    assert kept["cells_of_other_source"] == kept["cells_without_checksum"] == 3
    assert [text for text in kept["warnings"] if f"3 of {count + 2} cells" in text]
    names.clear()
    fresh = draw(tmp_path / "a", "refresh")
    assert names == whole[3:6]
    assert fresh["cells_of_other_source"] == 0
    assert "warnings" not in fresh
    names.clear()
    assert draw(tmp_path / "a")["source"] == fresh["source"]
    assert names == []


def test_the_command_line_asks_what_to_do_with_older_cells(
    names: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def reproduce(*more: str) -> int:
        words = "reproduce mismatch --quick --workers 1 --json --quiet --out".split()
        return main([*words, str(tmp_path / "map"), *more])

    assert reproduce() == 0
    for name in names[:3]:
        unmarked(tmp_path / "map.cells" / f"{name}.json")
    before = capsys.readouterr().out
    assert reproduce() == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert "E186" in said.err
    assert "--keep-old uses them" in said.err
    for option, count in (("--keep-old", 3), ("--refresh", 0)):
        assert reproduce(option) == 0
        found = json.loads(capsys.readouterr().out)
        assert found["cells_of_other_source"] == count
        assert found["source"] == json.loads(before)["source"]


Study = tuple[Path, Callable[..., Any]]


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """A script's folder, and the cells of its study, as another process has them."""
    from sim2gp.runs import sources
    from sim2gp.runs.cells import Cells

    (tmp_path / "work.py").write_text("import helper\n\n\ndef work(): ...\n")
    (tmp_path / "helper.py").write_text("GAIN = 2.0  # of everything\n")

    def cells(*old: str) -> Cells:
        for cached in (sources.source_of, sources._read):
            cached.cache_clear()
        return Cells(tmp_path / "out", tmp_path / "work.py", *old)

    return tmp_path, cells


ARGUMENTS = {"seed": 1, "planner": {"type": "MPC"}}


def test_the_error_says_which_modules_and_versions_differ(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sim2gp.runs import sources

    folder, cells = study
    cells().save("one", ARGUMENTS, {"x": 1.0})
    assert cells().load("one", ARGUMENTS) == {"x": 1.0}
    (folder / "helper.py").write_text('"""Words."""\n\nGAIN = (2.0)\n')
    assert cells().load("one", ARGUMENTS) == {"x": 1.0}  # it says the same
    (folder / "helper.py").write_text("GAIN = 3.0\n")
    said = r"E186 .* 1 of another source \(one\); other: helper,"
    with pytest.raises(InputError, match=said):
        cells().load("one", ARGUMENTS)
    with pytest.raises(InputError, match=said):
        cells().check([("one", ARGUMENTS), ("two", ARGUMENTS)])
    assert cells("keep").load("one", ARGUMENTS) == {"x": 1.0}
    assert cells("keep").summary([("one", ARGUMENTS)])["cells_of_other_source"] == 1
    assert cells("refresh").load("one", ARGUMENTS) is None
    (folder / "helper.py").write_text("GAIN = 2.0\n")
    then = sources.version
    monkeypatch.setattr(sources, "version", lambda name: f"{then(name)}.1")
    jax, numpy = then("jax"), then("numpy")
    with pytest.raises(InputError, match=f"other: jax {jax}, .*numpy {numpy},"):
        cells().load("one", ARGUMENTS)
    (next((folder / "out.cells" / "sources").iterdir())).write_text("{}")
    with pytest.raises(InputError, match="an unknown source"):
        cells().load("one", ARGUMENTS)


@pytest.mark.parametrize("old", ["refuse", "keep"])
def test_cells_of_other_arguments_are_never_used(study: Study, old: str) -> None:
    _, cells = study
    cells().save("one", ARGUMENTS, {"x": 1.0})
    with pytest.raises(InputError, match=r"E186 .* 1 with other arguments"):
        cells(old).load("one", ARGUMENTS | {"seed": 2})
    assert cells("refresh").load("one", ARGUMENTS | {"seed": 2}) is None


def test_layout_and_checksum_of_a_cell_count_as_well(study: Study) -> None:
    _, cells = study
    stored = cells("keep")
    stored.save("one", ARGUMENTS, {"x": [1.0, -2.5e-7], "y": None})
    path = stored.folder / "one.json"
    for content in flips(path.read_bytes(), 3):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"E186 .* 1 damaged"):
            stored.load("one", ARGUMENTS)


def test_a_file_that_is_no_cell_is_damaged(study: Study) -> None:
    """Also one with a right checksum, and one that a flip makes look older."""
    from sim2gp.runs.sealed import seal

    _, cells = study
    cells().save("one", ARGUMENTS, {"x": 1.0})
    path = cells().folder / "one.json"
    good = path.read_bytes()
    for content in (
        b"",
        b"[]",
        b"\xff",
        b"{}",
        b'{"a":' * 10**5,
        seal({"values": {}}),
        seal({"arguments": ARGUMENTS, "source": "", "values": []}),
        good.replace(b"sha256", b"sha257"),
        b'{"arguments": {}, "values": {"x": 1.0}, "values": {"x": 2.0}}',
        b'{"arguments": {}, "values": {"x": NaN}}',
    ):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"E186 .* 1 damaged"):
            cells("keep").load("one", ARGUMENTS)


CODE = """
import sys
from sim2gp.runs.sources import source_of
print(source_of(sys.argv[1]).digest)
assert not {"jax", "equinox", "sim2gp.systems"} & set(sys.modules)
"""


def test_the_source_is_one_for_all_processes() -> None:
    """Whatever their hash seeds; and it is read, not imported."""
    found = {
        subprocess.run(
            [sys.executable, "-c", CODE, swingup.__file__],
            env=os.environ | {"PYTHONHASHSEED": seed},
            check=True,
            capture_output=True,
            text=True,
            timeout=60,
        ).stdout
        for seed in ("0", "1")
    }
    assert len(found) == 1


def test_the_source_is_all_that_is_imported() -> None:
    """What Python loads for the study, but for rooms that only show."""
    from sim2gp.runs.sources import SHOWN, source_of

    code = (
        "import sys, sim2gp.studies.swingup\n"
        "print(*(m for m in sys.modules if m.split('.')[0] == 'sim2gp'))\n"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        capture_output=True,
        text=True,
        timeout=120,
    ).stdout.split()
    shown = {m for m in loaded if "." in m and m.split(".")[1] in SHOWN}
    known = set(source_of(swingup.__file__).modules)
    assert len(loaded) > 50
    assert set(loaded) - shown <= known
    assert not [m for m in known if m.split(".")[1:2] and m.split(".")[1] in SHOWN]


def test_imports_are_found_wherever_they_are(tmp_path: Path) -> None:
    from sim2gp.runs.sources import source_of

    (tmp_path / "study.py").write_text(
        "import numpy\nfrom part import name\n\n"
        "def work():\n    import other.deep\n    from sim2gp import Progress\n"
    )
    (tmp_path / "part.py").write_text(
        "from sim2gp.inference.gaussian import Gaussian\n"
    )
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "__init__.py").write_text("")
    (tmp_path / "other" / "deep.py").write_text("from .near import x\n")
    (tmp_path / "other" / "near.py").write_text("x = 1\n")
    (tmp_path / "stranger.py").write_text("")
    modules = set(source_of(tmp_path / "study.py").modules)
    scripts = {m for m in modules if m.split(".")[0] != "sim2gp"}
    assert scripts == {"study", "part", "other", "other.deep", "other.near"}
    # A name of the package itself may come from any room.
    assert {
        "sim2gp.inference.gaussian",
        "sim2gp.inference.linalg",
        "sim2gp.planning.loop",
    } <= modules
    (tmp_path / "less.py").write_text("from part import name\n")
    modules = set(source_of(tmp_path / "less.py").modules)
    assert "sim2gp.inference.linalg" in modules
    assert "sim2gp.planning.loop" not in modules


def test_a_packed_study_is_the_same_study(study: Study) -> None:
    """Byte for byte, with what came after it; the same files give the same pack."""
    folder, cells = study
    for name in ("one", "two"):
        cells().save(name, ARGUMENTS, {"x": 1.5, "unit": "\u00b5m"})
    place = folder / "out.cells"
    files = {
        p.relative_to(place).as_posix(): p.read_bytes() for p in place.rglob("*.json")
    }
    target = packed_cells.pack(place)
    assert not place.exists()
    assert packed_cells.unpacked(place) == files
    first = target.read_bytes()
    assert cells().load("one", ARGUMENTS) == {"x": 1.5, "unit": "\u00b5m"}
    assert cells().load("three", ARGUMENTS) is None
    with pytest.raises(InputError, match="1 with other arguments"):
        cells().load("one", ARGUMENTS | {"seed": 2})
    (folder / "helper.py").write_text("GAIN = 3.0\n")
    with pytest.raises(InputError, match=r"1 of another source \(one\); other: helper"):
        cells().load("one", ARGUMENTS)
    (folder / "helper.py").write_text("GAIN = 2.0  # of everything\n")
    cells().save("three", ARGUMENTS, {"x": 2.5})
    (place / "picture.png").write_bytes(b"kept")
    packed_cells.pack(place)
    assert [p.name for p in place.rglob("*")] == ["picture.png"]
    assert cells().load("three", ARGUMENTS) == {"x": 2.5}
    assert cells().load("two", ARGUMENTS) == {"x": 1.5, "unit": "\u00b5m"}
    for name, content in files.items():
        path = folder / "again.cells" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    assert packed_cells.pack(folder / "again.cells").read_bytes() == first


def test_a_damaged_pack_is_refused(
    study: Study, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, cells = study
    cells().save("one", ARGUMENTS, {"x": 1.0})
    target = packed_cells.pack(folder / "out.cells")
    good = target.read_bytes()
    for k, content in enumerate(
        (good[:-9], good[:20], b"", b"{}", gzip.compress(b"[1]\n"), good[::-1])
    ):
        target.write_bytes(content)
        os.utime(target, ns=(k, k))  # a clock may not have moved on
        if content == b"":
            assert cells().load("one", ARGUMENTS) is None  # no cells, and no harm
            continue
        with pytest.raises(InputError, match=r"E183.*out\.cells\.jsonl\.gz"):
            cells().load("one", ARGUMENTS)
    target.write_bytes(good)
    monkeypatch.setattr(packed_cells, "LIMIT", 100)
    with pytest.raises(InputError, match="E183"):
        cells().load("one", ARGUMENTS)
