"""Progress for people: a bar on a terminal or in a notebook, plain lines elsewhere.

Nothing is shown when quiet. Everything goes to the error stream, so that ``--json``
leaves stdout to the summary.
"""

import html
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

from sim2gp import cleanup

T = TypeVar("T")


@dataclass
class Task:
    """One job under way: ``advance`` after each part of it."""

    label: str
    total: int
    show: Callable[["Task", str], None]
    alike: bool = True  # its parts; of stages none says how long the next takes
    done: int = 0
    stored: int = 0  # parts that an earlier run has done
    started: float = field(default_factory=time.monotonic)
    moved: float = field(default_factory=time.monotonic)  # when `done` last changed

    def advance(self, note: str = "", count: int = 1) -> None:
        """``count`` more parts are finished; ``note`` is shown next to them."""
        if count:
            self.done, self.moved = self.done + count, time.monotonic()
        self.show(self, note)

    def skip(self, count: int) -> None:
        """``count`` parts were done before: they say nothing of the pace."""
        if count:
            self.done, self.stored = self.done + count, self.stored + count
            self.show(self, "of an earlier run")

    def left(self) -> str:
        """How long the rest takes at the pace of what is done; nothing of stages."""
        done, total = self.done - self.stored, self.total - self.stored
        since = time.monotonic() - self.moved
        seconds = self.moved - self.started
        return time_left(done, total, seconds, since) if self.alike else ""


def _silent(task: Task, note: str) -> None:
    """Nothing to see."""


def _lines(seconds: float = 2.0) -> Callable[[Task, str], None]:
    """A line for the last part, and before it at most one every two seconds."""
    last = float("-inf")

    def show(task: Task, note: str) -> None:
        nonlocal last
        now = time.monotonic()
        if task.done < task.total and now - last < seconds:
            return
        last = now
        text = f"{task.label}: {task.done}/{task.total}  {note}".rstrip()
        left = task.left()
        print(f"{text}, {left}" if left else text, file=sys.stderr, flush=True)

    return show


@dataclass(frozen=True)
class Progress:
    """Where progress is shown; a quiet one shows nothing."""

    quiet: bool = False

    def say(self, text: str) -> None:
        """One line of text, such as a warning or what comes next."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def task(self, label: str, total: int, alike: bool = True) -> Iterator[Task]:
        """A job of ``total`` parts: a bar while the block runs, or plain lines."""
        if self.quiet:
            yield Task(label, total, _silent)
        elif "ipykernel" in sys.modules:
            yield Task(label, total, _in_notebook(label, total), alike)
        elif sys.stderr.isatty():
            with _bar(label, total) as show:
                yield Task(label, total, show, alike)
        else:
            yield Task(label, total, _lines(), alike)

    def track(self, items: Iterable[T], label: str) -> Iterator[T]:
        """Pass items on and show how many are done."""
        items = list(items)
        with self.task(label, len(items)) as task:
            for item in items:
                yield item
                task.advance()


def time_left(done: int, total: int, seconds: float, since: float = 0.0) -> str:
    """How long the rest takes at the same pace; nothing below a second, or unknown.

    ``done`` parts took so many ``seconds``; the last was done ``since`` s ago.
    """
    if not 0 < done < total:
        return ""
    left = seconds * (total - done) / done - since
    if left < 1.0:
        return ""
    return f"{left:.0f} s left" if left < 90.0 else f"{left / 60.0:.0f} min left"


def _in_notebook(label: str, total: int) -> Callable[[Task, str], None]:
    """One line of the cell's output, drawn again after each part."""
    from IPython.display import HTML, display

    def page(done: int, note: str, left: str) -> Any:
        words = " &middot; ".join(html.escape(x) for x in (note, left) if x)
        bar = f'<progress value="{done}" max="{total}"></progress>'
        return HTML(f"{html.escape(label)} {bar} {done}/{total} {words}")

    shown = display(page(0, "", ""), display_id=True)

    def show(task: Task, note: str) -> None:
        shown.update(page(task.done, note, task.left()))

    return show


@contextmanager
def _bar(label: str, total: int) -> Iterator[Callable[[Task, str], None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        TextColumn,
        TimeElapsedColumn,
    )
    from rich.progress import Progress as Bars

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[left]}"),
        TextColumn("{task.fields[note]}"),
    )
    bars = Bars(*columns, console=Console(stderr=True))
    with bars, cleanup.registered(bars.stop):  # or the cursor stays hidden
        number = bars.add_task(label, total=total, note="", left="")

        def show(task: Task, note: str) -> None:
            bars.update(number, completed=task.done, note=note, left=task.left())

        yield show
