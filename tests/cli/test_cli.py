"""The command line: what it prints where, its exit codes, and what it leaves behind."""

import json
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import stub_commands
from sim2gp.cli import main
from sim2gp.cli.commands import COMMANDS
from sim2gp.errors import InputError, NotConverged, Sim2GPWarning
from sim2gp.runs import DiskError, Progress, RunOwned

SUMMARY = {
    "oracle_return": 193.25,
    "returns": [10.0, 150.5],
    "parameters": {"mass": {"mean": 0.5, "sd": 0.01, "verdict": "identified"}},
    "noise": {"q1": 0.001},
    "warnings": ["W110 period varies"],
}
START = [sys.executable, "-c"]
ENTRY = "from sim2gp.cli import entry; entry()"
CALL = "import sys; from sim2gp.cli import main; raise SystemExit(main(sys.argv[1:]))"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def demo(action: Callable[[Progress], Any]) -> Callable[..., stub_commands.Returned]:
    """A demo that does something and returns the summary above."""

    def run(
        *,
        machine: str,
        seed: int,
        seeds: int,
        episodes: int,
        truth: str,
        mismatch: bool,
        progress: Progress,
        sink: Any,
    ) -> stub_commands.Returned:
        assert (truth, mismatch) == ("prior", False)
        sink.scalars(0, {"seed": seed})
        action(progress)
        asked = {"seed": seed, "seeds": seeds, "machine": machine}
        return stub_commands.Returned(SUMMARY | asked | {"episodes": episodes})

    return run


def raising(error: BaseException) -> Callable[..., stub_commands.Returned]:
    def action(progress: Progress) -> None:
        raise error

    return demo(action)


