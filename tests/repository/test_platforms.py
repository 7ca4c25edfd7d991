"""What Windows and macOS lack is taken away, and the command line still works."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from simulated_logs import simulated
from tests.commands.test_identify import project_in, write

#: Runs before anything else in every process that Python starts (not with -I).
ELSEWHERE = """
import errno, os, signal, sys, warnings

class Without:
    names = {"fcntl", "resource", "termios", "pwd", "grp", "pty", "tty", "readline"}
    def find_spec(self, name, path=None, target=None):
        if name in self.names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Without())
for name in Without.names:
    sys.modules.pop(name, None)
for name in (
    "fork forkpty register_at_fork getuid geteuid getgid getegid getpgid getsid killpg "
    "setsid chown lchown fchmod mkfifo sysconf statvfs pread openpty nice getloadavg "
    "sched_getaffinity sched_setaffinity sched_yield O_DIRECTORY O_NOFOLLOW O_CLOEXEC"
).split():
    if hasattr(os, name):
        delattr(os, name)
for name in "SIGKILL SIGHUP SIGUSR1 SIGALRM SIGCHLD pthread_sigmask setitimer".split():
    delattr(signal, name)

opened, rename = os.open, os.rename
def open_file(path, *args, **kwargs):
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    return opened(path, *args, **kwargs)
def rename_to_nothing(old, new, **kwargs):
    if os.path.lexists(new):
        raise FileExistsError(errno.EEXIST, "File exists", str(new))
    rename(old, new, **kwargs)
os.open, os.rename = open_file, rename_to_nothing

# Text in whatever encoding the machine prefers: other files on every machine.
warnings.filterwarnings("error", category=EncodingWarning, module=r"sim2gp\\b")
"""
#: Every module is imported; then the commands, identify with a stand-in for the fit.
COMMANDS = """
import importlib, sys
from pathlib import Path
import pytest
import report_example, stub_commands
import sim2gp
from sim2gp.cli import main
from sim2gp.runs import load_run, new_run
from sim2gp.runs.cells import Cells

try:
    import fcntl
    raise SystemExit("fcntl is there")
except ImportError:
    pass
folder = Path(sim2gp.__file__).parent
for path in sorted(folder.rglob("*.py")):
    parts = path.relative_to(folder.parent).with_suffix("").parts
    importlib.import_module(".".join(p for p in parts if p != "__init__"))
assert main(["--help"]) == 0
stub_commands.install(pytest.MonkeyPatch(), identify=stub_commands.identify)
for _ in range(2):
    assert main(["identify", "arm.toml", "--out", "run"]) == 0
assert load_run("run").summary["n_transitions"] == 199
summary, arrays = report_example.full_run()
Path("made").mkdir()
with new_run("made", "identify") as run:
    run.write_summary(summary)
    run.write_arrays("arrays.npz", arrays)
assert main(["report", "made"]) == 0
Cells(Path("study"), "").save("a", {"unit": "\u00b5m"}, {"value": 1.0})
assert Cells(Path("study"), "").load("a", {"unit": "\u00b5m"}) == {"value": 1.0}
assert Path("made", "report.html").stat().st_size > 10_000
"""


def elsewhere(folder: Path, command: list[str]) -> subprocess.CompletedProcess[str]:
    """Run Python in a folder, as on a machine that lacks what POSIX has."""
    site = folder / "site"
    site.mkdir(exist_ok=True)
    (site / "sitecustomize.py").write_text(ELSEWHERE)
    paths = [
        str(site),
        str(Path(__file__).parents[1]),
        os.environ.get("PYTHONPATH", ""),
    ]
    return subprocess.run(
        [sys.executable, *command],
        cwd=folder,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONWARNDEFAULTENCODING": "1"},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


def test_the_command_line_needs_nothing_of_posix(tmp_path: Path) -> None:
    t = 0.01 * np.arange(200)
    table = np.stack([t, np.sin(t), np.sin(t * t)], axis=1)
    path = tmp_path / "a.csv"
    np.savetxt(path, table, delimiter=",", header="time,x,u", comments="")
    project = 'system = "cartpole"\n[[logs]]\nfiles = ["a.csv"]\n'
    project += '[logs.columns]\nx = "x"\nvoltage = "u"\n'
    (tmp_path / "arm.toml").write_text(project)
    done = elsewhere(tmp_path, ["-c", COMMANDS])
    assert done.returncode == 0, done.stderr
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"a.csv", "arm.toml", "site", "run", "made", "study.cells"}


@pytest.mark.nightly
def test_an_identification_needs_nothing_of_posix(tmp_path: Path) -> None:
    """The whole way, with the fit and the report."""
    for seed in (1, 2):
        log = simulated(seconds=1.3, seed=seed, noise=5e-4)
        write(log, tmp_path / "logs" / f"{seed}.csv")
    project_in(tmp_path)
    call = "from sim2gp.cli import entry; entry()"
    for words in (["identify", "machine.toml", "--quick"], ["report", "runs/machine"]):
        done = elsewhere(tmp_path, ["-c", call, *words])
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "runs" / "machine" / "report.html").exists()
    assert os.listdir(tmp_path / "runs") == ["machine"]
