"""A long study on all cores: groups of jobs, each group in one process, in order.

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
from itertools import chain, cycle
from pathlib import Path
from typing import Any, TypeVar

import jax

from sim2gp import cleanup, errors
from sim2gp.errors import Sim2GPError, error

Job = TypeVar("Job")
Result = TypeVar("Result")
PATIENCE = 1.0  # s between looks at whether the processes still live
#: Memory maps of a process, of the 65,530 that Linux gives it: each compiled program
#: takes several, and without any left the process dies.
MAPS, MOST = Path("/proc/self/maps"), 20_000


def cores() -> int:
    """How many cores this process may use."""
    return len(_allowed())


def spread(
    work: Callable[[Job], Result], groups: Sequence[Sequence[Job]], workers: int
) -> Iterator[tuple[Job, Result]]:
    """``work(job)`` of every job as it gets done; ``work`` must be importable.

    One worker is this process itself. Jobs and results are pickled; arrays of 64 bits
    must be NumPy's, since JAX would read them with 32. Raises what ``work`` raises of
    `Sim2GPError`, and E208 when a process dies of anything else.
    """
    groups = [group for group in groups if group]
    workers = min(workers, len(groups))
    if workers <= 1:
        for group in groups:
            for job in group:
                yield job, work(job)
                _forget_programs()
        return
    context = multiprocessing.get_context("spawn")
    jobs, results = context.Queue(), context.Queue()
    numbered = dict(enumerate(chain.from_iterable(groups)))
    first = 0
    for group in groups:
        jobs.put((first, list(group)))
        first += len(group)
    for _ in range(workers):
        jobs.put(None)
    processes = [
        context.Process(target=_serve, args=(work, jobs, results), daemon=True)
        for _ in range(workers)
    ]
    with cleanup.registered(lambda: _kill(processes)):
        try:
            for process, core in zip(processes, cycle(_allowed()), strict=False):
                _start(process, core)
            for _ in numbered:
                number, result = _next(results, processes)
                yield numbered[number], result
        finally:
            for process in _kill(processes):
                process.join()


def in_order(
    work: Callable[[Job], Result],
    jobs: Sequence[Job],
    workers: int,
    done: Callable[[Job], object],
) -> list[Result]:
    """``work(job)`` of every job, in their order; ``done(job)`` as each is finished.

    As `spread` does it, a job at a time; no two jobs may be the same object.
    """
    place = {id(job): k for k, job in enumerate(jobs)}
    found: dict[int, Result] = {}
    for job, result in spread(work, [[job] for job in jobs], workers):
        found[place[id(job)]] = result
        done(job)
    return [found[k] for k in range(len(jobs))]


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


def _next(results: Any, processes: Sequence[Any]) -> Any:
    """The next result, for as long as somebody lives to make it."""
    while True:
        try:
            number, result, failure = results.get(timeout=PATIENCE)
        except queue.Empty:
            died = [p.exitcode for p in processes if p.exitcode]
            if died:
                got = f"exit code {died[0]}"
                raise error("worker_died", Sim2GPError, got=got) from None
            continue
        if failure is not None:
            kind, arguments = failure
            raise getattr(errors, kind)(**arguments)
        return number, result


def _serve(work: Callable[[Any], Any], jobs: Any, results: Any) -> None:
    """One process: take groups until there are none, or nobody is left to take them."""
    # Ctrl-C reaches every process of a terminal; the one that started this ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow, daemon=True).start()
    for first, group in iter(jobs.get, None):
        for number, job in enumerate(group, first):
            try:
                results.put((number, work(job), None))
                _forget_programs()
            except Sim2GPError as caught:
                failure = type(caught).__name__, caught.arguments
                results.put((number, None, failure))
                return


def _forget_programs() -> None:
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
