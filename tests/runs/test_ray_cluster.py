"""Cells on a Ray cluster: the same as here, whichever workers are lost."""

import os
import signal
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp.errors import InputError, Sim2GPError
from sim2gp.runs.cell_work import AbstractCell, Values, compute_cells, store_of
from sim2gp.runs.executors import Processes, RayCluster

ray = pytest.importorskip("ray")


@pytest.fixture(scope="module", autouse=True)
def cluster() -> Iterator[None]:
    """Two workers, for all tests of this file."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    path = os.pathsep.join(map(str, (Path(__file__).parent, Path(__file__).parents[2])))
    given = os.environ.get("PYTHONPATH", "")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
        ray.init(
            "local",
            num_cpus=2,
            include_dashboard=False,
            configure_logging=False,
            log_to_driver=False,
            runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join([path, given])}},
        )
    yield
    ray.shutdown()


@dataclass(frozen=True)
class Noise(AbstractCell):
    """Numbers of a seed, added to those of the seed before.

    With a ``folder`` every third kills its first worker, and remembers it there.
    """

    seed: int
    folder: str = ""

    @property
    def name(self) -> str:
        return f"noise_{self.seed}"

    @property
    def arguments(self) -> Values:
        return {"seed": self.seed}

    @property
    def needs(self) -> "Noise | None":
        return Noise(self.seed - 1, self.folder) if self.seed % 4 else None

    def compute(self, needed: Values | None) -> Values:
        died = Path(self.folder) / str(self.seed)
        if self.folder and not (self.seed % 3 or died.exists()):
            died.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        x = np.random.default_rng(self.seed).standard_normal(8)
        return {"x": x + (np.asarray(needed["x"]) if needed else 0.0)}


def test_cells_are_those_of_this_process_though_workers_die(tmp_path: Path) -> None:
    """Chains of four, every third cell's first worker killed."""
    cells = [Noise(k, str(tmp_path)) for k in range(8)]
    store = store_of(cells, tmp_path / "ray", "refuse")
    found = compute_cells(cells, store, RayCluster())
    assert sorted(int(f.name) for f in tmp_path.iterdir() if f.is_file()) == [0, 3, 6]
    other = store_of(cells, tmp_path / "here", "refuse")
    here = compute_cells([Noise(k) for k in range(8)], other, Processes())
    assert {c.name: v for c, v in found.items()} == {c.name: v for c, v in here.items()}
    for cell in cells:
        files = (s.folder / f"{cell.name}.json" for s in (store, other))
        assert len({file.read_bytes() for file in files}) == 1


def always(job: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_job_that_kills_all_its_workers_is_told() -> None:
    with pytest.raises(Sim2GPError, match="E208 a worker process died: got"):
        list(RayCluster(retries=1).spread(always, [[1]]))


def unlucky(job: int) -> int:
    if job == 13:
        raise InputError("E103", "unlucky", got=job, fix="another number")
    if job == 14:
        raise ZeroDivisionError("by 0")
    return job


@pytest.mark.parametrize(
    ("job", "kind", "words"),
    [
        (13, InputError, r"E103 unlucky: got 13\. Fix: another"),
        (14, Sim2GPError, r"E208 .* ZeroDivisionError: by 0\."),
    ],
)
def test_an_error_arrives_as_it_was(job: int, kind: Any, words: str) -> None:
    with pytest.raises(kind, match=words):
        list(RayCluster().spread(unlucky, [[1, job]]))


def threads(job: int) -> str:
    return os.environ["NPROC"]


@pytest.mark.parametrize(("cpus", "number"), [(2.0, "2"), (0.5, "1")])
def test_a_job_has_as_many_threads_as_cores(cpus: float, number: str) -> None:
    assert list(RayCluster(cpus=cpus).spread(threads, [[1]])) == [(1, number)]
