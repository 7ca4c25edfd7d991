"""A study of the paper: cells, their seeds, the claims about them, and a figure.

A cell is one learner on one hidden machine of one seed. It is computed once, stored and
never computed again. Cells of one seed meet the same machine under the same noise, so
claims compare learners seed by seed (`sim2gp.studies.claims`).
"""

import os
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from sys import modules
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import numpy as np

from sim2gp.errors import error
from sim2gp.runs import Progress, new_run
from sim2gp.runs.cells import Cells, Old
from sim2gp.runs.provenance import provenance
from sim2gp.runs.workers import spread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Values = dict[str, Any]
Arrays = dict[str, np.ndarray]
#: Names of a row of cells, one cell for each seed: machine, condition, method.
Key = tuple[str, ...]


class AbstractCell(ABC):
    """A frozen dataclass: all arguments of what is computed once."""

    method: str
    seed: int

    @property
    @abstractmethod
    def name(self) -> str:
        """The name of its file."""

    @property
    @abstractmethod
    def arguments(self) -> Values:
        """All that its values depend on, except how many episodes there are."""

    @property
    @abstractmethod
    def program(self) -> tuple[Hashable, ...]:
        """Cells that compile alike; the first entry groups more of them."""

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


class Study(ABC):
    """Which cells are compared on which seeds, what is claimed, and what is drawn.

    Everything after the cells comes from `arrays`, which are stored: claims, tables and
    pictures are made again from a run without computing anything.
    """

    #: Seeds and episodes of the figure, and of a quick look; None: it has no episodes.
    size: ClassVar[tuple[int, int | None]]
    quick_size: ClassVar[tuple[int, int | None]]

    def __init__(
        self,
        name: str,
        *,
        seed: int = 0,
        seeds: int | None = None,
        episodes: int | None = None,
        quick: bool = False,
    ) -> None:
        """``name`` is that of ``sim2gp reproduce``; None are the figure's own numbers.

        Raises `InputError` E160 for ``episodes`` of a study that has none.
        """
        self.name, self.seed, self.quick = name, seed, quick
        count, most = self.quick_size if quick else self.size
        if most is None and episodes is not None:
            got = str(episodes)
            raise error("figure_without_episodes", where="the command line", got=got)
        self.count = seeds or count
        self.episodes = episodes or most or 0
        self.seeds = range(seed, seed + self.count)

    @abstractmethod
    def rows(self) -> Mapping[Key, Sequence[AbstractCell]]:
        """The cells that are compared, one of each row for each seed."""

    @abstractmethod
    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """What is stored, from the values of all cells."""

    @abstractmethod
    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """Title, claims and tables; `claims` are resampled with the study's seed."""

    @abstractmethod
    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> Mapping[str, "Figure"]:
        """Figures by the stem of their files."""

    def cells_of(self, out: Path) -> Path:
        """The run whose folder of cells is used."""
        return out

    @property
    def rng(self) -> np.random.Generator:
        """A new generator, for the bootstrap of the claims."""
        return np.random.default_rng(self.seed)

    def line(self, old: Old) -> str:
        """The command that makes this run again."""
        words = f"sim2gp reproduce {self.name} --seed {self.seed} --seeds {self.count}"
        words += f" --episodes {self.episodes}" if self.episodes else ""
        return words + " --quick" * self.quick + " --keep-old" * (old == "keep")

    def run(
        self, out: Path, *, workers: int, progress: Progress, old: Old = "refuse"
    ) -> dict[str, Any]:
        """Compute missing cells, check the claims, write the run; returns its summary.

        Cells of an earlier run with this ``out`` are used again, also for fewer
        episodes (E186: of another source, see ``old``).
        """
        from sim2gp.reports import figure_bytes, write_report

        started = time.perf_counter()
        with new_run(out, f"reproduce {self.name}") as writer:
            values, about = run_cells(
                self.rows(),
                self.cells_of(out),
                workers=workers,
                progress=progress,
                old=old,
            )
            arrays = self.arrays(values)
            summary = {
                "command": f"reproduce {self.name}",
                "seed": self.seed,
                "seeds": self.count,
                **self.summary(arrays, values),
                **about,
                **provenance(started, self.line(old)),
            }
            writer.write_summary(summary)
            writer.write_arrays("arrays.npz", arrays)
            for stem, figure in self.pictures(arrays, summary).items():
                writer.write_bytes(f"{stem}.png", figure_bytes(figure, "png"))
            writer.write_text("report.html", write_report(summary, arrays))
        return summary


