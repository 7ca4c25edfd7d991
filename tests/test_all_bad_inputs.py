"""The list of bad inputs, whole: each gets one line with its code and leaves nothing.

Driven through the command that takes the input, in this process; through Python where
no command does. The inputs stand in `bad_logs`, `bad_projects` and
`bad_files`, what they share in `bad_inputs`.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import stub_commands
from bad_files import THIRD
from bad_inputs import TEXTS, Case, Input, changed, log
from bad_logs import FIRST
from bad_projects import SECOND
from sim2gp.cli import main
from sim2gp.errors import Sim2GPError

CASES = (*FIRST, *SECOND, *THIRD)
LINE = re.compile(r"[EW]1\d\d \S.*(in|:) .*got .*expected .*\. Fix: .*\.")


def contents(folder: Path) -> dict[str, bytes | str]:
    """Every path below a folder, with what is in it where it can be read."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        if path.is_file() and not path.is_symlink() and path.stat().st_mode & 0o400
        else ""
        for path in folder.rglob("*")
    }


def compiled(*args: object) -> None:
    raise AssertionError("the input was believed")


def refused(
    words: list[str], capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch
) -> str:
    """The line that a command says which stops at its input, and compiles nothing."""
    patch.setattr("sim2gp.commands.identify.fit_windows", compiled)
    before = contents(Path.cwd())
    assert main(words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert contents(Path.cwd()) == before
    return said.err.rstrip("\n")


def stated(
    given: Input,
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    patch: pytest.MonkeyPatch,
) -> str:
    """The note that a command says which goes on; its fit is left out."""
    with patch.context() as during:
        stub_commands.install(during, identify=stub_commands.identify)
        assert main(words) == 0
    err = capsys.readouterr().err
    summary = json.loads((Path.cwd() / "runs/project/summary.json").read_text())
    counted = summary | {"warnings": len(summary["warnings"])}
    assert {name: counted[name] for name in given.summary} == given.summary
    notes = [line for line in err.splitlines() if line.startswith("W1")]
    if given.code == "":
        return ""
    return next(line for line in notes if line.startswith(given.code))


@pytest.mark.parametrize("bad", CASES, ids=lambda bad: f"{bad.number} {bad.title}")
def test_bad_input(
    bad: Case,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for i, given in enumerate(bad.inputs):
        folder = tmp_path / str(i)
        folder.mkdir()
        with monkeypatch.context() as patch:
            patch.chdir(folder)
            try:
                words = given.make(folder, patch)
            except Sim2GPError as error:
                line = str(error)
            else:
                assert words is not None, "neither a command nor an error"
                if given.code[:1] == "E":
                    line = refused(list(words), capsys, patch)
                else:
                    line = stated(given, list(words), capsys, patch)
        assert line.startswith(given.code)
        assert "\n" not in line
        assert len(line) < 600
        for word in given.words:
            assert word in line
        if given.code[:1] == "E":
            assert LINE.fullmatch(line), line


def test_the_list_is_whole() -> None:
    assert [bad.number for bad in CASES] == [*range(1, 77)]
    assert all(bad.inputs for bad in CASES)


def test_the_good_case_is_good(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What all inputs of a log are spoilt from is well, and nothing is said of it."""
    monkeypatch.chdir(tmp_path)
    good = log(TEXTS, "", n_transitions=299, warnings=0)
    words = good.make(tmp_path, monkeypatch)
    assert stated(good, [*(words or ())], capsys, monkeypatch) == ""


def test_the_installed_command(tmp_path: Path) -> None:
    """In a process of its own, as a user meets it."""
    words = log(changed(7, 1, float("nan")), "E101").make(
        tmp_path, pytest.MonkeyPatch()
    )
    before = contents(tmp_path)
    call = "import sys; from sim2gp.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run(
        [sys.executable, "-c", call, *(words or ())],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("E101 ")
    assert done.stderr.count("\n") == 1
    assert contents(tmp_path) == before
