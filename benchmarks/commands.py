"""Whole commands of this Python: how long they take, and how much memory."""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

LIMIT = 1200.0  # s, of one command
MAIN = ["-c", "from sim2gp.cli import entry; entry()"]


def timed(
    folder: Path,
    args: list[str],
    *,
    cache: str | None = None,
    one_core: bool = False,
    watched: Path | None = None,
) -> dict[str, float]:
    """Seconds by the clock and of the processor, and the largest memory in MiB.

    ``args`` are Python's, the command runs in ``folder``. ``cache`` keeps what JAX
    compiles; without one it compiles again. ``first`` are the seconds until the file
    ``watched`` was there. A command that fails, or takes longer than `LIMIT`, ends the
    benchmark with what it said.
    """
    env = dict(os.environ, OPENBLAS_NUM_THREADS="1", MUJOCO_GL="disable")
    env["JAX_COMPILATION_CACHE_DIR"] = cache or ""
    env["JAX_ENABLE_COMPILATION_CACHE"] = "true" if cache else "false"
    env["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    pinned = one_core and hasattr(os, "sched_setaffinity")
    command = [*(["taskset", "-c", "0"] if pinned else []), sys.executable, *args]
    with tempfile.TemporaryFile("w+") as said:
        started, out, done = time.perf_counter(), {}, 0
        child = subprocess.Popen(
            command, cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=said
        )
        while not done:
            time.sleep(0.01)
            done, status, usage = os.wait4(child.pid, os.WNOHANG)
            seconds = time.perf_counter() - started
            if watched is not None and "first" not in out and watched.exists():
                out["first"] = round(seconds, 2)
            if not done and seconds > LIMIT:
                child.kill()
        if status:
            said.seek(0)
            raise SystemExit(f"{' '.join(command)}\n{said.read()}")
    out |= {"wall": round(seconds, 2), "cpu": round(usage.ru_utime + usage.ru_stime, 2)}
    return out | {"memory": round(usage.ru_maxrss / 1024)}
