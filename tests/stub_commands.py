"""Stand-ins for the experiments, so that the command line is tested by itself."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from sim2gp.data.logs import Log, note_lines
from sim2gp.project import Project
from sim2gp.runs import Progress, new_run


def install(
    monkeypatch: pytest.MonkeyPatch, **runs: Callable[..., dict[str, Any]]
) -> None:
    """Put modules ``sim2gp.commands.<name>`` with the given ``run`` in place."""
    parent = ModuleType("sim2gp.commands")
    parent.__path__ = []
    monkeypatch.setitem(sys.modules, "sim2gp.commands", parent)
    for name, run in runs.items():
        module = ModuleType(f"sim2gp.commands.{name}")
        module.run = run  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)


def identify(
    project: Project,
    logs: Sequence[Log],
    *,
    out: Path,
    seed: int,
    progress: Progress,
    check: bool = False,
    nuts: bool = False,
    longer: bool = False,
    held_out: bool = True,
) -> dict[str, Any]:
    """What an identification says of its input, and no fit."""
    summary = {
        "n_transitions": sum(len(log) - 1 for log in logs),
        "parameters": {p.name: {"sd": p.sd} for p in project.system.parameters.free},
        "seed": seed,
        "check": check,
        "nuts": nuts,
        "longer": longer,
        "held_out": held_out,
        "warnings": note_lines(logs),
    }
    with new_run(out, "identify") as run, progress.task("fit", 2) as task:
        task.advance("half")
        run.write_summary(summary)
        task.advance()
    return summary
