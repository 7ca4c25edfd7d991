"""What the commands share: where they write, what they read, which function they call.

Everything heavy is imported inside: help and a mistyped option cost nothing.
"""

import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from sim2gp.cli.arguments import usage_error
from sim2gp.cli.options import InCells, Reads, Spread
from sim2gp.runs import Progress, new_run
from sim2gp.runs.store import check_target, read_run


@dataclass
class Call:
    """How a command was called: what shows its progress, and the line as typed.

    ``run`` is the folder that it wrote, ``files`` are what it wrote there for others.
    """

    progress: Progress
    line: str
    run: Path | None = None
    files: tuple[str, ...] = ()

    def saved(self, out: Path, make: Callable[[], Any]) -> dict[str, Any]:
        """Write the run of the result that ``make`` returns; its summary.

        The folder is locked, and known to be writable, before the work begins.
        """
        name = self.line.split()[1]
        with new_run(out, name) as writer:
            result = make().with_entries(command_line=self.line).at(out)
            result.write(writer)
        self.run, self.files = out, tuple(str(out / name) for name in result.files)
        summary: dict[str, Any] = result.summary
        return summary


class FirstFolder:
    """The first answer of a long fit, as the run ``NAME-first`` until all is written.

    Where the fit fails it stays.
    """

    def __init__(self, out: Path) -> None:
        self.folder, self.written = out.parent / f"{out.name}-first", False
        check_target(self.folder)

    def __call__(self, answer: Any) -> str:
        answer.save(self.folder)
        self.written = True
        return str(self.folder)

    def replaced(self) -> None:
        """The whole run is written: remove the first answer."""
        if self.written:
            shutil.rmtree(self.folder, ignore_errors=True)


def run_directory(out: Path | None, name: str) -> Path:
    """The run directory; refused before the work if it is somebody else's."""
    path = Path("runs") / name if out is None else out
    check_target(path)
    return path


def read_project(path: Path, given: Reads, *, alike: bool = False) -> tuple[Any, Any]:
    """A project and its logs; their errors come before the fits are loaded."""
    project = _project(path, given)
    return project, project.load_logs(strict=given.strict, alike=alike)


def read_machines(path: Path, given: Reads, each: str) -> tuple[Any, Any]:
    """A project, and the logs of each of its machines."""
    project = _project(path, given)
    return project, project.load_each(each, strict=given.strict)


def _project(path: Path, given: Reads) -> Any:
    project = import_module("sim2gp.project").load_project(path)
    return replace(project, budget=budget(given.budget))


def identification(path: Path) -> Any:
    """An identification read back; what is no run fails before the heavy imports."""
    read_run(path)
    return function("commands.identification", "restore_identification")(path)


def budget(factor: float) -> Any:
    """So many times what one file may take to read."""
    return import_module("sim2gp.data.logs").Budget().times(factor)


def command(name: str) -> Callable[..., Any]:
    """The function of a command, imported when it runs."""
    return function(f"commands.{name}", name)


def function(module: str, name: str) -> Callable[..., Any]:
    """A function of a module of ours, imported when a command runs."""
    found: Callable[..., Any] = getattr(import_module(f"sim2gp.{module}"), name)
    return found


def share_of(given: InCells) -> Any:
    """The share that is asked for, or None (E160 for another form, or with --merge)."""
    if given.shard is None:
        return None
    found = re.fullmatch(r"(\d+)/(\d+)", given.shard)
    index, count = (int(x) for x in found.groups()) if found else (0, 0)
    if not 1 <= index <= count:
        raise usage_error("--shard", given.shard, "I/N, I from 1 to N", "write a share")
    if given.merge is not None:
        fix = "compute the shares, then join them"
        raise usage_error("--shard with --merge", "both", "one of them", fix)
    return function("runs.shares", "Share")(index, count)


def executor_of(given: Spread) -> Any:
    """Where cells are computed; None is the command's own default (E160)."""
    if given.ray is None:
        return given.workers
    if len(given.ray) > 1:
        got = " ".join(given.ray)
        raise usage_error("--ray", got, "one address", "leave the others out")
    address = given.ray[0] if given.ray else None
    cluster = function("runs.executors", "RayCluster")
    return cluster(address, given.cell_cores, given.cell_gpus)


def in_cells(
    given: InCells,
    call: Call,
    out: Path,
    cells: Sequence[Any],
    make: Callable[[Any], dict[str, Any]],
    old: str = "refuse",
) -> dict[str, Any]:
    """A share of the cells computed, or the summary of ``make(store)``.

    ``store`` has the cells of all shares where they are to be joined, else it is None.
    """
    share, executor = share_of(given), executor_of(given)
    if share is not None:
        compute = function("runs.shares", "compute_share")
        how = {"workers": executor, "progress": call.progress, "old": old}
        found: dict[str, Any] = compute(cells, out, share, **how)
        return found
    if given.merge is None:
        return make(None)
    return make(function("runs.shares", "join_shares")(cells, out, given.merge, old))
