"""Cells of the swing-up studies: one learner on one hidden machine, episode by episode.

All learners of a seed meet the same truth under the same noise. A cell holds its
returns and every argument that made them; a study is a list of cells.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from jaxtyping import Float

from sim2gp.belief import AbstractModel
from sim2gp.errors import NotConverged, NotFinite
from sim2gp.models import (
    NLM,
    Auto,
    FunctionSpace,
    PointEstimate,
    Residual,
    ResidualFunctionSpace,
    Sim2GP,
)
from sim2gp.planning import ICEM, MPC, SAC, AbstractPlanner, World
from sim2gp.planning.domain_randomisation import randomised_world
from sim2gp.planning.episode import Purpose, Trajectory, key_for, oracle_world
from sim2gp.planning.loop import psrl
from sim2gp.planning.oracle import accept_truth, episodes_in
from sim2gp.planning.tasks import MACHINES, Task, draw_truth, hanging_return, score
from sim2gp.runs import Progress
from sim2gp.runs.cells import Cells, Old
from sim2gp.studies.stages import AnyCell, described, in_stages
from sim2gp.systems import Delay, free_parts
from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.friction import RailFriction
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.effects.strengths import effect
from sim2gp.systems.parts import AbstractPart

Group = TypeVar("Group")
#: Physics that the real machine has in the mismatched cells of figure 2, fixed before
#: anything was run: a cable spring (N m/rad), strong Coulomb friction.
MISSING: dict[str, AbstractPart] = {
    "furuta": Spring("theta", 0.02),
    "cartpole": RailFriction(magnitude=0.1),
}
CONDITIONS = ("nominal", "mismatch")
WITH_TERM = "SIM2GP with the term"
#: Model-predictive control, and off-policy learning in the sampled world.
PLANNERS: dict[str, AbstractPlanner] = {"mpc": MPC(), "sac": SAC()}
#: Of a quick look: three sequences in eight, in the same proportions, policies trained
#: for a third as long, and networks for a quarter.
QUICK_PLANNERS: dict[str, AbstractPlanner] = {
    "mpc": MPC(update=ICEM(samples=60, elites=6)),
    "sac": SAC(updates=10),
}
QUICK_TRAINING = {"steps": 500, "refit_steps": 200}
PERIOD = 0.02  # s, of the control on every task


#: Of a learner's network: ``reach`` and, for a quick look, its steps.
Options = Mapping[str, Any]


def _with_term(
    system: AbstractPlant, missing: AbstractPart, options: Options
) -> AbstractModel:
    del options
    if isinstance(missing, Delay):  # its magnitude bounds a candidate's delay
        missing = replace(missing, magnitude=2.0 * missing.magnitude)
    return Sim2GP(free_parts(system, [missing], period=PERIOD))


def _auto(
    system: AbstractPlant, missing: AbstractPart, options: Options
) -> AbstractModel:
    del missing
    sim = Sim2GP(system)
    return Auto([sim, Residual(sim, **options), ResidualFunctionSpace(sim, **options)])


#: Each learner, made of the simulator, the physics that it lacks, and its options.
METHODS: dict[str, Callable[[AbstractPlant, AbstractPart, Options], AbstractModel]] = {
    "SIM2GP": lambda system, _, __: Sim2GP(system),
    "point estimate": lambda system, _, __: PointEstimate(Sim2GP(system)),
    "NLM": lambda system, _, options: NLM(system, **options),
    "RES": lambda system, _, options: Residual(Sim2GP(system), **options),
    "FS literal": lambda system, _, options: FunctionSpace(
        Sim2GP(system), objective="literal", **options
    ),
    "FS": lambda system, _, options: FunctionSpace(Sim2GP(system), **options),
    "RES-FS": lambda system, _, options: ResidualFunctionSpace(
        Sim2GP(system), **options
    ),
    "Auto": _auto,
    WITH_TERM: _with_term,
}


#: Trained in a world that real episodes do not change; and in which one.
TRAINED: dict[str, Callable[[Task, AbstractPlant], World]] = {
    "off-policy oracle": lambda task, _: oracle_world(task),
    "domain randomisation": lambda task, system: randomised_world(
        task, system, Sim2GP(system).prior
    ),
}


def planner_of(quick: bool, planning: str = "mpc") -> AbstractPlanner:
    """The planner of a whole study, or of a quick look."""
    return (QUICK_PLANNERS if quick else PLANNERS)[planning]


def reach_of(task: Task, system: AbstractPlant) -> dict[str, float]:
    """The box of states that models are trusted in, by channel."""
    bound = np.asarray(task.trusted, float).tolist()
    pairs = zip(system.states, bound, strict=True)
    return {channel.name: half for channel, half in pairs if np.isfinite(half)}


@dataclass(frozen=True)
class Cell:
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
        """Whoever learns, it is the same one."""
        return planner_of(self.quick, self.planning)

    @property
    def name(self) -> str:
        """Of its file."""
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
        told = asdict(self) | {"planner": described(self.planner)}
        del told["episodes"], told["planning"]
        if not told.pop("quick"):
            return told
        return told | {"training": QUICK_TRAINING}


def missing(machine: str, condition: str) -> AbstractPart:
    """The physics that a condition is about; the nominal one has figure 2's."""
    if condition in CONDITIONS:
        return MISSING[machine]
    name, strength = condition.split()
    return effect(machine, name, strength)


