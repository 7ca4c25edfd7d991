"""Runs on disk: whole or not at all, whatever fails, and honest about damage."""

import contextlib
import errno
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from sim2gp.errors import InputError
from sim2gp.runs import DiskError, Progress, load_run, new_run
from sim2gp.runs.plain import to_json
from sim2gp.runs.progress import Task, time_left
from sim2gp.runs.sealed import seal, unseal


def save(path: Path, value: float = 1.0, *, extra: bool = False) -> None:
    with new_run(path, "test") as run:
        run.write_summary({"value": value, "none": None, "list": [1, 2.5, "a"]})
        run.write_arrays("arrays.npz", {"a/b": np.arange(5.0), "mask": [True, False]})
        run.write_text("report.html", f"<p>{value}</p>")
        if extra:
            run.write_text("figures/one.svg", "<svg/>")


def save_and_fail(path: Path, error: BaseException | type[BaseException]) -> None:
    with new_run(path, "test") as run:
        run.write_summary({"value": 2.0})
        raise error


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    save(tmp_path / "runs" / "a", extra=True)
    run = load_run(tmp_path / "runs" / "a")
    assert run.summary == {"value": 1.0, "none": None, "list": [1, 2.5, "a"]}
    np.testing.assert_array_equal(run.arrays["a/b"], np.arange(5.0))
    assert run.arrays["mask"].dtype == bool
    assert sorted(os.listdir(tmp_path / "runs")) == ["a"]
    manifest = json.loads((run.path / "manifest.json").read_text())
    assert manifest["command"] == "test"
    assert {"python", "numpy", "jax"} <= set(manifest["environment"])
    assert set(manifest["files"]) == set(contents(run.path)) - {"manifest.json"}


def test_same_content_same_bytes(tmp_path: Path) -> None:
    save(tmp_path / "a")
    save(tmp_path / "b")
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_a_failed_command_leaves_nothing(
    tmp_path: Path, error: type[BaseException]
) -> None:
    with pytest.raises(error):
        save_and_fail(tmp_path / "x" / "y" / "run", error)
    assert os.listdir(tmp_path) == []


def test_a_failed_command_keeps_the_earlier_run(tmp_path: Path) -> None:
    save(tmp_path / "a")
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="no"):
        save_and_fail(tmp_path / "a", ValueError("no"))
    assert contents(tmp_path) == before


def test_a_second_run_replaces_the_first_and_spares_notes(tmp_path: Path) -> None:
    save(tmp_path / "a", extra=True)
    (tmp_path / "a" / "notes.txt").write_text("mine")
    save(tmp_path / "a", 2.0)
    assert load_run(tmp_path / "a").summary["value"] == 2.0
    assert (tmp_path / "a" / "notes.txt").read_text() == "mine"
    assert not (tmp_path / "a" / "figures" / "one.svg").exists()
    assert os.listdir(tmp_path) == ["a"]


