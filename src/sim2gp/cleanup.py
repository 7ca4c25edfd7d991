"""What must not be left behind, however the process ends.

A block that leaves something on the disk or a process running while it is at work
registers how to remove that. Normally the block removes it itself, when it ends or
raises. A process that has to end while its main thread is inside compiled code cannot
unwind its blocks: then `run` removes everything that is registered at that moment.
"""

import os
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

#: Held by `run` until the process is gone: a later caller waits for that.
_LOCK = threading.RLock()
_ACTIONS: dict[object, Callable[[], object]] = {}


@contextmanager
def registered(action: Callable[[], object]) -> Iterator[None]:
    """Have ``action`` called if the process is ended while the block runs.

    It is called from another thread, and must do no harm where the block has already
    cleaned up after itself.
    """
    key = object()
    with _LOCK:
        _ACTIONS[key] = action
    try:
        yield
    finally:
        with _LOCK:
            del _ACTIONS[key]


@contextmanager
def undisturbed() -> Iterator[None]:
    """While the block runs, nothing that is registered is removed under its hands."""
    with _LOCK:
        yield


def run(seconds: float) -> bool:
    """Call all that is registered, side by side; whether that was done in time.

    Only for a process that ends right afterwards: blocks that would end, and blocks
    that are `undisturbed`, wait from now on.
    """
    end = time.monotonic() + seconds
    if not _LOCK.acquire(timeout=seconds):
        return False
    # One that hangs, say on a dead disk, does not hold up the others.
    threads = [threading.Thread(target=a, daemon=True) for a in _ACTIONS.values()]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, end - time.monotonic()))
    return not any(thread.is_alive() for thread in threads)


@contextmanager
def temporary_folder() -> Iterator[str]:
    """A new empty folder, removed with all that is in it when the block ends."""
    folder = tempfile.mkdtemp(prefix="sim2gp-")

    def remove() -> None:
        shutil.rmtree(folder, ignore_errors=True)

    with registered(remove):
        try:
            yield folder
        finally:
            remove()


def replace_file(
    path: Path, data: bytes, check: Callable[[Path], object] = lambda aside: None
) -> None:
    """Write ``data`` next to ``path``, and put it in place once ``check`` has passed.

    A reader sees the old file or the new one, never half of one. Raises what ``check``
    raises, and OSError; the old file is then as it was.
    """
    handle, name = tempfile.mkstemp(
        dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix
    )
    aside = Path(name)
    with registered(lambda: aside.unlink(missing_ok=True)):
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            check(aside)
            mode = path.stat().st_mode & 0o777 if path.exists() else 0o666 & ~_umask()
            os.chmod(aside, mode)
            os.replace(aside, path)
        finally:
            aside.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