def effects_of(machine: str, condition: str) -> tuple[AbstractPart, ...]:
    """What the real machine has and its simulator lacks.

    Nominal is figure 2's effect of no magnitude: both conditions are one program.
    """
    lacking = missing(machine, condition)
    if condition == "nominal":
        lacking = replace(lacking, magnitude=0.0)
    return (lacking,)


def oracle_cell(cell: AnyCell) -> dict[str, Any]:
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


def meeting(
    cell: AnyCell, method: str, redrawn: int
) -> tuple[Task, AbstractModel, int]:
    """A seed's hidden machine, a learner, and the past actions in its state."""
    make, preset = MACHINES[cell.machine]
    system, key = make(), jax.random.key(cell.seed)
    record = draw_truth(system, key_for(key, redrawn, Purpose.TRUTH))
    task = preset(record, effects_of(cell.machine, cell.condition))
    lacking = missing(cell.machine, cell.condition)
    options: dict[str, Any] = {"reach": reach_of(task, system)}
    options |= QUICK_TRAINING if cell.quick else {}
    model = METHODS[method](system, lacking, options)
    return task, model, model.history


def learner_cell(cell: Cell, redrawn: int) -> dict[str, Any]:
    """Fly one learner; an episode after a fit that failed was not flown."""
    returns: list[float] = []
    started, failure = time.perf_counter(), None
    try:
        _run_episodes(cell, redrawn, lambda flown: returns.append(float(flown.total)))
    except (NotConverged, NotFinite) as error:
        failure = str(error)
    seconds = time.perf_counter() - started
    return {"returns": returns, "failure": failure, "seconds": seconds}


def _run_episodes(cell: Cell, redrawn: int, note: Callable[[Trajectory], None]) -> None:
    """The episodes of a learner, or of a policy that is trained elsewhere."""
    key = jax.random.key(cell.seed)
    if cell.method in TRAINED:
        task, _, _ = meeting(cell, "SIM2GP", redrawn)
        world = TRAINED[cell.method](task, MACHINES[cell.machine][0]())
        planner, episodes = cell.planner, cell.episodes
        for flown in episodes_in(task, world, planner, key=key, episodes=episodes):
            note(flown)
        return
    task, model, history = meeting(cell, cell.method, redrawn)
    psrl(
        task,
        model,
        cell.planner,
        episodes=cell.episodes,
        key=key,
        history=history,
        update_every=cell.update_every,
        final_fit=False,
        on_episode=lambda episode: note(episode.trajectory),
    )


