"""Cells, the unit of work: independent, named by their arguments, computed once.

A cell is one learner on one hidden machine, one fold of recordings, one planted search.
Its values are the same in every process, and the one that asked stores them.
"""

from abc import ABC, abstractmethod
from collections.abc import (
    Hashable,
    Iterable,
    Iterator,
    Mapping,
    Sequence,
)
from pathlib import Path
from sys import modules
from typing import Any, NamedTuple

import jax

from sim2gp.errors import Sim2GPError, error
from sim2gp.runs.cells import Cells, Old
from sim2gp.runs.executors import AbstractExecutor, Processes
from sim2gp.runs.progress import Task
from sim2gp.runs.sources import source_of

Values = dict[str, Any]


class AbstractCell(ABC):
    """A frozen dataclass: all arguments of what is computed once."""

    @property
    @abstractmethod
    def name(self) -> str:
        """The name of its file."""

    @property
    def note(self) -> str:
        """What it is, for people."""
        return self.name.replace("_", ", ")

    @property
    @abstractmethod
    def arguments(self) -> Values:
        """All that its values depend on, except how many episodes there are."""

    @property
    def program(self) -> tuple[Hashable, ...]:
        """Cells that compile alike; the first entry groups more of them."""
        return (type(self),)

    @property
    def needs(self) -> "AbstractCell | None":
        """The cell whose values this one starts from."""
        return None

    def enough(self, values: Mapping[str, Any]) -> bool:
        """Whether stored values have as many episodes as this cell asks for."""
        del values
        return True

    @abstractmethod
    def compute(self, needed: Values | None) -> Values:
        """Its values; ``needed`` are those of the cell that it needs."""

    @property
    def batch(self) -> Hashable:
        """Cells that an accelerator computes as one have the same; else the cell."""
        return self

    @classmethod
    def compute_batch(
        cls, cells: Sequence[Any], needed: Sequence[Values | None]
    ) -> list[Values]:
        """Values of cells of one `batch`."""
        return [cell.compute(x) for cell, x in zip(cells, needed, strict=True)]


def with_needed(cells: Iterable[AbstractCell]) -> list[AbstractCell]:
    """Each cell once, after the one that it needs."""
    found: dict[AbstractCell, None] = {}
    for cell in cells:
        if cell.needs is not None:
            found |= dict.fromkeys(with_needed([cell.needs]))
        found[cell] = None
    return list(found)


class Job(NamedTuple):
    """Cells that are computed as one, with the values of those that they need."""

    cells: tuple[AbstractCell, ...]
    needed: tuple[Values | None, ...]
    together: bool  # as one program of an accelerator
    source: str  # of the code that asks; empty where no other process computes


class Found(NamedTuple):
    """What a job gives back: values by cell, and what computed them."""

    values: list[Values]
    device: str


def compute_cells(
    cells: Iterable[AbstractCell],
    store: Cells | None,
    executor: AbstractExecutor,
    task: Task | None = None,
) -> dict[AbstractCell, Values]:
    """The values of all cells, and of those that have to be computed before.

    This process alone stores them, as they come; what is stored is not computed again.
    ``task`` advances with each cell. Raises `InputError` E186 as `Cells.load` does,
    E209 where another process has other code.
    """
    stored = {cell: _stored(cell, store) for cell in cells}
    values = {cell: found for cell, found in stored.items() if found is not None}
    if task is not None:
        task.skip(len(values))
    needed = dict.fromkeys(c.needs for c in stored if c not in values)
    first = [c for c in needed if c is not None and c not in values]
    if first:
        values |= compute_cells(first, store, executor, task)
    left = [cell for cell in stored if cell not in values]
    for cell, found in _computed(left, values, executor):
        if store is not None:
            found = store.save(cell.name, cell.arguments, found)
        values[cell] = found
        if task is not None:
            task.advance(cell.note)
    return values


def run_cell(cell: AbstractCell, out: Path, old: Old = "refuse") -> Values:
    """A cell's values, from the cells of the run at ``out`` or computed (E186)."""
    store = store_of([cell], out, old)
    return compute_cells([cell], store, Processes())[cell]


def _stored(cell: AbstractCell, store: Cells | None) -> Values | None:
    """Values on the disk; None if there are not enough of them."""
    stored = None if store is None else store.load(cell.name, cell.arguments)
    if stored is None or not (cell.enough(stored) or stored.get("failure")):
        return None
    return stored


def store_of(cells: Sequence[AbstractCell], out: Path, old: Old = "refuse") -> Cells:
    """Where the cells of the run at ``out`` are; E186 for those that are refused."""
    store = Cells(out, code_of(cells[0]), old)
    store.check([(cell.name, cell.arguments) for cell in cells])
    return store


def _computed(
    cells: Sequence[AbstractCell],
    known: Mapping[AbstractCell, Values],
    executor: AbstractExecutor,
) -> Iterator[tuple[AbstractCell, Values]]:
    """Cells with their values, as they get done."""

    def job(*cells: AbstractCell) -> Job:
        needed = tuple(known[c.needs] if c.needs else None for c in cells)
        source = _source(cells[0]) if executor.count > 1 else ""
        return Job(cells, needed, executor.accelerated, source)

    if executor.accelerated:  # others are fitted while one batch is planned
        batches: dict[Hashable, list[AbstractCell]] = {}
        for cell in cells:
            batches.setdefault(cell.batch, []).append(cell)
        groups = [[job(*batch)] for batch in batches.values()]
    else:
        groups = [
            [job(cell) for cell in group]
            for group in _by_program(cells, executor.count)
        ]
    for asked, found in executor.spread(_compute, groups):
        for cell, values in zip(asked.cells, found.values, strict=True):
            # Another device rounds otherwise.
            yield cell, values | {"device": found.device}


def _compute(job: Job) -> Found:
    if job.source and job.source != (source := _source(job.cells[0])):
        got = f"code {source}"
        raise error("worker_of_other_code", Sim2GPError, got=got)
    if job.together:
        values = type(job.cells[0]).compute_batch(job.cells, job.needed)
    else:
        (cell,), (needed,) = job.cells, job.needed
        values = [cell.compute(needed)]
    return Found(values, jax.default_backend())


def code_of(cell: AbstractCell) -> str:
    """The file that computes a cell: its source is stored with its values."""
    return str(modules[type(cell).__module__].__file__)


def _source(cell: AbstractCell) -> str:
    return source_of(code_of(cell)).digest


def _by_program(
    cells: Iterable[AbstractCell], workers: int
) -> list[list[AbstractCell]]:
    """Groups that a process takes whole: it compiles once for all of a group.

    All cells of a machine, or of a learner on a machine where processes outnumber
    machines.
    """
    cells = list(cells)
    whole = workers <= len({cell.program[0] for cell in cells})
    groups: dict[Hashable, list[AbstractCell]] = {}
    for cell in cells:
        key = cell.program[0] if whole else cell.program
        groups.setdefault(key, []).append(cell)
    return list(groups.values())