def run_cells(
    rows: Mapping[Key, Sequence[AbstractCell]],
    out: Path,
    *,
    workers: int,
    progress: Progress,
    old: Old = "refuse",
) -> tuple[dict[AbstractCell, Values], dict[str, Any]]:
    """The values of all cells, and what a summary says of them.

    Raises `InputError` E186 before the first cell is computed for stored cells that
    this source did not compute and ``old`` does not allow.
    """
    wanted = list(dict.fromkeys(cell for row in rows.values() for cell in row))
    needed = dict.fromkeys(cell.needs for cell in wanted if cell.needs is not None)
    stages = (list(needed), [cell for cell in wanted if cell not in needed])
    every = [*stages[0], *stages[1]]
    stored = Cells(out, _code(every[0]), old)
    named = [(cell.name, cell.arguments) for cell in every]
    stored.check(named)
    values: dict[AbstractCell, Values] = {}
    # Each process would claim most of a GPU's memory, and all share one.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    compute = _in_processes if jax.default_backend() == "cpu" else _in_batches
    with progress.task("cells", len(every)) as task:
        for stage in stages:
            for cell, value in compute(stage, out, old, workers):
                values[cell] = value
                task.advance(cell.name.replace("_", ", "))
    return values, _about(values) | stored.summary(named)


#: Cells with their values, as they get done.
Done = Iterator[tuple[AbstractCell, Values]]


def _in_processes(
    cells: Sequence[AbstractCell], out: Path, old: Old, workers: int
) -> Done:
    """A cell at a time in each process, which owns one core."""
    work = partial(run_cell, out=out, old=old)
    yield from spread(work, _by_program(cells, workers), workers)


def _in_batches(
    cells: Sequence[AbstractCell], out: Path, old: Old, workers: int
) -> Done:
    """A batch at a time in each process: others are fitted while one is planned."""
    batches: dict[Hashable, list[AbstractCell]] = {}
    for cell in cells:
        batches.setdefault(cell.batch, []).append(cell)
    work = partial(run_batch, out=out, old=old)
    for _, values in spread(work, [[batch] for batch in batches.values()], workers):
        yield from values.items()


def run_batch(
    cells: Sequence[AbstractCell], out: Path, old: Old = "refuse"
) -> dict[AbstractCell, Values]:
    """`run_cell` of cells of one batch; those not stored are computed as one."""
    stored = Cells(out, _code(cells[0]), old)
    found = {cell: _stored(cell, stored) for cell in cells}
    left = [cell for cell in cells if found[cell] is None]
    if left:
        needed = [
            None if cell.needs is None else run_cell(cell.needs, out, old)
            for cell in left
        ]
        computed = type(left[0]).compute_batch(left, needed)
        for cell, values in zip(left, computed, strict=True):
            found[cell] = _saved(cell, stored, values)
    return {cell: values for cell, values in found.items() if values is not None}


def run_cell(cell: AbstractCell, out: Path, old: Old = "refuse") -> Values:
    """A cell's values, from the disk if there are enough of them (E186)."""
    cells = Cells(out, _code(cell), old)
    stored = _stored(cell, cells)
    if stored is not None:
        return stored
    needed = None if cell.needs is None else run_cell(cell.needs, out, old)
    return _saved(cell, cells, cell.compute(needed))


def _stored(cell: AbstractCell, cells: Cells) -> Values | None:
    """Values on the disk; None if there are not enough of them."""
    stored = cells.load(cell.name, cell.arguments)
    if stored is None or not (cell.enough(stored) or stored.get("failure")):
        return None
    return stored


def _saved(cell: AbstractCell, cells: Cells, values: Values) -> Values:
    """Stored with the device that computed them: another one rounds otherwise."""
    device = {"device": jax.default_backend()}
    return cells.save(cell.name, cell.arguments, values | device)


def _code(cell: AbstractCell) -> str:
    """The file that computes a cell: its source is stored with its values."""
    return str(modules[type(cell).__module__].__file__)


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


def _about(values: Mapping[AbstractCell, Values]) -> dict[str, Any]:
    """Failures and seconds of all cells."""
    spent: dict[str, float] = {}
    for cell, value in values.items():
        spent[cell.method] = spent.get(cell.method, 0.0) + value.get("seconds", 0.0)
    return {
        "fits_not_converged": [
            f"{cell.name}: {value['failure']}"
            for cell, value in values.items()
            if value.get("failure")
        ],
        "devices_of_cells": Counter(v.get("device", "cpu") for v in values.values()),
        "seconds_of_cells": {name: time for name, time in spent.items() if time},
    }


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
