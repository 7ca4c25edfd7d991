"""SIGINT and SIGTERM end a command in seconds, whatever it does, and leave nothing."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

SECONDS = 5.0  # from the signal to the end of the process
CODES = {"SIGINT": 130, "SIGTERM": 143}
#: A demo that has begun to write its run, and then does one thing for a long time.
CHILD = """
import os, signal, sys, threading, time
from types import ModuleType
import jax, jax.numpy as jnp
from sim2gp.cli import main
from sim2gp.runs import new_run
# A shell that runs the tests in the background has it ignored.
signal.signal(signal.SIGINT, signal.default_int_handler)
def endless():
    return jax.jit(lambda x: jax.lax.while_loop(lambda y: y < 2.0, jnp.sin, x))
def unrolled(x):
    for k in range(3000):  # a minute of XLA
        x = jnp.sin(x + k) @ jnp.cos(x.T)
    return x
def ready():
    print(os.getpid(), "ready", file=sys.stderr, flush=True)
{work}
def run(*, out, progress, **options):
    with new_run(out, "demo") as run:
        run.write_text("half", "x")
        work()
if __name__ == "__main__":
    for name in ("sim2gp.experiments", "sim2gp.experiments.demo"):
        sys.modules[name] = ModuleType(name)
    sys.modules[name].run = run
    sys.argv = ["sim2gp", "demo"]
    raise SystemExit(main())
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
    from sim2gp.ahead import _COMPILER
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
WORKERS = """
def job(number):
    if number:
        endless()(1.0).block_until_ready()
    return number
def work():
    from sim2gp.runs.workers import spread
    program = endless().lower(1.0).compile()
    for _ in spread(job, [[0, 1], [2]], 2):
        ready()
        program(1.0).block_until_ready()
"""
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


@pytest.mark.parametrize("sign", CODES)
@pytest.mark.parametrize("busy", BUSY)
def test_a_signal_ends_a_busy_command_in_seconds(
    busy: str, sign: str, tmp_path: Path
) -> None:
    """While XLA runs or compiles, Python's own handlers wait; this must not."""
    if sign == "SIGINT" and busy in ("compiles ahead", "in a thread"):
        pytest.skip("as with SIGTERM")
    with started(tmp_path, ["-c", CHILD.format(work=BUSY[busy])]) as child:
        until_ready(child)
        assert everything_in(tmp_path / "work")
        time.sleep(0.3)  # into the compiled code
        seconds, _, said = stopped(child, sign)
        assert child.returncode == CODES[sign]
    assert seconds < SECONDS
    assert everything_in(tmp_path) == ["temporary", "work"]
    assert said.splitlines() == ["interrupted; nothing half-written is left"]