def test_json_is_alone_on_stdout(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def chatty(progress: Progress) -> None:
        print("a library talks")
        progress.say("working")

    stub_commands.install(monkeypatch, demo=demo(chatty))
    asked = ["--seed", "7", "--machine=cartpole", "--log-to=jsonl"]
    assert main(["demo", "--json", *asked]) == 0
    said = capsys.readouterr()
    summary = json.loads(said.out)
    assert (summary["seed"], summary["machine"]) == (7, "cartpole")
    assert (here / "runs" / "demo.jsonl").exists()
    assert summary["command_line"] == "sim2gp demo --json " + " ".join(asked)
    assert summary["parameters"] == SUMMARY["parameters"]
    assert "a library talks\nworking\nW110" in said.err


def test_tables_for_people(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub_commands.install(monkeypatch, demo=demo(lambda progress: None))
    assert main(["demo", "--quiet", "--verbose"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    rows = [[c for c in line.split() if c != "│"] for line in said.out.splitlines()]
    assert ["mass", "0.5", "0.01", "identified"] in rows
    assert ["oracle_return", "193.2"] in rows
    assert ["returns", "10", "150.5"] in rows
    assert ["noise.q1", "0.001"] in rows
    assert "W110" not in said.out


@pytest.mark.parametrize(
    ("error", "code", "start"),
    [
        (InputError("E101", "wrong"), 2, "E101 wrong"),
        (NotConverged("E201", "no fit"), 1, "E201 no fit"),
        (DiskError("E190", "full"), 74, "E190 full"),
        (OSError(28, "No space left on device"), 74, "E190 disk failure"),
        (PermissionError(13, "Permission denied", "x"), 2, "E130 output"),
        (RunOwned("E191", "owned"), 75, "E191 owned"),
        (KeyboardInterrupt(), 130, "interrupted"),
        (ZeroDivisionError("1/0"), 1, "E001 fault of sim2gp: got ZeroDivisionError"),
    ],
)
def test_exit_codes(
    error: BaseException,
    code: int,
    start: str,
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub_commands.install(monkeypatch, demo=raising(error))
    assert main(["demo"]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith(start)
    assert said.err.count("\n") == 1
    assert os.listdir(here) == []
    if code in (1, 2):
        assert main(["demo", "--debug"]) == code
        assert "Traceback" in capsys.readouterr().err


def test_failed_claims_are_not_a_success(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def selftest(*, seed: int, progress: Progress) -> stub_commands.Returned:
        return stub_commands.Returned({"passed": seed == 1})

    stub_commands.install(monkeypatch, selftest=selftest)
    assert main(["selftest", "--seed", "1", "--quiet"]) == 0
    assert main(["selftest", "--quiet"]) == 1


def test_our_warnings_are_one_line_each(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def careful(progress: Progress) -> None:
        warnings.warn("W200 take care", Sim2GPWarning, stacklevel=1)

    stub_commands.install(monkeypatch, demo=demo(careful))
    assert main(["demo"]) == 0
    assert capsys.readouterr().err.startswith("W200 take care\n")


def test_help_and_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    page = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert name in page
        assert main([name, "--help"]) == 0
        text = " ".join(capsys.readouterr().out.split())
        assert (command.__doc__ or "").split(".")[0].split(":")[0][:40] in text
        assert "--json" in text
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("sim2gp 0.")
    assert main([]) == 2  # nothing was asked for


def test_help_loads_no_simulator() -> None:
    code = (
        "import sys, time, sim2gp\nfrom sim2gp.cli import main\n"
        "before = set(sys.modules)\n"
        "assert main(['--help']) == 0 and main(['demo', '--sed', '1']) == 2\n"
        "new = {name.split('.')[0] for name in set(sys.modules) - before}\n"
        "assert not new & {'jax', 'scipy', 'equinox', 'matplotlib', 'mujoco'}, new\n"
    )
    done = subprocess.run([*START, code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_identify_of_a_small_project(
    here: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stub_commands.install(monkeypatch, identify=stub_commands.identify)
    t = 0.01 * np.arange(200)
    table = np.stack([t, np.sin(t), np.sin(t * t)], axis=1)
    np.savetxt("a.csv", table, delimiter=",", header="time,x,u", comments="")
    project = 'system = "cartpole"\n[[logs]]\nfiles = ["a.csv"]\n'
    project += '[logs.columns]\nx = "x"\nvoltage = "u"\n'
    Path("arm.toml").write_text(project)
    assert main(["identify", "arm.toml", "--json", "--quiet"]) == 0
    said = capsys.readouterr()
    assert json.loads(said.out)["n_transitions"] == 199
    assert said.err == ""
    stored = Path("runs", "arm", "summary.json").read_text()
    assert json.loads(stored) == json.loads(said.out)
    assert not json.loads(stored)["asked"]["check"]
    words = ["identify", "arm.toml", "--check", "--json", "--quiet", "--out", "two"]
    assert main(words) == 0
    said = json.loads(capsys.readouterr().out)["asked"]
    assert (said["check"], said["held_out"]) == (True, True)
    words = ["identify", "arm.toml", "--quick", "--nuts", "--json"]
    assert main([*words, "--quiet", "--out", "three"]) == 0
    said = json.loads(capsys.readouterr().out)["asked"]
    asked = [said[key] for key in ("held_out", "nuts", "check")]
    assert asked == [False, True, False]


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_into_a_closed_pipe(unbuffered: str, here: Path) -> None:
    with subprocess.Popen(
        [*START, CALL, "--help"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": unbuffered},
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert "Traceback" not in process.stderr.read()
    assert process.returncode == 0


@pytest.mark.parametrize(("sign", "code"), [("SIGINT", 130), ("SIGTERM", 143)])
def test_signals_clean_up(sign: str, code: int, here: Path) -> None:
    """A command that is stopped removes what it had begun to write."""
    script = (
        "import signal, sys, time\nfrom types import ModuleType\n"
        "from sim2gp.cli import main\n"
        # A shell that runs the tests in the background has it ignored.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def demo(*, progress, **options):\n"
        "    progress.say('ready')\n"
        "    time.sleep(60)\n"
        "name = 'sim2gp.commands.demo'\n"
        "sys.modules[name] = ModuleType(name)\n"
        "sys.modules[name].demo = demo\n"
        "raise SystemExit(main(['demo']))\n"
    )
    with subprocess.Popen([*START, script], stderr=subprocess.PIPE, text=True) as child:
        assert child.stderr is not None
        assert child.stderr.readline() == "ready\n"
        assert os.listdir(here) == ["runs"]
        child.send_signal(getattr(signal, sign))
        assert "interrupted" in child.stderr.read()
    assert child.returncode == code
    assert os.listdir(here) == []


@pytest.mark.parametrize(
    ("words", "code", "stream"),
    [(["--version"], 0, "stdout"), (["identify", "none.toml"], 2, "stderr")],
)
def test_the_process_ends_with_its_command(
    here: Path, words: list[str], code: int, stream: str
) -> None:
    """All that was said is said, the code is the command's, and nothing is waited for.

    A thread that never ends stands for those of XLA.
    """
    endless = (
        "import threading; threading.Thread(target=threading.Event().wait).start()"
    )
    done = subprocess.run(
        [*START, f"{endless}\n{ENTRY}", *words],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == code
    assert getattr(done, stream).strip()


def test_the_package_is_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    """``python -m sim2gp``, where no script is on the path."""
    assert main(["--version"]) == 0
    command = [sys.executable, "-m", "sim2gp", "--version"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (0, capsys.readouterr().out)
