"""A run's report inside a notebook: `show` as the last line of a cell."""

import html
from dataclasses import dataclass
from pathlib import Path

from sim2gp.reports.document import write_report
from sim2gp.runs import Run
from sim2gp.runs import load_run as loaded


@dataclass(frozen=True)
class Shown:
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


def show(run: Run | Path | str) -> Shown:
    """The report of a run, of its folder or as `load_run` reads it, for a notebook.

    Raises E130, E183 or E185 for a folder that is not a finished run.
    """
    found = run if isinstance(run, Run) else loaded(run)
    return Shown(write_report(found.summary, found.arrays), str(found.path))
