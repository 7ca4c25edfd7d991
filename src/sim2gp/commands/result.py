"""What a command returns: everything that its run directory will hold, in memory."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sim2gp.cleanup import replace_file
from sim2gp.project import Project
from sim2gp.runs import new_run
from sim2gp.runs.store import ARRAYS, Writer, check_absent

REPORT = "report.html"
R = TypeVar("R", bound="AbstractResult")
PROJECT = "project.toml"  # the project file's name in a run


@dataclass(frozen=True, repr=False)
class AbstractResult:
    """The summary of a command (``summary.json``), its arrays and its further files.

    ``path`` is the run that it was read from. ``project`` is set where the run keeps a
    copy of its project file.
    """

    summary: dict[str, Any]
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)
    project: Project | None = None
    path: Path | None = None

    @property
    def name(self) -> str:
        """Of the run, or of its project file."""
        if self.path is not None:
            return Path(os.path.abspath(self.path)).name
        return self.project.name if self.project else str(self.summary["command"])

    def to_dict(self) -> dict[str, Any]:
        """The summary: what ``summary.json`` holds."""
        return dict(self.summary)

    def page(self) -> str:
        """The report, one self-contained HTML document."""
        from sim2gp.reports import write_report

        return write_report(self.summary, self.arrays)

    def with_entries(self: R, **entries: Any) -> R:
        """The same with more, or other, entries of the summary."""
        return replace(self, summary=self.summary | entries)

    def save(self, place: Path | str) -> Path:
        """Write the run directory, as the command line does (E132, E190, E191).

        A name with the ending of one of the run's files, such as ``next.csv``, gets
        that file alone (E132 where it exists).
        """
        folder = Path(place)
        for name, text in self.files.items():
            if folder.suffix and folder.suffix == Path(name).suffix:
                check_absent(folder)
                replace_file(folder, text.encode(), lambda _: None)
                return folder
        with new_run(folder, str(self.summary["command"])) as writer:
            self.at(folder).write(writer)
        return folder

    def at(self: R, folder: Path) -> R:
        """The same, with the summary that ``folder`` will have."""
        if self.project is None:
            return self
        return self.with_entries(project=_project_place(self.project, folder))

    def write(self, writer: Writer) -> None:
        """Write all files of a run."""
        writer.write_summary(self.summary)
        if self.arrays:
            writer.write_arrays(ARRAYS, self.arrays)
        if self.project is not None:
            writer.write_text(PROJECT, self.project.source.text)
        for name, text in self.files.items():
            writer.write_text(name, text)
        writer.write_text(REPORT, self.page())

    def __repr__(self) -> str:
        said = self.summary.get("headline") or self.summary.get("title") or ""
        warned = dict.fromkeys(map(str, self.summary.get("warnings") or ()))
        return "\n".join([f"{type(self).__name__}: {said}", *warned])

    def _repr_html_(self) -> str:
        from sim2gp.reports.notebook import brief

        return brief(self.summary)


def numeric_entries(table: Mapping[str, Any] | None) -> dict[str, float]:
    """The entries of a table of the summary that are numbers."""
    return {k: float(v) for k, v in (table or {}).items() if v is not None}


def _project_place(project: Project, run: Path) -> dict[str, str]:
    """Where the project file is, seen from the run."""
    folder = Path(os.path.abspath(project.path)).parent
    place = os.path.relpath(folder, os.path.abspath(run))
    return {"file": project.path.name, "folder": place}
