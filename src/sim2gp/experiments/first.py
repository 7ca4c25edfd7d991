"""`sim2gp init`: a model, and logs where there are some, become a first project."""

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sim2gp.project.draft import Request, draft_project, told
from sim2gp.runs import Progress


def run(
    model: str,
    logs: Sequence[Path],
    *,
    out: Path,
    root: Path | None,
    period: float | None,
    constant: Mapping[str, float],
    readings: bool,
    seconds: float,
    progress: Progress,
) -> dict[str, Any]:
    """Write the project file; returns the summary.

    Raises `InputError` as `sim2gp.project.draft.draft_project` does.
    """
    asked = Request(
        model,
        logs,
        out,
        root=root,
        period=period,
        constant=constant,
        readings=readings,
        seconds=seconds,
        started=time.monotonic(),
    )
    progress.say("matching columns and trying how to read them")
    return told(draft_project(asked), out)