def test_an_empty_folder_is_taken(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    save(tmp_path / "a")
    assert load_run(tmp_path / "a").summary["value"] == 1.0


@pytest.mark.parametrize("kind", ["folder", "file", "link"])
def test_somebody_elses_place_is_refused(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    if kind == "folder":
        path.mkdir()
        (path / "thesis.tex").write_text("")
    elif kind == "file":
        path.write_text("")
    else:
        path.symlink_to(tmp_path)
    before = contents(tmp_path)
    with pytest.raises(InputError, match="E132"):
        save(path)
    assert contents(tmp_path) == before


def failing(monkeypatch: pytest.MonkeyPatch, at: int, number: int) -> list[str]:
    """Make the ``at``-th system call that changes the disk fail; returns the calls."""
    calls: list[str] = []

    def wrap(module: Any, name: str) -> None:
        original: Callable[..., Any] = getattr(module, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            calls.append(name)
            if len(calls) - 1 == at:
                raise OSError(number, os.strerror(number))
            return original(*args, **kwargs)

        monkeypatch.setattr(module, name, call)

    for name in ("mkdir", "fsync", "rename", "replace", "open"):
        wrap(os, name)
    return calls


@pytest.mark.parametrize("earlier", [False, True])
def test_every_failing_call_leaves_old_or_new(
    earlier: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fail the k-th call for every k: the old run or the new one, and both load."""
    at, done = 0, False
    while not done:
        folder = tmp_path / str(at)
        folder.mkdir()
        if earlier:
            save(folder / "a")
        with monkeypatch.context() as patch:
            calls = failing(patch, at, errno.ENOSPC)
            with contextlib.suppress(DiskError):
                save(folder / "a", 2.0)
            done = at >= len(calls)
        found = (folder / "a").exists()
        values = [load_run(folder / "a").summary["value"]] if found else []
        assert values in ([[1.0], [2.0]] if earlier else [[], [2.0]])
        # Should tidying up have failed, the next run does it.
        save(folder / "a", 3.0)
        assert os.listdir(folder) == ["a"]
        at += 1
    assert at > 10


def test_everything_is_on_the_disk_before_the_rename(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = failing(monkeypatch, -1, errno.EIO)
    save(tmp_path / "a")
    written = len(contents(tmp_path / "a"))
    before = calls[: calls.index("rename")]
    assert before.count("fsync") == written + 1  # each file, then their folder
    assert calls[calls.index("rename") :].count("fsync") == 1  # and its name


@pytest.mark.parametrize("name", ["summary.json", "arrays.npz", "manifest.json"])
def test_every_torn_or_flipped_file_is_noticed(name: str, tmp_path: Path) -> None:
    save(tmp_path / "a")
    path = tmp_path / "a" / name
    good = path.read_bytes()
    flips = [bytearray(good) for _ in range(0, 8 * len(good), 13)]
    for i, flipped in enumerate(flips):
        bit = 13 * i
        flipped[bit // 8] ^= 1 << bit % 8
    for bad in [*flips, *(good[:n] for n in range(0, len(good), 64))]:
        path.write_bytes(bad)
        with pytest.raises(InputError, match="E183"):
            load_run(tmp_path / "a")
    path.unlink()
    with pytest.raises(InputError, match="E130" if name == "manifest.json" else "E183"):
        load_run(tmp_path / "a")
    path.write_bytes(good)
    load_run(tmp_path / "a")


def test_foreign_and_newer_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="E130 not a run"):
        load_run(tmp_path / "gone")
    save(tmp_path / "a")
    manifest = tmp_path / "a" / "manifest.json"
    text = manifest.read_text()
    newer = unseal(manifest.read_bytes()) | {"format": 99}
    for written in (seal(newer), to_json(newer).encode()):
        manifest.write_bytes(written)
        with pytest.raises(InputError, match="E185"):
            load_run(tmp_path / "a")
    manifest.write_text(text[:50])
    with pytest.raises(InputError, match="E183"):
        load_run(tmp_path / "a")
    save(tmp_path / "a", 3.0)  # and running again mends it
    assert load_run(tmp_path / "a").summary["value"] == 3.0


def test_a_run_cut_between_two_renames_loads_and_heals(tmp_path: Path) -> None:
    save(tmp_path / "a")
    (tmp_path / "a" / "notes.txt").write_text("mine")
    os.rename(tmp_path / "a", tmp_path / ".a.previous")
    assert load_run(tmp_path / "a").summary["value"] == 1.0
    save(tmp_path / "a", 2.0)
    assert load_run(tmp_path / "a").summary["value"] == 2.0
    assert (tmp_path / "a" / "notes.txt").read_text() == "mine"
    assert os.listdir(tmp_path) == ["a"]


def test_a_moved_run_still_loads(tmp_path: Path) -> None:
    save(tmp_path / "a")
    (tmp_path / "b").mkdir()
    os.rename(tmp_path / "a", tmp_path / "b" / "c")
    assert load_run(tmp_path / "b" / "c").summary["value"] == 1.0


finite = st.floats(allow_nan=False, allow_infinity=False)
leaves = st.none() | st.booleans() | st.integers() | finite | st.text()
trees = st.recursive(
    leaves,
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)


@given(st.dictionaries(st.text(), trees))
@settings(max_examples=settings.default.max_examples // 4)
def test_json_round_trip(tree: dict[str, Any]) -> None:
    assert json.loads(to_json(tree)) == tree


@given(hnp.arrays(np.float64, hnp.array_shapes(max_dims=3), elements=finite))
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_arrays_become_lists(array: np.ndarray) -> None:
    assert json.loads(to_json({"a": array})) == {"a": array.tolist()}


def test_progress_lines(capsys: pytest.CaptureFixture[str]) -> None:
    progress = Progress()
    assert list(progress.track("abc", "letters")) == ["a", "b", "c"]
    with progress.task("fit", 2) as task:
        task.advance("cost 1.5")
        task.advance("cost 0.5")
    said = capsys.readouterr()
    assert said.out == ""
    lines = ["letters: 1/3", "letters: 3/3", "fit: 1/2  cost 1.5", "fit: 2/2  cost 0.5"]
    assert said.err.splitlines() == lines
    quiet = Progress(quiet=True)
    assert list(quiet.track("abc", "letters")) == ["a", "b", "c"]
    quiet.say("nothing")
    assert capsys.readouterr().err == ""


def test_time_left_is_at_the_same_pace() -> None:
    assert time_left(1, 4, 20.0) == "60 s left"
    assert time_left(2, 4, 600.0) == "10 min left"
    assert [time_left(n, 4, 1.0) for n in (0, 4)] == ["", ""]
    assert time_left(9, 10, 1.0) == ""


def test_time_left_falls_while_a_part_is_under_way() -> None:
    """A part that says more than once how far it is does not seem to take longer."""
    shown: list[str] = []
    task = Task("fit", 4, lambda task, note: shown.append(task.left()))
    task.started -= 10.0
    task.advance()
    for _ in range(2):
        task.moved -= 5.0
        task.started -= 5.0
        task.advance("a step", 0)
    assert shown == ["30 s left", "25 s left", "20 s left"]


def test_parts_of_an_earlier_run_and_stages_say_nothing_of_the_pace() -> None:
    """One of the four parts that were left took 10 s."""
    shown: list[str] = []
    for alike in (True, False):
        task = Task("fit", 10, lambda task, note: shown.append(task.left()), alike)
        task.skip(6)
        task.started -= 10.0
        task.advance()
        assert task.done == 7
    assert shown == ["", "30 s left", "", ""]


def test_a_notebook_has_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in for IPython: what is displayed, and how it changes."""
    pages: list[str] = []

    class Shown:
        def update(self, page: str) -> None:
            pages.append(page)

    def display(page: str, *, display_id: bool) -> Shown:
        assert display_id
        pages.append(page)
        return Shown()

    module = ModuleType("IPython.display")
    module.HTML = str  # type: ignore[attr-defined]
    module.display = display  # type: ignore[attr-defined]
    for name in ("ipykernel", "IPython"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with Progress().task("fit", 2) as task:
        task.advance("cost <1.5>")
    assert '<progress value="0" max="2">' in pages[0]
    assert '<progress value="1" max="2"></progress> 1/2 cost &lt;1.5&gt;' in pages[1]
    Progress(quiet=True).say("nothing")
    assert len(pages) == 2
