"""`sim2gp init`: a model, and logs where there are some, become a first project."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

from sim2gp.cleanup import replace_file
from sim2gp.data.logs import Budget
from sim2gp.experiment_design.safe_excitation import PERIOD, Excitation, safe_excitation
from sim2gp.project.draft import Request, draft_project, draft_summary
from sim2gp.runs import Progress
from sim2gp.runs.store import check_absent
from sim2gp.systems.base import AbstractSystem


def init(
    model: Path | str,
    logs: Sequence[Path | str] = (),
    *,
    out: Path | str | None = None,
    root: Path | None = None,
    period: float | None = None,
    constant: Mapping[str, float] | None = None,
    columns: Mapping[str, str] | None = None,
    readings: bool = True,
    seconds: float = 60.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the project file ``out``, and without logs a first experiment; the summary.

    ``model`` is a bundled machine's name or a model's file, whose name is ``out``'s
    where that is None. ``root`` holds all files of the model, ``period`` is the time
    between rows in s where no column says it, ``constant`` the inputs without a column.
    ``columns`` has those of channels whose names do not say it.
    ``readings`` tries signs, units and zeros, in so many ``seconds``. Raises
    `InputError` as `sim2gp.project.draft.draft_project` does, and E132 where ``out``
    exists.
    """
    progress = progress or Progress()
    out = Path(f"{Path(model).stem}.toml" if out is None else out)
    check_absent(out)
    asked = Request(
        str(model),
        [Path(log) for log in logs],
        out,
        root=root,
        period=period,
        constant=constant or {},
        columns=columns or {},
        readings=readings,
        seconds=seconds,
        started=time.monotonic(),
        budget=Budget().times(max(1.0, seconds / 60.0)),  # of reading: more on request
    )
    table = out.with_name(f"{out.stem}-experiment.csv")
    if not logs:
        check_absent(table)
    with progress.task("init", 3 if logs else 2, alike=False) as task:
        draft = draft_project(replace(asked, step=task.advance))
        summary = draft_summary(draft, out)
        if logs:
            return summary
        headline = f"Wrote {out}, which says what a log needs"
        if not draft.system.actions:
            task.advance("no experiment: the machine has no inputs")
            return summary | {"headline": headline}
        until = asked.started + seconds
        found = safe_excitation(draft.system, key=jax.random.key(seed), until=until)
        task.advance("a first experiment")
    better = f"sim2gp design {out} (slow on a MuJoCo model)"
    headline += f"; for an experiment that is chosen for its information: {better}"
    entries = _experiment(draft.system, found, table)
    return summary | {"headline": headline} | entries


def _experiment(
    system: AbstractSystem, found: Excitation, table: Path
) -> dict[str, Any]:
    """What is said of a first experiment; its commands are written, if it has any."""
    entries = {"experiment": found.words}
    if found.commands is None or found.states is None:
        return entries
    replace_file(table, _csv(system, found).encode(), lambda _: None)
    return entries | {"commands": str(table)}


def _csv(system: AbstractSystem, found: Excitation) -> str:
    """A row for each period: time, commands, and the positions expected."""
    names = [c.name for c in system.physical_states]
    shown = [i for i, name in enumerate(names) if not name.endswith(".velocity")]
    inputs = [c.name for c in system.actions]
    text = [",".join(["time", *inputs, *(f"expected.{names[i]}" for i in shown)])]
    assert found.commands is not None
    assert found.states is not None
    for k, (u, x) in enumerate(zip(found.commands, found.states, strict=True)):
        text.append(",".join(f"{v:.9g}" for v in (PERIOD * k, *u, *x[shown])))
    return "\n".join(text) + "\n"
