"""Cells of the swing-up studies: one learner on one hidden machine, episode by episode.

All learners of a seed meet the same truth under the same noise. Scores are relative to
an oracle that knows the truth: 1 is its return, 0 that of a pole left hanging.
"""

import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.planning import AbstractPlanner
from sim2gp.planning.episode import Trajectory
from sim2gp.planning.loop import psrl
from sim2gp.planning.oracle import accept_truth, episodes_in
from sim2gp.planning.tasks import MACHINES, hanging_return, score
from sim2gp.studies.learners import (
    QUICK_TRAINING,
    TRAINED,
    HiddenMachine,
    effects_of,
    planner_of,
    task_and_model,
)
from sim2gp.studies.study import AbstractCell, Key, Values, described

Table = dict[Key, Float[np.ndarray, "seeds E"]]


@dataclass(frozen=True)
class Cell(AbstractCell):
    """One learner, on one machine of one seed; ``oracle`` is a method as well.

    condition: ``nominal``, ``mismatch`` (figure 2's), or an effect of the catalogue and
        its strength, as in ``coulomb mild``.
    update_every: steps between updates within an episode; None is the paper's way.
    quick: planned with fewer sequences, by the oracle as well, and trained for less.
    planning: ``mpc``, or ``sac``; the oracle that scores are measured by is MPC's.
    """

    machine: str
    condition: str
    method: str
    seed: int
    episodes: int
    update_every: int | None = None
    quick: bool = False
    planning: str = "mpc"

    @property
    def planner(self) -> AbstractPlanner:
        """The same one for every learner."""
        return planner_of(self.quick, self.planning)

    @property
    def name(self) -> str:
        """The name of its file."""
        words = [self.machine, self.condition, self.method, str(self.seed)]
        if self.update_every is not None:
            words.append(f"every {self.update_every}")
        if self.planning != "mpc":
            words.append(self.planning)
        if self.quick:
            words.append("quick")
        return "_".join(words).replace(" ", "-")

    @property
    def arguments(self) -> dict[str, Any]:
        """All that its returns depend on, but for how many of them there are."""
        given = asdict(self) | {"planner": described(self.planner)}
        del given["episodes"], given["planning"]
        if not given.pop("quick"):
            return given
        return given | {"training": QUICK_TRAINING}

    @property
    def program(self) -> tuple[Hashable, ...]:
        """An oracle plans in the effect itself, at any strength."""
        kind = self.condition.split()[0] if self.method == "oracle" else ""
        return self.machine, self.method, self.update_every, kind

    @property
    def needs(self) -> "Cell | None":
        """The oracle of the same machine."""
        return None if self.method == "oracle" else reference(self)

    def enough(self, values: Mapping[str, Any]) -> bool:
        """Whether as many episodes were run."""
        return len(values["returns"]) >= self.episodes

    def compute(self, needed: Values | None) -> Values:
        """Returns of the oracle, or of a learner on the machine that it accepted."""
        if needed is None:
            return oracle_cell(self)
        return learner_cell(self, int(needed["redrawn"]))


def reference(cell: Cell) -> Cell:
    """The oracle's cell of the same machine."""
    return replace(cell, method="oracle", episodes=0, update_every=None, planning="mpc")


def oracle_cell(cell: HiddenMachine) -> Values:
    """Find the seed's truth, the first that its oracle swings up, and its returns."""
    make, preset = MACHINES[cell.machine]
    effects = effects_of(cell.machine, cell.condition)
    found = accept_truth(
        lambda record: preset(record, effects),
        make(),
        planner_of(cell.quick),
        key=jax.random.key(cell.seed),
    )
    return {
        "returns": found.oracle.returns.tolist(),
        "oracle_return": found.oracle.oracle_return,
        "hang_return": hanging_return(found.task),
        "redrawn": found.redrawn,
    }


def learner_cell(cell: Cell, redrawn: int) -> Values:
    """Returns of one learner; episodes after a fit that failed are not run."""
    returns: list[float] = []
    started, failure = time.perf_counter(), None
    try:
        _run_episodes(cell, redrawn, lambda done: returns.append(float(done.total)))
    except (NotConverged, NotFinite) as error:
        failure = str(error)
    seconds = time.perf_counter() - started
    return {"returns": returns, "failure": failure, "seconds": seconds}


def _run_episodes(cell: Cell, redrawn: int, note: Callable[[Trajectory], None]) -> None:
    """The episodes of a learner, or of a policy that is trained elsewhere."""
    key = jax.random.key(cell.seed)
    if cell.method in TRAINED:
        task, _ = task_and_model(cell, "SIM2GP", redrawn)
        world = TRAINED[cell.method](task, MACHINES[cell.machine][0]())
        planner, episodes = cell.planner, cell.episodes
        for done in episodes_in(task, world, planner, key=key, episodes=episodes):
            note(done)
        return
    task, model = task_and_model(cell, cell.method, redrawn)
    psrl(
        task,
        model,
        cell.planner,
        episodes=cell.episodes,
        key=key,
        history=model.history,
        update_every=cell.update_every,
        final_fit=False,
        on_episode=lambda episode: note(episode.trajectory),
    )


def scores_of(
    rows: Mapping[Key, Sequence[Cell]], values: Mapping[AbstractCell, Values]
) -> Table:
    """Scores of each row's cells."""
    return {
        key: scores(
            [values[cell] for cell in row],
            [values[reference(cell)] for cell in row],
            row[0].episodes,
        )
        for key, row in rows.items()
    }


def scores(
    values: Sequence[Mapping[str, Any]],
    references: Sequence[Mapping[str, Any]],
    episodes: int,
) -> Float[np.ndarray, "seeds E"]:
    """Score of each seed's episodes; NaN for episodes that were not run."""
    out = np.full((len(values), episodes), np.nan)
    for i, (value, oracle) in enumerate(zip(values, references, strict=True)):
        for e, total in enumerate(value["returns"][:episodes]):
            out[i, e] = score(total, oracle["hang_return"], oracle["oracle_return"])
    return out


def returns_of(values: Mapping[AbstractCell, Values]) -> dict[str, Any]:
    """What a summary says of its episodes: all returns, and truths drawn again."""
    redrawn: dict[str, int] = {}
    for cell, value in values.items():
        if isinstance(cell, Cell) and cell.method == "oracle":
            where = f"{cell.machine}, {cell.condition}"
            redrawn[where] = redrawn.get(where, 0) + int(value["redrawn"])
    return {
        "returns": {cell.name: value["returns"] for cell, value in values.items()},
        "redrawn_truths": redrawn,
    }


def best_seen(score: Float[np.ndarray, "seeds E"]) -> Float[np.ndarray, "seeds E"]:
    """The best score so far; what was not run adds nothing."""
    filled = np.where(np.isfinite(score), score, -np.inf)
    best = np.maximum.accumulate(filled, axis=1)
    return np.where(np.isfinite(best), best, 0.0)


def first_at(
    score: Float[np.ndarray, "seeds E"], solved: float
) -> Float[np.ndarray, " seeds"]:
    """The first episode, from 1, whose score is at least ``solved``; inf if never."""
    reached = np.where(np.isfinite(score), score, -np.inf) >= solved
    return np.where(reached.any(axis=1), 1.0 + reached.argmax(axis=1), np.inf)


def median_episode(episodes: Float[np.ndarray, " seeds"]) -> float:
    """The median of what may be infinite: the lower of the two middle ones."""
    return float(np.sort(episodes)[(len(episodes) - 1) // 2])
