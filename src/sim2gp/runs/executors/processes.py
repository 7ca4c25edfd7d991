"""Processes of this machine: groups of jobs, each group in one process, in order.

What a group has in common is compiled once, by the process that takes it. Processes
are spawned, not forked (JAX has threads), and pinned to a core each where the system
can: two that share two cores by threads are slower than two that own one each.
"""

import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, cycle
from pathlib import Path
from typing import Any

import jax

from sim2gp import cleanup
from sim2gp.errors import Sim2GPError, error
from sim2gp.runs.executors.base import (
    AbstractExecutor,
    Job,
    Outcome,
    Result,
    outcome_of,
    result_of,
)

PATIENCE = 1.0  # s between looks at whether the processes still live
#: Memory maps of a process, of the 65,530 that Linux gives it: each compiled program
#: takes several, and without any left the process dies.
MAPS, MOST = Path("/proc/self/maps"), 20_000


def cores() -> int:
    """How many cores this process may use."""
    return len(_allowed())


@dataclass(frozen=True)
class Processes(AbstractExecutor):
    """So many processes; one is this process itself."""

    number: int = 1

    @property
    def count(self) -> int:
        """How many there are."""
        return self.number

    @property
    def accelerated(self) -> bool:
        """Whether this machine has an accelerator, which all of them share."""
        return jax.default_backend() != "cpu"

    def spread(
        self, work: Callable[[Job], Result], groups: Sequence[Sequence[Job]]
    ) -> Iterator[tuple[Job, Result]]:
        """As processes are free."""
        groups = [group for group in groups if group]
        number = min(self.number, len(groups))
        if number <= 1:
            for group in groups:
                for job in group:
                    yield job, work(job)
                    forget_programs()
        else:
            yield from _spread(work, groups, number)


def _spread(
    work: Callable[[Job], Result], groups: Sequence[Sequence[Job]], number: int
) -> Iterator[tuple[Job, Result]]:
    context = multiprocessing.get_context("spawn")
    jobs, results = context.Queue(), context.Queue()
    numbered = dict(enumerate(chain.from_iterable(groups)))
    first = 0
    for group in groups:
        jobs.put((first, list(group)))
        first += len(group)
    for _ in range(number):
        jobs.put(None)
    processes = [
        context.Process(target=_serve, args=(work, jobs, results), daemon=True)
        for _ in range(number)
    ]
    with cleanup.registered(lambda: _kill(processes)):
        try:
            for process, core in zip(processes, cycle(_allowed()), strict=False):
                _start(process, core)
            for _ in numbered:
                place, outcome = _next(results, processes)
                yield numbered[place], result_of(outcome)
        finally:
            for process in _kill(processes):
                process.join()


def _kill(processes: Sequence[Any]) -> list[Any]:
    """End those that were started; nothing of theirs is half-written."""
    started = [process for process in processes if process.pid is not None]
    for process in started:
        process.kill()
    return started


def _allowed() -> Sequence[int | None]:
    """The cores of this process; None for each where the system does not name them."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return [None] * (os.cpu_count() or 1)


def _start(process: Any, core: int | None) -> None:
    """Start it on one core, which it inherits with its first thread.

    Pinned only after its imports, it had threads that stray over all cores: on two of
    them neural rollouts took two to six times as long.
    """
    if core is None:
        process.start()
        return
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {core})
    try:
        process.start()
    finally:
        os.sched_setaffinity(0, mine)


def _next(results: Any, processes: Sequence[Any]) -> tuple[int, Outcome]:
    """The next result, for as long as somebody lives to make it."""
    while True:
        try:
            return results.get(timeout=PATIENCE)
        except queue.Empty:
            died = [p.exitcode for p in processes if p.exitcode]
            if died:
                got = f"exit code {died[0]}"
                raise error("worker_died", Sim2GPError, got=got) from None


def _serve(work: Callable[[Any], Any], jobs: Any, results: Any) -> None:
    """One process: take groups until there are none, or nobody is left to take them."""
    # Ctrl-C reaches every process of a terminal; the one that started this ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, daemon=True).start()
    for first, group in iter(jobs.get, None):
        for place, job in enumerate(group, first):
            outcome = outcome_of(work, job)
            results.put((place, outcome))
            if outcome[1] is not None:
                return
            forget_programs()


def forget_programs() -> None:
    """Give their memory maps back, once there are many."""
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST:
        jax.clear_caches()


def _follow() -> None:
    """End with the process that started this one, for any end of that process.

    A killed process stops no worker, and they would run the whole study for nobody.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)
