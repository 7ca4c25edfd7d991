"""A run's report inside a notebook: `show` as the last line of a cell."""

import html
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from sim2gp.reports.document import write_report
from sim2gp.reports.template import render
from sim2gp.runs import load_run as loaded


@runtime_checkable
class HasReport(Protocol):
    """Anything that a report can be drawn of."""

    @property
    def summary(self) -> dict[str, Any]: ...
    @property
    def arrays(self) -> dict[str, np.ndarray]: ...


@dataclass(frozen=True)
class NotebookReport:
    """A report that notebooks draw; elsewhere a line of text."""

    page: str
    name: str

    def _repr_html_(self) -> str:
        """The page in a frame of its own: neither sees the other's styles."""
        return (
            f'<iframe title="{html.escape(self.name)}" sandbox="allow-scripts" '
            'style="width:100%;height:80vh;border:0" '
            f'srcdoc="{html.escape(self.page)}"></iframe>'
        )

    def __repr__(self) -> str:
        return f"report of {self.name}; a notebook shows it"


def brief(summary: Mapping[str, Any]) -> str:
    """What a notebook shows of a result: headline, warnings, and its main table."""
    columns, rows = _main_table(summary)
    said = summary.get("headline") or summary.get("title") or ""
    warned = list(dict.fromkeys(map(str, summary.get("warnings") or ())))
    return render("brief.html", said=said, warned=warned, columns=columns, rows=rows)


def _main_table(summary: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The parameters, or else the first table of the report."""
    constants = summary.get("parameters")
    if isinstance(constants, Mapping):
        columns = ["parameter", "mean", "95 % interval", "unit", "verdict"]
        rows = [
            [
                name,
                f"{p['mean']:.4g}",
                f"{p['q025']:.4g} to {p['q975']:.4g}",
                p["unit"],
                p["verdict"],
            ]
            for name, p in constants.items()
        ]
        return columns, rows
    for table in summary.get("tables", ()):
        return list(table["columns"]), [list(row) for row in table["rows"]]
    return [], []


def show(run: HasReport | Path | str) -> NotebookReport:
    """The report of a result, or of a run's folder, for a notebook.

    Raises E130, E183 or E185 for a folder that is not a finished run.
    """
    found = loaded(run) if isinstance(run, Path | str) else run
    name = str(found.summary.get("title") or found.summary.get("command"))
    return NotebookReport(write_report(found.summary, found.arrays), name)
