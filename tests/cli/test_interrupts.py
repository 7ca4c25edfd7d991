"""SIGINT and SIGTERM end a command in seconds, whatever it does, and leave nothing."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim2gp.cli.interrupts import Terminated, interruptible
from sim2gp.runs import load_run
from simulated_logs import simulated
from tests.commands.test_identify import project_in, write

SECONDS = 5.0  # from the signal to the end of the process
CODES = {"SIGINT": 130, "SIGTERM": 143}
#: A demo that has begun to write its run, and then does one thing for a long time.
CHILD = """
import os, signal, sys, threading, time
from types import ModuleType
import jax, jax.numpy as jnp
from sim2gp.cli import entry
from sim2gp.runs import new_run
# A shell that runs the tests in the background has it ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
def endless():
    return jax.jit(lambda x: jax.lax.while_loop(lambda y: y < 2.0, jnp.sin, x))
def unrolled(x):
    for k in range(2000):  # half a minute of XLA
        x = jnp.sin(x + k) @ jnp.cos(x.T)
    return x
def ready():
    print(os.getpid(), "ready", file=sys.stderr, flush=True)
{work}
def demo(*, progress, **options):
    work()
if __name__ == "__main__":
    name = "sim2gp.commands.demo"
    sys.modules[name] = ModuleType(name)
    sys.modules[name].demo = demo
    sys.argv = ["sim2gp", "demo"]
    entry()
"""
RUNS = """
def work():
    program = endless().lower(1.0).compile()
    ready()
    program(1.0).block_until_ready()
"""
COMPILES = """
def work():
    lowered = jax.jit(unrolled).lower(jnp.ones((3, 3)))
    ready()
    lowered.compile()
"""
COMPILES_AHEAD = """
def work():
    from sim2gp.compilation import _COMPILER
    lowered = jax.jit(unrolled).lower(jnp.ones((3, 3)))
    future = _COMPILER.submit(lowered.compile)
    ready()
    future.result()
"""
IN_A_THREAD = """
def work():
    program = endless().lower(1.0).compile()
    threading.Thread(target=program, args=(1.0,)).start()
    ready()
    time.sleep(600.0)
"""
SWALLOWS = """
def work():
    ready()
    while True:
        try:
            time.sleep(600.0)
        except KeyboardInterrupt:
            pass
"""
EVERYTHING = """
import subprocess
from sim2gp import cleanup
def job(number):
    if number:
        endless()(1.0).block_until_ready()
    return number
def work():
    from sim2gp.runs.executors import Processes
    program = endless().lower(1.0).compile()
    asleep = [sys.executable, "-c", "import time; time.sleep(600)"]
    with cleanup.temporary_folder(), subprocess.Popen(asleep) as other:
        with cleanup.registered(other.kill):
            try:
                for _ in Processes(2).spread(job, [[0, 1], [2]]):
                    ready()
                    program(1.0).block_until_ready()
            finally:
                other.kill()
"""
PATIENT = (
    """
