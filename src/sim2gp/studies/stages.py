"""Cells of studies, computed stage by stage on all cores.

A cell is one learner on one hidden machine of one seed; a study is a list of cells, and
what some cells need of others is a stage of its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, Protocol, TypeVar, runtime_checkable

from sim2gp.runs import Progress
from sim2gp.runs.workers import spread


@runtime_checkable
class AnyCell(Protocol):
    """Which machine is met, by whom, and whether in a hurry."""

    @property
    def machine(self) -> str: ...
    @property
    def condition(self) -> str: ...
    @property
    def method(self) -> str: ...
    @property
    def seed(self) -> int: ...
    @property
    def quick(self) -> bool: ...


Job = TypeVar("Job", bound=AnyCell)


def in_stages(
    stages: Sequence[Sequence[Job]],
    work: Callable[[Job], dict[str, Any]],
    alike: Callable[[Job], Any],
    *,
    workers: int,
    progress: Progress,
) -> dict[Job, dict[str, Any]]:
    """All cells of a stage before the next one's; ``work`` reads finished ones.

    Cells that are ``alike`` go to one process, which compiles for them once: all cells
    of a machine, or all of a learner on a machine where processes outnumber machines.
    """
    values: dict[Job, dict[str, Any]] = {}
    with progress.task("cells", sum(map(len, stages))) as task:
        for stage in stages:
            groups: dict[Any, list[Job]] = {}
            for cell in stage:
                groups.setdefault(alike(cell), []).append(cell)
            for cell, value in spread(work, list(groups.values()), workers):
                values[cell] = value
                told = f"{cell.machine}, {cell.condition}: {cell.method}"
                task.advance(f"{told}, seed {cell.seed}")
    return values


#: Arguments that stored cells have under an earlier name.
STORED_AS = {"num_envs": "worlds", "tau": "slow"}


def described(value: Any) -> Any:
    """Its type and every argument, defaults as well: those may change."""
    if not is_dataclass(value):
        return value
    arguments = {
        STORED_AS.get(f.name, f.name): described(getattr(value, f.name))
        for f in fields(value)
    }
    return {"type": type(value).__name__} | arguments
