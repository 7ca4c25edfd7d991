"""Processes of a Ray cluster (extra ``ray``): a cluster's, or one started here.

Ray decides where a job runs, and runs it again where a worker or a node is lost. Nodes
need the same sim2gp and, of a project, its files in the same place.
"""

import math
import os
import signal
import socket
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from sim2gp.errors import Sim2GPError, error, missing_extra
from sim2gp.runs.executors.base import (
    AbstractExecutor,
    Job,
    Outcome,
    Result,
    outcome_of,
    result_of,
)
from sim2gp.runs.executors.processes import forget_programs

PATIENCE = 10.0  # s until a cluster must answer


@dataclass(frozen=True)
class RayCluster(AbstractExecutor):
    """A cluster by its address; None starts one on this machine, for as long as needed.

    Each job has ``cpus`` cores and ``gpus`` accelerators, which may be shares of one;
    it is run again up to ``retries`` times where its worker is lost.
    """

    address: str | None = None
    cpus: float = 1.0
    gpus: float = 0.0
    retries: int = 5

    @property
    def count(self) -> int:
        """As many as the cluster has room for, which may change."""
        return sys.maxsize

    @property
    def accelerated(self) -> bool:
        """Whether jobs ask for an accelerator."""
        return self.gpus > 0.0

    def spread(
        self, work: Callable[[Job], Result], groups: Sequence[Sequence[Job]]
    ) -> Iterator[tuple[Job, Result]]:
        """As the cluster has room; raises `InputError` E135 where there is no Ray.

        E209 for a cluster that does not answer, and E208 for a job whose workers were
        lost more often than ``retries``.
        """
        with _connected(self.address) as ray:
            # As many threads as cores: sums of networks depend on how they are shared.
            threads = str(max(1, math.floor(self.cpus)))
            done = ray.remote(_done).options(
                num_cpus=self.cpus,
                num_gpus=self.gpus,
                max_retries=self.retries,
                runtime_env={"env_vars": {"NPROC": threads}},
            )
            given = ray.put(work)
            left = {done.remote(given, job): job for group in groups for job in group}
            try:
                while left:
                    (first, *_), _ = ray.wait(list(left))
                    yield left.pop(first), _result(ray, first)
            finally:
                for reference in left:
                    ray.cancel(reference, force=True)


def _done(work: Callable[[Any], Any], job: Any) -> Outcome:
    try:
        return outcome_of(work, job)
    except Exception as caught:  # nobody sees what a worker prints
        got = f"{type(caught).__name__}: {caught}"
        died = error("worker_died", Sim2GPError, got=got)
        return None, (Sim2GPError.__name__, died.arguments)
    finally:
        forget_programs()


def _result(ray: ModuleType, reference: Any) -> Any:
    try:
        outcome = ray.get(reference)
    except ray.exceptions.RayError as caught:
        got = str(caught).split("\n", 1)[0][:200]
        raise error("worker_died", Sim2GPError, got=got) from None
    return result_of(outcome)


@contextmanager
def _connected(address: str | None) -> Iterator[ModuleType]:
    """Ray, connected to a cluster, or to the one that this process is connected to."""
    ray = _ray()
    if ray.is_initialized():
        yield ray
        return
    handler = signal.getsignal(signal.SIGTERM)
    try:
        _reach(address)
        with warnings.catch_warnings():
            # JAX warns of processes that go on as a copy of this one. Ray's do not.
            warnings.filterwarnings("ignore", r"os\.fork", RuntimeWarning)
            ray.init(
                address or "local",
                include_dashboard=None if address else False,
                configure_logging=False,
                log_to_driver=False,
            )
    except (OSError, RuntimeError, ValueError) as caught:
        got = str(caught).split("\n", 1)[0][:200]
        raise error("no_ray_cluster", where=address or "here", got=got) from caught
    try:
        signal.signal(signal.SIGTERM, handler)  # Ray has set its own
        yield ray
    finally:
        ray.shutdown()


def _reach(address: str | None) -> None:
    """Raise OSError where nobody listens at HOST:PORT: Ray tries for six minutes."""
    host, colon, port = (address or "").rpartition(":")
    if colon and port.isdigit() and "/" not in host:
        socket.create_connection((host, int(port)), PATIENCE).close()


def _ray() -> ModuleType:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as caught:
        raise missing_extra("a Ray cluster", caught, "ray") from None
    return ray
