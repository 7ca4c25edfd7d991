"""How much a recording may unpack to, and how long reading it may take.

Every reader spends from one `Meter` for each file or folder: before it unpacks (what
the file declares) and while it unpacks (what really comes out). No single piece, such
as a chunk, is unpacked that is a large part of the whole budget.
"""

import ctypes
import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from jaxtyping import TypeCheckError

from sim2gp.errors import InputError, Sim2GPError, error

PIECES = 32  # one piece may take this share of the bytes
GRACE = 1.0  # s: a reader looks at the clock itself; then its thread is interrupted


@dataclass(frozen=True)
class Budget:
    """Bytes that one file or folder may unpack to, and seconds that reading may take.

    Raises `InputError` E148 unless both are positive.
    """

    bytes: int = 2 * 1024**3
    seconds: float = 60.0

    def __post_init__(self) -> None:
        if not (self.bytes > 0 and 0 < self.seconds < math.inf):
            raise error(
                "budget_not_positive", got=f"{self.bytes} bytes and {self.seconds:g} s"
            )

    def times(self, factor: float) -> "Budget":
        """Both, multiplied by a number (E148 unless it is positive and finite)."""
        if not 0 < factor < math.inf:
            raise error("budget_factor_not_positive", got=f"{factor:g}")
        return Budget(math.ceil(self.bytes * factor), self.seconds * factor)


@dataclass
class Meter:
    """What reading one recording has used of its budget; ``where`` is its name."""

    where: str
    budget: Budget = field(default_factory=Budget)
    used: int = 0
    place: str = ""  # what is read just now, for the message of a parser's error
    started: float = field(default_factory=time.monotonic)

    @property
    def at(self) -> str:
        """The recording, and what of it is read just now."""
        return f"{self.where}:{self.place}" if self.place else self.where

    @property
    def limit(self) -> int:
        """Bytes that one piece may unpack to."""
        return self.budget.bytes // PIECES

    def again(self) -> "Meter":
        """The clock goes on; what was unpacked was thrown away and is not counted."""
        return Meter(self.where, self.budget, started=self.started)

    def tick(self) -> None:
        """Raise E126 if reading has taken too long."""
        if time.monotonic() - self.started > self.budget.seconds:
            raise self.over_time()

    def over_time(self) -> InputError:
        """E126: the seconds are over."""
        return self.over(
            "takes too long to read",
            f"{time.monotonic() - self.started:.1f} s",
            f"at most {self.budget.seconds:g} s",
        )

    def claim(self, count: int, what: str = "numbers") -> None:
        """Raise E126 if so many bytes more do not fit; they are not spent yet."""
        self.tick()
        total = self.used + count
        if total > self.budget.bytes:
            raise self.over(
                f"too many {what}",
                f"{total} bytes",
                f"at most {self.budget.bytes} bytes",
            )

    def spend(self, count: int, what: str = "numbers") -> None:
        """Count bytes that were unpacked, or are about to be (E126)."""
        self.claim(count, what)
        self.used += count

    def piece(self, count: int, what: str) -> None:
        """Raise E126 for one piece that needs too large a part of the budget."""
        self.tick()
        if count > self.limit:
            raise self.over(
                f"{what} too large",
                f"{count} bytes in one piece",
                f"at most {self.limit} bytes",
            )

    def measure(self, pieces: Iterator[bytes], declared: int, what: str) -> None:
        """Unpack one piece and throw it away: it is no larger than it declares.

        Libraries unpack a chunk as a whole, even beyond its declared size. They may do
        so afterwards.
        """
        self.piece(declared, what)
        self.claim(declared, what)
        count = 0
        for part in pieces:
            count += len(part)
            self.tick()
            if count > declared:
                raise self.over(
                    f"{what} larger than declared",
                    f"more than {declared} bytes",
                    f"{declared} bytes",
                )
        self.spend(count, what)

    def over(self, what: str, got: str, expected: str) -> InputError:
        """E126: more than the budget."""
        return error(
            "beyond_the_budget", where=self.at, got=got, what=what, expected=expected
        )


class _OutOfTime(BaseException):
    """Interrupts a library that does not return; nothing that it catches."""


@contextmanager
def readable(meter: Meter) -> Iterator[None]:
    """Any error of a parser inside becomes E125: the file is cut off or damaged.

    Parsers of other projects raise anything on bytes that they did not expect, and may
    loop: after the budget's seconds the thread is interrupted (E126). Errors of ours
    and interrupts of the user pass through.
    """
    watch = _TimeWatch(meter)
    try:
        try:
            yield
        finally:
            watch.stop()
    except (Sim2GPError, TypeCheckError):
        raise
    except _OutOfTime:
        watch.stop()  # the interrupt may have come before the first call ended
        raise meter.over_time() from None
    except MemoryError as caught:
        raise meter.over("does not fit in memory", "no more", "less") from caught
    except Exception as caught:
        if watch.asked:
            raise meter.over_time() from caught
        text = " ".join(str(caught).split())
        raise error(
            "file_incomplete_or_damaged",
            where=meter.at,
            got=(text or type(caught).__name__)[:120].rstrip("."),
        ) from caught


class _TimeWatch:
    """Raises `_OutOfTime` in the thread that made it when the seconds are over.

    A second thread asks the interpreter to do so, which works wherever Python code runs
    in the first. Compiled code is given small pieces only.
    """

    def __init__(self, meter: Meter) -> None:
        self.asked = False
        self._reader, self._done = threading.get_ident(), threading.Event()
        self._end = meter.started + meter.budget.seconds + GRACE
        self._thread = threading.Thread(target=self._run, name="budget", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End it; an interrupt that has not arrived yet never does."""
        self._done.set()
        self._thread.join()
        if self.asked:
            _interrupt(self._reader, None)

    def _run(self) -> None:
        while not self._done.wait(max(self._end - time.monotonic(), 0.0)):
            self.asked = True
            _interrupt(self._reader, _OutOfTime)
            self._end += GRACE  # a callback of a library may have lost the first


def _interrupt(thread: int, kind: type[BaseException] | None) -> None:
    what = ctypes.py_object() if kind is None else ctypes.py_object(kind)
    ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), what)
