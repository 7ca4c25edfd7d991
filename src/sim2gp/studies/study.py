"""A study of the paper: cells, their seeds, the claims about them, and a figure.

A cell is one learner on one hidden machine of one seed. It is computed once, stored and
never computed again. Cells of one seed meet the same machine under the same noise, so
claims compare learners seed by seed (`sim2gp.studies.claims`).
"""

import os
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from sim2gp.errors import error
from sim2gp.runs import Progress, new_run
from sim2gp.runs.cell_work import (
    AbstractCell,
    Values,
    compute_cells,
    store_of,
    with_needed,
)
from sim2gp.runs.cells import Old
from sim2gp.runs.executors import Workers, executor_of
from sim2gp.runs.provenance import provenance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Arrays = dict[str, np.ndarray]
#: Names of a row of cells, one cell for each seed: machine, condition, method.
Key = tuple[str, ...]


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
    def cells(self) -> list[AbstractCell]:
        """All of them, each after the one that it needs."""
        return with_needed(cell for row in self.rows().values() for cell in row)

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
        self,
        out: Path,
        *,
        workers: Workers | None,
        progress: Progress,
        old: Old = "refuse",
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
    workers: Workers | None,
    progress: Progress,
    old: Old = "refuse",
) -> tuple[dict[AbstractCell, Values], dict[str, Any]]:
    """The values of all cells, and what a summary says of them.

    Raises `InputError` E186 before the first cell is computed for stored cells that
    this source did not compute and ``old`` does not allow.
    """
    every = with_needed(cell for row in rows.values() for cell in row)
    store = store_of(every, out, old)
    # Each process would claim most of a GPU's memory, and all share one.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    with progress.task("cells", len(every)) as task:
        values = compute_cells(every, store, executor_of(workers), task)
    named = [(cell.name, cell.arguments) for cell in every]
    return values, _about(values) | store.summary(named)


def _about(values: Mapping[AbstractCell, Values]) -> dict[str, Any]:
    """Failures and seconds of all cells."""
    spent: dict[str, float] = {}
    for cell, value in values.items():
        method = str(cell.arguments.get("method", ""))
        spent[method] = spent.get(method, 0.0) + value.get("seconds", 0.0)
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
