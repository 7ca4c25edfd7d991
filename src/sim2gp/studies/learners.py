"""Who is compared: learners, the physics that their simulator lacks, and planners."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import jax
import numpy as np

from sim2gp.belief import AbstractModel
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.identification.misfit.residuals import misfit_of_transitions
from sim2gp.identification.misfit.tests import Misfit
from sim2gp.models import (
    NLM,
    Auto,
    FunctionSpace,
    MissingForces,
    PointEstimate,
    Residual,
    ResidualFunctionSpace,
    Sim2GP,
    Sim2GPBelief,
)
from sim2gp.planning import ICEM, MPC, SAC, AbstractPlanner, World
from sim2gp.planning.domain_randomisation import randomised_world
from sim2gp.planning.episode import Purpose, key_for, oracle_world
from sim2gp.planning.tasks import MACHINES, Task, draw_truth
from sim2gp.systems import Delay, free_parts
from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.friction import RailFriction
from sim2gp.systems.effects.springs import Spring
from sim2gp.systems.effects.strengths import effect
from sim2gp.systems.parts import AbstractPart

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
    sim, forces = Sim2GP(system), _missing_forces(system, missing, options)
    residuals = Residual(sim, **options), ResidualFunctionSpace(sim, **options)
    return Auto([forces, *residuals])


def _missing_forces(
    system: AbstractPlant, missing: AbstractPart, options: Options
) -> AbstractModel:
    del missing
    return MissingForces(Sim2GP(system), reach=options["reach"])


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
    "MissingForces": _missing_forces,
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


def misfit_of_belief(belief: Sim2GPBelief, data: Transitions) -> Misfit:
    """Whether transitions contradict a fitted simulator."""
    likelihood = OneStepLikelihood(belief.system, data, belief.dt)
    about = belief.prior, belief.posterior, belief.noise
    return misfit_of_transitions(likelihood, *about)


@runtime_checkable
class HiddenMachine(Protocol):
    """What a cell says of the machine that its learner meets."""

    @property
    def machine(self) -> str: ...
    @property
    def condition(self) -> str: ...
    @property
    def missing(self) -> AbstractPart: ...
    @property
    def seed(self) -> int: ...
    @property
    def quick(self) -> bool: ...


def missing(machine: str, condition: str) -> AbstractPart:
    """The physics that a condition is about; the nominal one has figure 2's."""
    if condition in CONDITIONS:
        return MISSING[machine]
    name, strength = condition.split()
    return effect(machine, name, strength)


def effects_of(cell: HiddenMachine) -> tuple[AbstractPart, ...]:
    """What the real machine has and its simulator lacks.

    Nominal is figure 2's effect of no magnitude: both conditions are one program.
    """
    if cell.condition == "nominal":
        return (replace(cell.missing, magnitude=0.0),)
    return (cell.missing,)


def task_and_model(
    cell: HiddenMachine, method: str, redrawn: int
) -> tuple[Task, AbstractModel]:
    """A seed's hidden machine, and a learner for it."""
    make, preset = MACHINES[cell.machine]
    system, key = make(), jax.random.key(cell.seed)
    record = draw_truth(system, key_for(key, redrawn, Purpose.TRUTH))
    task = preset(record, effects_of(cell))
    options: dict[str, Any] = {"reach": reach_of(task, system)}
    options |= QUICK_TRAINING if cell.quick else {}
    return task, METHODS[method](system, cell.missing, options)
