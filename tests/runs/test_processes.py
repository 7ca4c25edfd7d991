"""Studies on several processes: every job once, groups stay together, faults speak."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.errors import InputError, NotConverged, Sim2GPError
from sim2gp.runs.executors import Processes, processes


def unfinished() -> NotConverged:
    """With all that it may carry."""
    error = NotConverged("E201", "no MAP", where="a fit", got=3.0, key="not_converged")
    error.known = np.zeros(3)
    return error


def square(job: int) -> tuple[int, int]:
    if job == 13:
        raise InputError("E103", "unlucky", got=job, fix="another number")
    if job == 14:
        os._exit(3)
    if job == 15:
        raise unfinished()
    return job**2, os.getpid()


def test_every_job_is_done_once_and_groups_stay_together() -> None:
    groups = [[1, 2, 3], [], [4, 5], [6]]
    found = dict(Processes(2).spread(square, groups))
    assert {job: result[0] for job, result in found.items()} == {
        n: n**2 for n in range(1, 7)
    }
    for group in groups:
        assert len({found[job][1] for job in group}) <= 1
    assert os.getpid() not in {pid for _, pid in found.values()}


def late(job: tuple[float, int]) -> int:
    time.sleep(job[0])
    return job[1]


@pytest.mark.parametrize("count", [1, 2])
def test_results_have_the_order_of_their_jobs(count: int) -> None:
    """Of two processes the second is done first."""
    jobs, finished = [(2.0, 7), (0.0, 8), (0.0, 9)], []
    assert Processes(count).in_order(
        late, jobs, lambda job: finished.append(job[1])
    ) == [7, 8, 9]
    assert sorted(finished) == [7, 8, 9]
    assert finished[0] == (7 if count == 1 else 8)


def cores_of_threads(job: int) -> list[list[int]]:
    """The cores that each thread of this process may use."""
    np.linalg.qr(np.ones((4, 4)))  # whatever makes threads has made them
    return [sorted(os.sched_getaffinity(int(t))) for t in os.listdir("/proc/self/task")]


@pytest.mark.skipif(
    not os.path.isdir("/proc/self/task") or len(processes._allowed()) < 2,
    reason="needs two cores and a system that tells of threads",
)
def test_no_thread_of_a_worker_leaves_its_core() -> None:
    mine = processes._allowed()
    found = dict(Processes(2).spread(cores_of_threads, [[1], [2]]))
    for threads in found.values():
        assert len(threads) >= 1
        assert all(thread == threads[0] for thread in threads)
        assert len(threads[0]) == 1
    assert {threads[0][0] for threads in found.values()} <= set(mine[:2])
    assert processes._allowed() == mine


def test_one_worker_is_this_process() -> None:
    found = dict(Processes(1).spread(square, [[1, 2], [3]]))
    assert found == {n: (n**2, os.getpid()) for n in (1, 2, 3)}


@jax.jit
def doubled(x: jax.Array) -> jax.Array:
    return 2.0 * x


def programs(size: int) -> int:
    """How many there are of `doubled`, with that of one more size."""
    doubled(jnp.zeros(size))
    return doubled._cache_size()


@pytest.mark.skipif(not processes.MAPS.exists(), reason="Linux limits a process's maps")
def test_programs_are_forgotten_before_memory_maps_run_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A study of many programs died of it after 43 of its 100 cells."""
    sizes = [[1, 2, 3]]
    assert [n for _, n in Processes(1).spread(programs, sizes)] == [1, 2, 3]
    doubled.clear_cache()
    monkeypatch.setattr(processes, "MOST", 0)
    assert [n for _, n in Processes(1).spread(programs, sizes)] == [1, 1, 1]


@pytest.mark.parametrize("count", [1, 2])
def test_an_error_arrives_whole(count: int) -> None:
    with pytest.raises(InputError, match=r"E103 unlucky: got 13\. Fix: another") as e:
        list(Processes(count).spread(square, [[13], [1]]))
    assert e.value.code == "E103"
    assert str(e.value.got) == "13"


def test_the_error_of_a_worker_is_the_same_error() -> None:
    """What is known where it ended stays in the process."""
    with pytest.raises(NotConverged) as e:
        list(Processes(2).spread(square, [[15], [1]]))
    assert str(e.value) == str(unfinished())
    assert e.value.key == "not_converged"
    assert e.value.known is None


def test_a_process_that_dies_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "PATIENCE", 0.1)
    with pytest.raises(
        Sim2GPError, match="E208 a worker process died: got exit code 3"
    ):
        list(Processes(2).spread(square, [[14], [1]]))


def lingering(path: str) -> None:
    """Says which process it is, and does not end by itself."""
    Path(path).write_text(str(os.getpid()))
    time.sleep(120.0)


STUDY = """
import sys
from tests.runs.test_processes import lingering
from sim2gp.runs.executors import Processes

if __name__ == "__main__":
    list(Processes(2).spread(lingering, [[name] for name in sys.argv[1:]]))
"""


def test_processes_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    (tmp_path / "study.py").write_text(STUDY)
    files = [tmp_path / "one", tmp_path / "two"]
    path = os.pathsep.join(
        [str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
    )
    study = subprocess.Popen(
        [sys.executable, str(tmp_path / "study.py"), *map(str, files)],
        env=os.environ | {"PYTHONPATH": path},
    )

    def within(seconds: float, done: Callable[[], bool]) -> bool:
        end = time.monotonic() + seconds
        while not done() and time.monotonic() < end:
            time.sleep(0.1)
        return done()

    assert within(100.0, lambda: all(f.exists() and f.read_text() for f in files))
    workers = [int(f.read_text()) for f in files]
    study.kill()
    study.wait()
    assert within(20.0, lambda: not any(map(alive, workers)))


def alive(number: int) -> bool:
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    status = Path(f"/proc/{number}/status")
    return not status.exists() or "State:\tZ" not in status.read_text()