from sim2gp.cli import interrupts
interrupts.GRACE = 600.0
"""
    + SWALLOWS
)
BUSY = {
    "runs": RUNS,
    "compiles": COMPILES,
    "compiles ahead": COMPILES_AHEAD,
    "in a thread": IN_A_THREAD,
    "swallows": SWALLOWS,
}


def descendants(number: int) -> set[int]:
    """Every process below this one; empty where the system does not list them."""
    children: set[int] = set()
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{number}/task").iterdir():
            children |= set(map(int, (task / "children").read_text().split()))
    return children.union(*map(descendants, children))


def alive(number: int) -> bool:
    """Whether it runs; who is dead and waits to be asked for does not."""
    try:
        return Path(f"/proc/{number}/stat").read_text().split(") ")[1][0] != "Z"
    except OSError:
        return False


def none_is_left(numbers: set[int], seconds: float = 2.0) -> bool:
    end = time.monotonic() + seconds
    while any(map(alive, numbers)) and time.monotonic() < end:
        time.sleep(0.05)
    return not any(map(alive, numbers))


@contextlib.contextmanager
def started(folder: Path, command: list[str]) -> Iterator[subprocess.Popen[str]]:
    """A process with a folder to work in, and one for what is temporary."""
    for name in ("work", "temporary"):
        (folder / name).mkdir()
    environment = os.environ | {"TMPDIR": str(folder / "temporary")}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1"}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    child = subprocess.Popen(
        [sys.executable, *command],
        cwd=folder / "work",
        env=environment,
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        # As a shell starts it: another group, which a signal to the child does not get.
        start_new_session=True,
    )
    limit = threading.Timer(200.0, child.kill)
    limit.start()
    with child:
        try:
            yield child
        finally:
            limit.cancel()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)


def stopped(
    child: subprocess.Popen[str], sign: str, again: float | None = None
) -> tuple[float, set[int], str]:
    """Send the signal (twice): seconds to the end, processes below it, and words."""
    below = descendants(child.pid)
    sent = time.monotonic()
    child.send_signal(getattr(signal, sign))
    if again is not None:
        time.sleep(again)
        child.send_signal(getattr(signal, sign))
    try:
        child.wait(60.0)
    except subprocess.TimeoutExpired:
        pytest.fail(f"still there a minute after {sign}")
    seconds = time.monotonic() - sent
    # Who is left holds the pipe open: reading it would last as long as that does.
    assert none_is_left(below)
    assert child.stderr is not None
    return seconds, below, child.stderr.read()


def everything_in(folder: Path) -> list[str]:
    return sorted(str(p.relative_to(folder)) for p in folder.rglob("*"))


def until_ready(child: subprocess.Popen[str]) -> None:
    assert child.stderr is not None
    for line in child.stderr:
        if line.endswith("ready\n"):
            return
    pytest.fail("the child ended by itself")


CASES = [(busy, "SIGTERM") for busy in BUSY] + [("runs", "SIGINT")]


@pytest.mark.parametrize(("busy", "sign"), CASES)
def test_a_signal_ends_a_busy_command_in_seconds(
    busy: str, sign: str, tmp_path: Path
) -> None:
    """While XLA runs or compiles, Python's own handlers wait; this must not."""
    with started(tmp_path, ["-c", CHILD.format(work=BUSY[busy])]) as child:
        until_ready(child)
        assert everything_in(tmp_path / "work")
        time.sleep(0.3)  # into the compiled code
        seconds, _, said = stopped(child, sign)
        assert child.returncode == CODES[sign]
    assert seconds < SECONDS
    assert everything_in(tmp_path) == ["temporary", "work"]
    assert said.splitlines() == ["interrupted; nothing half-written is left"]


def test_a_second_signal_ends_it_at_once(tmp_path: Path) -> None:
    with started(tmp_path, ["-c", CHILD.format(work=PATIENT)]) as child:
        until_ready(child)
        seconds, _, _ = stopped(child, "SIGTERM", again=0.5)
        assert child.returncode == 143
    assert 0.5 < seconds < 2.5
    assert everything_in(tmp_path) == ["temporary", "work"]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no list of processes")
