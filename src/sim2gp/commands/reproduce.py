"""A figure of the paper, or the mismatch map: its data, the picture, its claims."""

from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from sim2gp.commands.load_run import StudyRun
from sim2gp.errors import InputError, error
from sim2gp.runs import Progress
from sim2gp.runs.cells import Old
from sim2gp.runs.store import load_run
from sim2gp.runs.workers import cores

Figure = Literal["fig1", "fig2", "fig3", "fig4", "fig5", "mismatch"]
#: Figure, and the module of `sim2gp.studies` that makes it.
FIGURES = {
    "fig1": "figure1",
    "fig2": "figure2",
    "fig3": "figure3",
    "fig4": "figure2",
    "fig5": "figure3",
    "mismatch": "mismatch",
}


def reproduce(
    figure: Figure,
    out: Path | str | None = None,
    *,
    seed: int = 0,
    seeds: int | None = None,
    episodes: int | None = None,
    quick: bool = False,
    workers: int | None = None,
    old: Old = "refuse",
    progress: Progress | None = None,
) -> StudyRun:
    """Compute what is missing of a study, check its claims, write the run.

    It is written at ``out`` (runs/NAME), with its cells in OUT.cells: a study that is
    interrupted goes on where it was. ``seeds`` and ``episodes`` None are the paper's;
    ``quick`` takes fewer; ``workers`` None are as many processes as there are cores.
    ``old`` says what to do with cells of another source (E186). Figure 1 is one run
    without cells (E160 for options that it has not).
    """
    out = Path("runs") / figure if out is None else Path(out)
    more: dict[str, Any] = {}
    if figure == "fig1":
        given = {"seeds": seeds, "episodes": episodes, "workers": workers}
        for name, value in given.items():
            if value is not None:
                raise _of_cells(name, value)
        if old != "refuse":
            raise _of_cells("keep-old" if old == "keep" else old, True)
    else:
        more = {"seeds": seeds, "episodes": episodes, "old": old}
        more["workers"] = workers or cores()
    module = FIGURES[figure]
    if module in ("figure2", "figure3"):  # of two figures each
        more["figure"] = figure
    run = import_module(f"sim2gp.studies.{module}").run
    progress = progress or Progress()
    run(out=out, seed=seed, quick=quick, progress=progress, **more)
    found = load_run(out)
    return StudyRun(found.summary, found.arrays, {}, None, out)


def _of_cells(name: str, value: object) -> InputError:
    """E160: figure 1 has no cells."""
    return error("no_cells", where="the command line", got=str(value), name=name)
