"""A project and its logs, as the folds of a command share them, here or elsewhere."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from sim2gp.data.logs import Log
from sim2gp.errors import error
from sim2gp.project import Project, load_project
from sim2gp.runs.cell_work import AbstractCell, Values, compute_cells
from sim2gp.runs.cells import Cells
from sim2gp.runs.executors import Workers, executor_of
from sim2gp.runs.progress import Progress, Task
from sim2gp.systems.machine import plant_of

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class Recordings:
    """What is fitted and forecast; another process reads the project's file again.

    What a process makes of it, it keeps for its next fold.
    """

    project: Project
    logs: tuple[Log, ...]
    _kept: dict[str, tuple[object, Any]] = field(default_factory=dict)

    @cached_property
    def digest(self) -> str:
        """A short name of the project's text, its model's files, and the logs."""
        found = hashlib.sha256(self.project.source.text.encode("utf-8"))
        if self.project.chosen_window is not None:
            found.update(f"window {self.project.chosen_window!r} ".encode())
        for name, content in self._contents():
            found.update(f"{name} {len(content)} ".encode())
            found.update(content)
        return found.hexdigest()[:16]

    def _contents(self) -> Iterator[tuple[str, bytes]]:
        """Names and bytes of files and columns."""
        source = getattr(plant_of(self.project.system), "source", None)
        if source is not None:
            from sim2gp.systems.mujoco.sources import read_sources

            files = read_sources(source, None)
            yield "model", files.main
            yield from sorted((files.texts | files.assets).items())
        for log in self.logs:
            yield f"{log.name} {log.source} {log.group}", np.asarray(log.time).tobytes()
            for table in (log.channels, log.inputs, log.mask, log.fixed):
                for name, values in sorted(table.items()):
                    yield name, np.asarray(values).tobytes()

    def without(self, left: Sequence[int]) -> str:
        """What is left out, for people: by the first of the logs ``left``."""
        return f"without {self.logs[left[0]].name}"

    def kept(self, name: str, about: object, make: Callable[[], Made]) -> Made:
        """What ``make`` returns, kept under its name until ``about`` is another."""
        if self._kept.get(name, (None, None))[0] != about:
            self._kept[name] = about, make()
        found: Made = self._kept[name][1]
        return found

    def __reduce__(self) -> tuple[Any, ...]:
        project = self.project
        source = project.path, project.source.text, project.chosen_window
        return _read_again, (*source, self.logs, self.digest)


class AbstractFolds(ABC, Generic[Made]):
    """Cells that leave some recordings out, and what their values are together.

    ``alone``: of something that no other process can be sent.
    """

    recordings: Recordings
    cells: Sequence[AbstractCell]
    alone: bool = False
    #: Of a command's progress: its name, and parts after the cells.
    title: ClassVar[str]
    after: ClassVar[int] = 0

    @abstractmethod
    def result(self, values: Mapping[AbstractCell, Values], task: Task) -> Made:
        """Of the values of all cells."""

    def run(
        self,
        workers: Workers | None,
        progress: Progress | None,
        store: Cells | None = None,
    ) -> Made:
        """Cells that ``store`` does not have are computed, if need be here."""
        alone = self.alone or not self.recordings.project.can_be_loaded
        executor = executor_of(1 if alone else workers or 1)
        total = len(self.cells) + self.after
        with (progress or Progress()).task(self.title, total) as task:
            values = compute_cells(self.cells, store, executor, task)
            return self.result(values, task)


_KNOWN: dict[str, Recordings] = {}


def _read_again(
    path: Path, text: str, window: float | None, logs: tuple[Log, ...], digest: str
) -> Recordings:
    """The same in this process, which keeps the last one with all that it compiled."""
    if digest not in _KNOWN:
        project = load_project(path)
        if project.source.text != text:
            raise error(
                "project_changed_since_run",
                where=str(path),
                got="another text than when the command began",
                fix="run the command again",
            )
        _KNOWN.clear()
        project = replace(project, chosen_window=window)
        _KNOWN[digest] = Recordings(project, logs)
    return _KNOWN[digest]
