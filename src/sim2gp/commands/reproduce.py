"""A figure of the paper, or the mismatch map: its data, the picture, its claims."""

from pathlib import Path
from typing import Any, Literal

from sim2gp.commands.load_run import StudyRun
from sim2gp.runs import Progress
from sim2gp.runs.cells import Old
from sim2gp.runs.executors import Workers
from sim2gp.runs.store import load_run
from sim2gp.studies.figure1 import TwoLinkArm
from sim2gp.studies.figure2 import PosteriorSampling
from sim2gp.studies.figure3 import Exploration
from sim2gp.studies.mismatch import MismatchMap
from sim2gp.studies.study import Study

Figure = Literal["fig1", "fig2", "fig3", "fig4", "fig5", "mismatch"]
STUDIES: dict[str, type[Study]] = {
    "fig1": TwoLinkArm,
    "fig2": PosteriorSampling,
    "fig3": Exploration,
    "fig4": PosteriorSampling,
    "fig5": Exploration,
    "mismatch": MismatchMap,
}


def study_of(figure: Figure, **size: Any) -> Study:
    """The study of a figure; ``size`` as `reproduce` has it."""
    return STUDIES[figure](figure, **size)


def reproduce(
    figure: Figure,
    out: Path | str | None = None,
    *,
    seed: int = 0,
    seeds: int | None = None,
    episodes: int | None = None,
    quick: bool = False,
    workers: Workers | None = None,
    old: Old = "refuse",
    progress: Progress | None = None,
) -> StudyRun:
    """Compute what is missing of a study, check its claims, write the run.

    It is written at ``out`` (runs/NAME), with its cells in OUT.cells: a study that is
    interrupted goes on where it was. ``seeds`` (of figure 1: arms) and ``episodes``
    None are the figure's own; ``quick`` takes fewer; ``workers`` None are as many
    processes as there are cores. ``old`` says what to do with cells of another source
    (E186). Raises `InputError` E160 for ``episodes`` of figure 1, which has none.
    """
    study = study_of(figure, seed=seed, seeds=seeds, episodes=episodes, quick=quick)
    out = Path("runs") / figure if out is None else Path(out)
    progress = progress or Progress()
    study.run(out, workers=workers, progress=progress, old=old)
    found = load_run(out)
    return StudyRun(found.summary, found.arrays, {}, None, out)
