"""Where jobs are done: processes of this machine, or those of a Ray cluster."""

from sim2gp.runs.executors.base import AbstractExecutor as AbstractExecutor
from sim2gp.runs.executors.processes import Processes as Processes
from sim2gp.runs.executors.processes import cores as cores
from sim2gp.runs.executors.ray_cluster import RayCluster as RayCluster

#: So many processes, or any executor.
Workers = int | AbstractExecutor


def executor_of(workers: Workers | None) -> AbstractExecutor:
    """An executor; None is a process for each core."""
    if isinstance(workers, AbstractExecutor):
        return workers
    return Processes(workers or cores())