def run_cell(cell: Cell, out: Path, old: Old = "refuse") -> dict[str, Any]:
    """A cell's values, from the disk if it was run for as many episodes (E186)."""
    cells = Cells(out, __file__, old)
    stored = cells.load(cell.name, cell.arguments)
    if stored is not None and (
        len(stored["returns"]) >= cell.episodes or stored.get("failure")
    ):
        return stored
    if cell.method == "oracle":
        values = oracle_cell(cell)
    else:
        oracle = run_cell(reference(cell), out, old)
        values = learner_cell(cell, int(oracle["redrawn"]))
    return cells.save(cell.name, cell.arguments, values)


def study(
    groups: Mapping[Group, Cell],
    seeds: Sequence[int],
    out: Path,
    *,
    workers: int,
    progress: Progress,
    old: Old = "refuse",
) -> tuple[dict[Group, Float[np.ndarray, "seeds E"]], dict[str, Any]]:
    """Scores of each group's cell, run with every seed, and what a summary says.

    Raises `InputError` E186 before the first episode for stored cells that this source
    did not compute, and ``old`` does not allow.
    """
    cells = {
        group: [replace(cell, seed=seed) for seed in seeds]
        for group, cell in groups.items()
    }
    every = list(chain.from_iterable(cells.values()))
    whole = workers <= len({cell.machine for cell in every})

    def alike(cell: Cell) -> Any:
        # An oracle plans in the effect itself, at any strength.
        kind = cell.condition.split()[0] if cell.method == "oracle" else ""
        learner = cell.method, cell.update_every, kind
        return cell.machine if whole else (cell.machine, *learner)

    stages = (list(dict.fromkeys(map(reference, every))), every)
    stored = Cells(out, __file__, old)
    named = [(cell.name, cell.arguments) for cell in dict.fromkeys(chain(*stages))]
    stored.check(named)
    work = partial(run_cell, out=out, old=old)
    flown = in_stages(stages, work, alike, workers=workers, progress=progress)
    table = {
        group: scores(
            [flown[cell] for cell in row],
            [flown[reference(cell)] for cell in row],
            groups[group].episodes,
        )
        for group, row in cells.items()
    }
    return table, told(flown) | stored.summary(named)


def reference(cell: Cell) -> Cell:
    """The oracle's cell of the same machine."""
    return replace(cell, method="oracle", episodes=0, update_every=None, planning="mpc")


def scores(
    values: Sequence[Mapping[str, Any]],
    references: Sequence[Mapping[str, Any]],
    episodes: int,
) -> Float[np.ndarray, "seeds E"]:
    """Score of each seed's episodes; NaN for episodes that were not flown."""
    out = np.full((len(values), episodes), np.nan)
    for i, (value, oracle) in enumerate(zip(values, references, strict=True)):
        for e, total in enumerate(value["returns"][:episodes]):
            out[i, e] = score(total, oracle["hang_return"], oracle["oracle_return"])
    return out


def best_seen(score: Float[np.ndarray, "seeds E"]) -> Float[np.ndarray, "seeds E"]:
    """The best score so far; what was not flown adds nothing."""
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


def told(flown: Mapping[Cell, Mapping[str, Any]]) -> dict[str, Any]:
    """What a summary says of its cells: returns, failures, redrawn truths, seconds."""
    spent: dict[str, float] = {}
    redrawn: dict[str, int] = {}
    for cell, value in flown.items():
        if cell.method == "oracle":
            where = f"{cell.machine}, {cell.condition}"
            redrawn[where] = redrawn.get(where, 0) + int(value["redrawn"])
        else:
            spent[cell.method] = spent.get(cell.method, 0.0) + value["seconds"]
    return {
        "returns": {cell.name: value["returns"] for cell, value in flown.items()},
        "fits_not_converged": [
            f"{cell.name}: {value['failure']}"
            for cell, value in flown.items()
            if value.get("failure")
        ],
        "redrawn_truths": redrawn,
        "seconds_of_cells": spent,
    }
