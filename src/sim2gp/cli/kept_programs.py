"""Compiled programs are kept from one command to the next, in a folder of the user's.

JAX reads where from its environment, so this comes before JAX is imported. A folder
serves one kind of processor: a program of another may have instructions that this one
does not have.
"""

import hashlib
import os
import platform
import stat
import sys
from collections.abc import MutableMapping
from pathlib import Path

MOST = 2**30  # bytes; the programs that were not used for longest go first
SECONDS = 0.2  # that a program took to compile, at least
#: Lines of Linux's list of processors that say which instructions one has.
TELLS = "model name", "flags", "Features", "CPU part"
FOLDER, SIZE = "JAX_COMPILATION_CACHE_DIR", "JAX_COMPILATION_CACHE_MAX_SIZE"
LEAST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def keep_programs(environment: MutableMapping[str, str]) -> None:
    """Let JAX keep them, if it is not imported yet and nobody has decided otherwise.

    Nothing is kept where the folder is not private or cannot be written, and on systems
    where JAX's loader is not reliable: it has crashed on macOS.
    """
    if sys.platform != "linux" or "jax" in sys.modules or FOLDER in environment:
        return
    home = environment.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(home) / "sim2gp" / "programs" / _processor()
    if not _is_private(folder):
        return
    environment[FOLDER] = str(folder)
    environment.setdefault(SIZE, str(MOST))
    environment.setdefault(LEAST, str(SECONDS))
    # A program that is refused is compiled again; the loader says so in long lines.
    environment.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")


def _processor() -> str:
    """A short name of the processor's model and instructions."""
    found = [platform.machine()]
    try:
        first, *_ = Path("/proc/cpuinfo").read_text(errors="replace").split("\n\n")
        found += [line for line in first.splitlines() if line.startswith(TELLS)]
    except OSError:
        found.append(platform.node())
    return hashlib.sha256("\n".join(found).encode()).hexdigest()[:12]


def _is_private(folder: Path) -> bool:
    """Whether it is there, and nobody else may write it: programs are run."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        about = folder.stat()
    except OSError:
        return False
    others = stat.S_IWGRP | stat.S_IWOTH
    mine = about.st_uid == os.getuid() and not about.st_mode & others
    return mine and os.access(folder, os.W_OK)
