"""The windows of a project's logs that its machine is fitted to."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cuts_of
from sim2gp.data.windows import Windows, evenly_spread
from sim2gp.project import Project
from sim2gp.systems.host import simulator_of

#: Rows of windows, steps of their simulation included, that are fitted all at once.
MANY = 100_000
#: Windows of any length that stand for all.
FEWEST = 10


def cut_logs(
    project: Project, logs: Sequence[Log]
) -> tuple[Windows, Int[np.ndarray, " W"]]:
    """Training windows as the project states them, and the log of each."""
    cuts = _cuts(project, logs)
    return cuts.whole(), cuts.places[:, 0]


class TrainingWindows(NamedTuple):
    """Windows to fit, the log and first row of each, and how many there are in all."""

    windows: Windows | Cuts
    places: Int[np.ndarray, "W 2"]
    total: int

    def is_whole(self) -> bool:
        """Whether these are all."""
        return len(self.windows) == self.total


def cut_for_fit(
    project: Project, logs: Sequence[Log], *, some: bool = False
) -> TrainingWindows:
    """Training windows; of so many rows that they are fitted in parts, as `Cuts`.

    With ``some`` never as `Cuts`: of so many rows, windows that are spread over all, as
    many as are fitted all at once.
    """
    cuts = _cuts(project, logs)
    most, places, total = MANY // cuts.length, cuts.places, len(cuts)
    if total <= most or simulator_of(project.system) is not None:
        return TrainingWindows(cuts.whole(), places, total)
    if not some:
        return TrainingWindows(cuts, places, total)
    which = evenly_spread(max(FEWEST, most), total)
    return TrainingWindows(cuts.some(which), places[which], total)


def _cuts(project: Project, logs: Sequence[Log]) -> Cuts:
    stated = project.spec.likelihood
    names = [channel.name for channel in project.system.physical_states]
    measured = [n for n in names if any(n in log.channels for log in logs)]
    return cuts_of(
        logs,
        project.system,
        window=project.window,
        start_sd=_for_each_channel(stated.start_sd, names),
        floor=_for_each_channel(stated.noise_floor, measured),
        start=stated.start,
    )


def _for_each_channel(
    value: float | dict[str, float] | None, names: Sequence[str]
) -> dict[str, float] | None:
    """A single number holds for every channel."""
    return dict.fromkeys(names, value) if isinstance(value, float) else value
