"""The list of bad inputs: each gets one line, of its entry in the catalogue of errors.

An input goes through the command that takes it, in this process, and leaves nothing;
through Python where no command does. The files `bad_*` have the inputs, `bad_inputs`
what they share.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import stub_commands
from sim2gp import cli
from sim2gp.cli import main
from sim2gp.errors import Sim2GPError
from tests.catalogue.bad_calls import CALLS
from tests.catalogue.bad_files import THIRD
from tests.catalogue.bad_inputs import TEXTS, Input, changed, log
from tests.catalogue.bad_logs import FIRST
from tests.catalogue.bad_projects import SECOND
from tests.catalogue.bad_tables import TABLES

CASES = (*FIRST, *TABLES, *SECOND, *THIRD, *CALLS)
ROWS = [(bad, i, given) for bad in CASES for i, given in enumerate(bad.inputs)]
LINE = re.compile(r"[EW]1\d\d \S.*(in|:) .*got .*expected .*\. Fix: .*\.")
CODE = re.compile(r"[EW]\d{3}")


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
) -> Sim2GPError:
    """The error of a command that stops at its input, and compiles nothing."""
    patch.setattr("sim2gp.commands.identify.fit_windows", compiled)
    met: list[Sim2GPError] = []
    printed = cli._print_error

    def answer(error: Sim2GPError, code: int, debug: bool) -> int:
        met.append(error)
        return printed(error, code, debug)

    patch.setattr(cli, "_print_error", answer)
    before = contents(Path.cwd())
    assert main(words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == f"{met[0]}\n"
    assert contents(Path.cwd()) == before
    return met[0]


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
    if given.key == "":
        return ""
    return next(line for line in notes if line.startswith(given.key))


@pytest.mark.parametrize(
    "given",
    [row[-1] for row in ROWS],
    ids=[f"{bad.number} {bad.title} {i} {given.key}" for bad, i, given in ROWS],
)
def test_bad_input(
    given: Input,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    error: Sim2GPError | None = None
    try:
        words = given.make(tmp_path, monkeypatch)
    except Sim2GPError as caught:
        error = caught
    else:
        assert words is not None, "neither a command nor an error"
        if given.key == "" or given.key.startswith("W1"):
            line = stated(given, list(words), capsys, monkeypatch)
        else:
            error = refused(list(words), capsys, monkeypatch)
            assert bool(LINE.fullmatch(str(error))) is not given.brief, error
    if error is not None:
        assert given.key in (error.key, error.code), error
        assert bool(error.key) != bool(CODE.fullmatch(given.key)), error.key
        line = str(error)
    assert line.startswith(given.code)
    assert "\n" not in line
    assert len(line) < 600
    for word in given.words:
        assert word in line


def test_the_list_is_whole() -> None:
    assert [bad.number for bad in CASES] == [*range(1, 1 + len(CASES))]
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
    words = log(changed(7, 1, float("nan")), "value_not_finite").make(
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
