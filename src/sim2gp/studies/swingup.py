"""Cells of the swing-up studies: one learner on one hidden machine, episode by episode.

All learners of a seed meet the same truth under the same noise. Scores are relative to
an oracle that knows the truth: 1 is its return, 0 that of a pole left hanging.
"""

import time
from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.errors import NotConverged, NotFinite
from sim2gp.models import Sim2GPBelief
from sim2gp.planning import MPC, AbstractPlanner, MarkovObjective
from sim2gp.planning.episode import Trajectory
from sim2gp.planning.loop import SamplingRun
from sim2gp.planning.oracle import AcceptedTruth, accept_truth, episodes_in
from sim2gp.planning.tasks import MACHINES, Task, hanging_return, score
from sim2gp.planning.together import accept_together, host, learn_together
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies.learners import (
    CONDITIONS,
    QUICK_TRAINING,
    TRAINED,
    HiddenMachine,
    effects_of,
    misfit_of_belief,
    missing,
    planner_of,
    task_and_model,
)
from sim2gp.studies.study import Key, described
from sim2gp.systems.parts import AbstractPart

#: Scores by row; a row has seeds of its own.
Table = dict[Key, Float[np.ndarray, "_ E"]]


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
    def missing(self) -> AbstractPart:
        """The physics that the condition is about."""
        return missing(self.machine, self.condition)

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
    def kind(self) -> str:
        """What the real machine has, at any strength."""
        return "figure 2" if self.condition in CONDITIONS else self.condition.split()[0]

    @property
    def program(self) -> tuple[Hashable, ...]:
        """An oracle plans in the effect itself."""
        kind = self.kind if self.method == "oracle" else ""
        return self.machine, self.method, self.update_every, kind

    @property
    def batch(self) -> Hashable:
        """All seeds and strengths, where MPC plans in one draw for a whole episode."""
        if self.planning != "mpc" or self.update_every or self.method in TRAINED:
            return self
        return self.machine, self.method, self.kind, self.episodes, self.quick

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

    @classmethod
    def compute_batch(
        cls, cells: Sequence[Any], needed: Sequence[Values | None]
    ) -> list[Values]:
        """As one program: each as alone, up to the rounding of float32."""
        redrawn = [int(x["redrawn"]) for x in needed if x is not None]
        if cells[0].batch == cells[0]:
            return super().compute_batch(cells, needed)
        with host():
            return learner_cells(cells, redrawn) if redrawn else oracle_cells(cells)


def reference(cell: Cell) -> Cell:
    """The oracle's cell of the same machine."""
    return replace(cell, method="oracle", episodes=0, update_every=None, planning="mpc")


def oracle_cell(cell: HiddenMachine) -> Values:
    """Find the seed's truth, the first that its oracle swings up, and its returns."""
    make, preset = MACHINES[cell.machine]
    effects = effects_of(cell)
    found = accept_truth(
        lambda record: preset(record, effects),
        make(),
        planner_of(cell.quick),
        key=jax.random.key(cell.seed),
    )
    return _accepted(found)


def oracle_cells(cells: Sequence[HiddenMachine]) -> list[Values]:
    """`oracle_cell` of each, on one machine."""
    make, preset = MACHINES[cells[0].machine]
    every = [effects_of(cell) for cell in cells]
    planner = planner_of(cells[0].quick)
    assert isinstance(planner, MPC)
    found = accept_together(
        [partial(preset, effects=effects) for effects in every],
        make(),
        planner,
        keys=[jax.random.key(cell.seed) for cell in cells],
    )
    return [_accepted(each) for each in found]


def _accepted(found: AcceptedTruth) -> Values:
    return {
        "returns": found.oracle.returns.tolist(),
        "oracle_return": found.oracle.oracle_return,
        "hang_return": hanging_return(found.task),
        "redrawn": found.redrawn,
    }


def learner_cell(cell: Cell, redrawn: int) -> Values:
    """Returns of one learner; episodes after a fit that failed are not run."""
    started, failure = time.perf_counter(), ""
    seen: list[Trajectory] = []
    found: Values = {}
    try:
        if cell.method in TRAINED:
            seen += _trained(cell, redrawn)
        else:
            run = _sampling(cell, redrawn)
            seen = run.trajectories
            _learn(run, cell)
            found = found_by(run)
    except (NotConverged, NotFinite) as error:
        failure = str(error)
    task, _ = task_and_model(cell, "SIM2GP", redrawn)
    return _learned(task, seen, failure, time.perf_counter() - started) | found


def learner_cells(cells: Sequence[Cell], redrawn: Sequence[int]) -> list[Values]:
    """`learner_cell` of each, all with one learner; seconds are shared out."""
    started = time.perf_counter()
    runs = [_sampling(*pair) for pair in zip(cells, redrawn, strict=True)]
    ended = learn_together(runs, cells[0].episodes)
    pairs = list(zip(runs, ended, strict=True))
    found = [{} if failure else found_by(run) for run, (_, failure) in pairs]
    seconds = (time.perf_counter() - started) / len(cells)
    return [
        _learned(run.task, *each, seconds) | more
        for (run, each), more in zip(pairs, found, strict=True)
    ]


def _learned(
    task: Task, seen: Sequence[Trajectory], failure: str, seconds: float
) -> Values:
    """Of each episode its return, and whether the pole stayed up in its last second."""
    return {
        "returns": [float(trajectory.total) for trajectory in seen],
        "reached": [
            bool(task.reached(jnp.asarray(trajectory.state))) for trajectory in seen
        ],
        "failure": failure or None,
        "seconds": seconds,
    }


def found_by(run: SamplingRun) -> Values:
    """What a simulator's last fit has found: forces, and whether data contradict it.

    Residuals are those of all episodes. The last one was not fitted, but what it would
    have moved is projected out of them. A step that is no number contradicts as well.
    """
    belief = run.belief
    if not isinstance(belief, Sim2GPBelief) or not int(belief.count):
        return {}
    try:
        with host():
            contradicted = misfit_of_belief(belief, run.data).alarm
    except NotFinite:
        contradicted = True
    forces = list(belief.system.parameters.groups)
    return {"forces": forces, "contradicted": contradicted}


def _sampling(cell: Cell, redrawn: int) -> SamplingRun:
    """A cell's learner before its first episode."""
    task, model = task_and_model(cell, cell.method, redrawn)
    objective = MarkovObjective(task.reward)
    return SamplingRun(
        task,
        model,
        cell.planner,
        lambda _: objective,
        cell.episodes,
        jax.random.key(cell.seed),
        model.history,
    )


def _learn(run: SamplingRun, cell: Cell) -> None:
    """A learner's episodes, each before its fit."""
    for _ in range(cell.episodes):
        if run.trajectories:
            run.fit()
        run.next(cell.update_every)


def _trained(cell: Cell, redrawn: int) -> Iterator[Trajectory]:
    """Episodes of a policy trained elsewhere."""
    task, _ = task_and_model(cell, "SIM2GP", redrawn)
    world = TRAINED[cell.method](task, MACHINES[cell.machine][0]())
    key, planner = jax.random.key(cell.seed), cell.planner
    return episodes_in(task, world, planner, key=key, episodes=cell.episodes)


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
