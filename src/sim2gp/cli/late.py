"""What the commands share: where they write, what they read, which function they call.

Everything heavy is imported inside: help and a mistyped option cost nothing.
"""

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

from sim2gp.cli.options import Reads
from sim2gp.runs.store import check_target

#: Figure, and the module of `sim2gp.studies` that makes it.
FIGURES = {
    "fig1": "figure1",
    "fig2": "figure2",
    "fig3": "figure3",
    "fig4": "figure2",
    "fig5": "figure3",
    "mismatch": "mismatch",
}


def run_directory(out: Path | None, name: str) -> Path:
    """The run directory; refused before the work if it is somebody else's."""
    path = Path("runs") / name if out is None else out
    check_target(path)
    return path


def read_project(path: Path, given: Reads, *, alike: bool = False) -> tuple[Any, Any]:
    """A project and its logs; their errors come before the fits are loaded."""
    project = import_module("sim2gp.project").load_project(path)
    project = replace(project, budget=budget(given.budget))
    return project, project.load_logs(strict=given.strict, alike=alike)


def budget(factor: float) -> Any:
    """So many times what one file may take to read."""
    return import_module("sim2gp.data.logs").Budget().times(factor)


def function(module: str, name: str = "run") -> Callable[..., Any]:
    """A function of a module of ours, imported when a command runs."""
    found: Callable[..., Any] = getattr(import_module(f"sim2gp.{module}"), name)
    return found