def test_workers_children_and_temporary_folders_go_too(tmp_path: Path) -> None:
    """Workers in compiled code, a child process, and a main thread that cannot act."""
    script = tmp_path / "study.py"  # what workers are to import has a file
    script.write_text(CHILD.format(work=EVERYTHING))
    with started(tmp_path, [str(script)]) as child:
        until_ready(child)
        assert everything_in(tmp_path / "temporary")
        seconds, below, _ = stopped(child, "SIGTERM")
        assert child.returncode == 143
        assert len(below) >= 3
    assert seconds < SECONDS
    assert everything_in(tmp_path) == ["study.py", "temporary", "work"]


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="no terminals")
def test_the_terminal_gets_its_cursor_back(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    in_a_bar = RUNS.replace("def work", "def within") + (
        "def work():\n"
        "    from sim2gp.runs import Progress\n"
        "    with Progress().task('demo', 2):\n"
        "        within()\n"
    )
    shown = b""
    command = ["-c", CHILD.format(work=in_a_bar)]
    environment = os.environ | {"TERM": "xterm"}
    with subprocess.Popen(
        [sys.executable, *command], cwd=tmp_path, env=environment, stderr=theirs
    ) as child:
        os.close(theirs)
        with contextlib.suppress(OSError):  # the end of a terminal is an error
            while more := os.read(ours, 1000):
                if b"ready" in more:
                    child.send_signal(signal.SIGTERM)
                shown += more
        assert child.wait(30.0) == 143
    os.close(ours)
    assert b"\x1b[?25l" in shown  # hidden
    assert b"\x1b[?25h" in shown.split(b"\x1b[?25l")[-1]  # and back


def test_a_caller_keeps_its_own_handlers() -> None:
    """Who calls `main` with arguments owns the process and its signals."""

    def mine(number: int, frame: object) -> None:
        raise AssertionError

    before = signal.getsignal(signal.SIGINT), signal.signal(signal.SIGTERM, mine)
    try:
        with interruptible(entry=False):
            assert signal.getsignal(signal.SIGINT) is before[0]
            assert signal.getsignal(signal.SIGTERM) is mine
            assert signal.set_wakeup_fd(-1) == -1
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        with interruptible(entry=True):
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
        assert signal.set_wakeup_fd(-1) == -1
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        with pytest.raises(Terminated), interruptible(entry=False):
            os.kill(os.getpid(), signal.SIGTERM)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        signal.signal(signal.SIGTERM, before[1])


@pytest.mark.parametrize("late", [False, True])
def test_an_end_within_a_commit_leaves_all_or_nothing(
    late: bool, tmp_path: Path
) -> None:
    """Before the rename everything goes; once it has begun, the run stays whole."""
    code = (
        "import os, sys, threading, time\n"
        "from sim2gp import cleanup\n"
        "from sim2gp.runs import new_run, store\n"
        "def end():\n"
        "    cleanup.run(20.0)\n"
        "    os._exit(9)\n"
        "def begin_to_end():\n"
        "    threading.Thread(target=end).start()\n"
        "    time.sleep(0.3)\n"
        "rename = os.rename\n"
        "def slow(*names):\n"
        "    begin_to_end()\n"
        "    rename(*names)\n"
        f"late = {late}\n"
        "os.rename = slow if late else rename\n"
        "with new_run(sys.argv[1], 'test') as run:\n"
        "    run.write_summary({'value': 1})\n"
        "    late or begin_to_end()\n"
        "time.sleep(60.0)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "b" / "a")]
    assert subprocess.run(command, check=False).returncode == 9
    assert everything_in(tmp_path)[:2] == (["b", "b/a"] if late else [])
    if late:
        assert load_run(tmp_path / "b" / "a").summary == {"value": 1}


@pytest.mark.nightly
@pytest.mark.parametrize("command", ["identify", "demo"])
def test_random_times_of_real_commands(command: str, tmp_path: Path) -> None:
    """Twenty moments of one whole command: imports, compilations, fits, the report."""
    words = ["demo", "--episodes", "1"]
    if command == "identify":
        words = ["identify", str(tmp_path / "machine.toml"), "--quick"]
        for seed in (1, 2):
            log = simulated(seconds=1.3, seed=seed, noise=5e-4)
            write(log, tmp_path / "logs" / f"{seed}.csv")
        project_in(tmp_path)
    call = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sim2gp.cli import entry; entry()"
    )
    arguments = ["-c", call, *words]
    (tmp_path / "whole").mkdir()
    begun = time.monotonic()
    with started(tmp_path / "whole", arguments) as child:
        child.communicate()
        assert child.returncode == 0
    whole = time.monotonic() - begun
    took, attempts, rng = [], 0, random.Random(0)
    while len(took) < 20 and attempts < 60:
        folder = tmp_path / str(attempts)
        folder.mkdir()
        sign = ("SIGTERM", "SIGINT")[attempts % 2]
        attempts, begun = attempts + 1, time.monotonic()
        with started(folder, arguments) as child:
            try:
                child.wait(rng.uniform(0.0, 0.95) * whole)
            except subprocess.TimeoutExpired:
                seconds, below, said = stopped(child, sign)
            if child.returncode == 0:  # it was done, on a machine that is less busy now
                whole = min(whole, time.monotonic() - begun)
                continue
            took.append(seconds)
            # Before the command has begun, Python ends by the signal itself.
            codes = {CODES[sign]}
            if "interrupted" not in said:
                codes.add(-getattr(signal, sign))
            assert child.returncode in codes, said
            assert none_is_left(below)
            assert everything_in(folder) == ["temporary", "work"]
    words_of_all = " ".join(f"{seconds:.2f}" for seconds in sorted(took))
    print(f"{command}: 20 of {attempts} stopped within a whole of {whole:.0f} s")
    print(f"seconds to the end: {words_of_all}")
    assert len(took) == 20
    assert max(took) < SECONDS
