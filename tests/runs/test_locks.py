"""One process writes a run at a time, and nothing of a killed one is in the way."""

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from sim2gp.errors import InputError
from sim2gp.runs import RunOwned, store
from tests.runs.test_store import save


def test_second_process_is_told_and_a_killed_one_forgotten(tmp_path: Path) -> None:
    code = (
        "import os, sys\nfrom sim2gp.runs import new_run\n"
        "with new_run(sys.argv[1], 'test') as run:\n"
        "    run.write_text('half', 'x')\n"
        "    print('ready', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "ready\n"
        asked = time.monotonic()
        with pytest.raises(RunOwned, match="E191"):
            save(tmp_path / "a")
        assert time.monotonic() - asked < 10.0  # it does not wait
        other.kill()
        other.wait()
    assert sorted(os.listdir(tmp_path)) == [".a.lock", ".a.partial"]
    asked = time.monotonic()
    save(tmp_path / "a")  # at once, whoever had locked it
    assert time.monotonic() - asked < 10.0  # it does not wait
    assert os.listdir(tmp_path) == ["a"]
    assert not (tmp_path / "a" / "half").exists()


def test_at_most_one_writer_however_often_the_lock_changes_hands(
    tmp_path: Path,
) -> None:
    """Its file goes with each release; nobody gets in by the file that is gone."""
    inside, most, counts = [0], [0], {True: 0, False: 0}
    guard = threading.Lock()

    def write() -> None:
        for _ in range(40):
            try:
                with store._locked(tmp_path / "a"):
                    with guard:
                        inside[0] += 1
                        most[0] = max(most[0], inside[0])
                    time.sleep(0.001)
                    with guard:
                        inside[0] -= 1
                        counts[True] += 1
            except RunOwned:
                with guard:
                    counts[False] += 1

    threads = [threading.Thread(target=write) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]
    assert min(counts.values()) > 0
    assert os.listdir(tmp_path) == []


def test_the_lock_is_held_until_its_file_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Given back before, it could be another's file that is removed."""
    remove, entered = os.unlink, []

    def late(*args: Any, **kwargs: Any) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(os, "unlink", remove)
            with contextlib.suppress(RunOwned), store._locked(tmp_path / "a"):
                entered.append(True)
        remove(*args, **kwargs)

    monkeypatch.setattr(os, "unlink", late)
    with store._locked(tmp_path / "a"):
        pass
    assert os.listdir(tmp_path) == []
    assert not entered


def test_a_link_in_the_place_of_what_was_left_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "one.tex").write_text("mine")
    (tmp_path / ".a.partial").symlink_to(tmp_path / "thesis")
    with pytest.raises(InputError, match="E130"):
        save(tmp_path / "a")
    assert (tmp_path / "thesis" / "one.tex").read_text() == "mine"
