"""SIGINT and SIGTERM end a command within seconds, in compiled code as well.

Python runs signal handlers in the main thread and between two instructions: while that
thread is in compiled code, or XLA compiles for it, they wait for minutes or for ever.
So a second thread reads what the interpreter's own handler writes at once
(`signal.set_wakeup_fd`). At the first signal the main thread gets `GRACE` seconds to
unwind by the exception that the handler raises there; then, or at the second signal,
the thread cleans up by `sim2gp.cleanup` and ends the process.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from sim2gp import cleanup

GRACE = 2.0  # s for the main thread to unwind by itself
CLEANUP = 1.5  # s for the rest; all in all less than 5 s
AT_ONCE = 0.5  # s for the rest after a second signal
DONE = "interrupted; nothing half-written is left"
NOT_DONE = "interrupted; the next run removes what is half-written"
_WATCHED = (signal.SIGINT, signal.SIGTERM)
_STOP = 0  # no signal has this number


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived; cleaned up after like an interrupt."""


class Signals:
    """Which signal has arrived, if any; the exit code that it gives."""

    def __init__(self) -> None:
        self.number: int | None = None
        self._armed = True

    @property
    def exit_code(self) -> int:
        """128 and the signal's number, as shells have it; SIGINT's if there is none."""
        return 128 + (self.number or signal.SIGINT)

    def handle(self, number: int, frame: Any) -> None:
        """The handler: raises in the main thread once, for twice disturbs clean-up."""
        if self.number is not None:
            return
        self.number = number
        if self._armed:
            raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    def disarm(self) -> None:
        """From here on a signal is noted, and nothing is raised."""
        self._armed = False


@contextmanager
def interruptible(*, entry: bool) -> Iterator[Signals]:
    """Signals end the block by an exception; the process, too, if the block is late.

    ``entry`` says that the process is this command's own. Without it, or outside the
    main thread, the process is the caller's: then it is never ended, and SIGINT stays
    as the caller has it. A signal that is ignored stays so, and a handler of the
    caller's own.
    """
    signals = Signals()
    if threading.current_thread() is not threading.main_thread():
        yield signals
        return
    ours = (signal.SIG_DFL, signal.default_int_handler)
    taken = [s for s in _WATCHED if entry or s != signal.SIGINT]
    before = {s: signal.getsignal(s) for s in taken if signal.getsignal(s) in ours}
    for number in before:
        signal.signal(number, signals.handle)
    watch = _SignalWatch() if entry else None
    try:
        yield signals
    finally:
        signals.disarm()
        if watch is not None and signals.number is not None:
            leave(signals.exit_code)
        if watch is not None:
            watch.stop()
        for number, handler in before.items():
            signal.signal(number, handler)


class _SignalWatch:
    """The thread that ends the process where the main thread does not in time."""

    def __init__(self) -> None:
        # A socket, not a pipe: Windows can wait for no other descriptor.
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        number = self._write.fileno()
        self._before = signal.set_wakeup_fd(number, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch, name="signals", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """The command is done: signals are no longer watched."""
        signal.set_wakeup_fd(self._before)
        self._write.send(bytes([_STOP]))
        self._thread.join()
        self._write.close()
        self._read.close()

    def _watch(self) -> None:
        first = self._next(None)
        if first == _STOP or first is None:
            return
        second = self._next(GRACE)
        if second == _STOP:
            return
        done = cleanup.run(CLEANUP if second is None else AT_ONCE)
        # Not by `sys.stderr`: the main thread may hold its lock.
        with suppress(OSError):
            os.write(2, f"{DONE if done else NOT_DONE}\n".encode())
        _end_process(128 + first)

    def _next(self, seconds: float | None) -> int | None:
        """The next signal's number, or `_STOP`; None where none comes in time."""
        end = None if seconds is None else time.monotonic() + seconds
        while True:
            self._read.settimeout(end and max(1e-3, end - time.monotonic()))
            try:
                number = self._read.recv(1)[0]
            except TimeoutError:
                return None
            if number == _STOP or number in _WATCHED:
                return number


def leave(code: int) -> NoReturn:
    """End the process from its main thread, with all that was printed.

    The interpreter's own end waits for XLA's threads, and takes what is loaded apart
    piece by piece: a quarter of a second.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    _end_process(code)


def _end_process(code: int) -> NoReturn:
    """End the process at once; any thread may call this.

    Nothing milder does: `sys.exit` ends the thread alone, and the interpreter joins
    threads and frees XLA's before it ends, which takes as long as they run.
    """
    os._exit(code)
