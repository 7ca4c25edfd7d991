"""Shares of a study's cells: each computed anywhere, then joined; no lock between them.

A share is a part of the cells by its number, so a job array needs nothing but that. All
write whole files of the same names, and results are those of one run, bit for bit.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sim2gp.errors import error
from sim2gp.runs.cell_work import AbstractCell, compute_cells, store_of, with_needed
from sim2gp.runs.cells import Cells, Old
from sim2gp.runs.executors import Workers, executor_of
from sim2gp.runs.progress import Progress


@dataclass(frozen=True)
class Share:
    """The part ``index`` (from 1) of ``count`` parts of a study.

    Cells that need the same one are in the same part, so no part waits for another.
    """

    index: int
    count: int

    def of(self, cells: Iterable[AbstractCell]) -> list[AbstractCell]:
        """Its own cells, and those that they need."""
        heads: dict[AbstractCell, list[AbstractCell]] = {}
        for cell in cells:
            heads.setdefault(cell.needs or cell, []).append(cell)
        mine = list(heads.values())[self.index - 1 :: self.count]
        return with_needed(cell for group in mine for cell in group)


def compute_share(
    cells: Sequence[AbstractCell],
    out: Path,
    share: Share,
    *,
    workers: Workers | None,
    progress: Progress,
    old: Old = "refuse",
) -> dict[str, Any]:
    """Compute and store a share of the cells of the run at ``out``; what was done.

    Raises `InputError` E186 as `Cells.check` does.
    """
    mine = share.of(cells)
    store = store_of(mine or cells, out, old)
    with progress.task("cells", len(mine)) as task:
        compute_cells(mine, store, executor_of(workers), task)
    part = f"share {share.index} of {share.count}"
    return {
        "headline": f"Stored {part}: {len(mine)} of {len(with_needed(cells))} cells",
        "cells": str(store.folder),
        "source": store.source.digest,
    }


def join_shares(
    cells: Sequence[AbstractCell],
    out: Path,
    others: Iterable[Path] = (),
    old: Old = "refuse",
) -> Cells:
    """The cells of the run at ``out``, with those of the runs at ``others``.

    Raises `InputError` E187 where some are in none of them, and E186.
    """
    every = with_needed(cells)
    named = [(cell.name, cell.arguments) for cell in every]
    store = store_of(every, out, old)
    for other in others:
        store.adopt(store_of(every, other, old), named)
    missing = [name for name, given in named if store.load(name, given) is None]
    if missing:
        got = f"{len(missing)} of {len(every)} are missing ({missing[0]})"
        raise error("cells_missing", where=str(store.folder), got=got)
    return store
