"""Stand-ins for the commands, so that the command line is tested by itself."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import pytest

from sim2gp.commands.result import AbstractResult
from sim2gp.data.logs import Log, note_lines
from sim2gp.project import Project
from sim2gp.runs import Progress


@dataclass(frozen=True)
class Returned(AbstractResult):
    """A result with a summary and nothing else."""


def install(monkeypatch: pytest.MonkeyPatch, **commands: Callable[..., Any]) -> None:
    """Put modules ``sim2gp.commands.<name>`` with a function of that name in place."""
    for name, command in commands.items():
        module = ModuleType(f"sim2gp.commands.{name}")
        setattr(module, name, command)
        monkeypatch.setitem(sys.modules, module.__name__, module)


def identify(
    project: Project,
    logs: Sequence[Log],
    *,
    seed: int,
    progress: Progress,
    check: bool = False,
    nuts: bool = False,
    held_out: bool = True,
    first: Callable[[Any], str] | None = None,
) -> Returned:
    """What an identification says of its input, and no fit."""
    with progress.task("fit", 2) as task:
        task.advance("half")
        task.advance()
    return Returned(
        {
            "n_transitions": sum(len(log) - 1 for log in logs),
            "parameters": {
                p.name: {"sd": p.sd} for p in project.system.parameters.free
            },
            "seed": seed,
            "asked": {
                "check": check,
                "nuts": nuts,
                "held_out": held_out,
            },
            "warnings": note_lines(logs),
        }
    )
