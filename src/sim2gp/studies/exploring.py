"""Cells of figures 3 and 5: what a model knows of a machine that it explored itself.

A learner runs episodes for information alone. It is tested on a motion that it never
ran: the swing-up of a planner that knows the truth. Errors are those of one step
against the noise-free truth, in sd of the machine's own noise: at 1 a prediction is as
far off as the machine is from itself.
"""

import time
from collections.abc import Callable, Hashable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotConverged, NotFinite
from sim2gp.inference.gaussian import LOG_2PI
from sim2gp.planning import (
    ICEM,
    MPC,
    AbstractPlanner,
    Chirp,
    Multisine,
    RandomInput,
)
from sim2gp.planning.episode import Purpose, episode, key_for, oracle_world
from sim2gp.planning.loop import Episode, drawn, expected, psal
from sim2gp.planning.tasks import Task
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies import swingup
from sim2gp.studies.learners import (
    QUICK_TRAINING,
    missing,
    planner_of,
    task_and_model,
)
from sim2gp.studies.study import described
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import Dynamics, Key, in_float64

#: Information hardly depends on the last digits of a plan: fewer sequences than a
#: swing-up needs, and every fourth step.
EXPLORER = MPC(update=ICEM(samples=48, elites=8, iterations=3), every=4)
QUICK_EXPLORER = MPC(update=ICEM(samples=32, elites=4, iterations=2), every=5)
#: What is kept of each episode.
QUANTITIES = ("rmse", "nll", "coverage95", "nats", "upright", "swung_up")
#: Episodes of the oracle that make a test set.
TESTS = 2
#: Of the first episode, where a simulator's own fit is looked at as well.
BEGINNINGS = (25, 50, 100, 150, 200)


@dataclass(frozen=True)
class Explorer:
    """Who learns, and who chooses the commands.

    model: of `learners.METHODS`.
    signal: run instead of plans for information.
    together: `InformationGain`'s.
    world: what is planned in, draws or the mean.
    """

    model: str
    signal: AbstractPlanner | None = None
    together: bool = True
    world: Callable[[AbstractBelief, Key], Dynamics] = drawn


METHODS: dict[str, Explorer] = {
    "SIM2GP": Explorer("SIM2GP"),
    "NLM": Explorer("NLM"),
    "RES": Explorer("RES"),
    "FS literal": Explorer("FS literal"),
    "FS": Explorer("FS"),
    "RES-FS": Explorer("RES-FS"),
    "MissingForces": Explorer("MissingForces"),
    "SIM2GP, step by step": Explorer("SIM2GP", together=False),
    "SIM2GP, random": Explorer("SIM2GP", RandomInput()),
    "SIM2GP, chirp": Explorer("SIM2GP", Chirp()),
    "SIM2GP, multisine": Explorer("SIM2GP", Multisine(), world=expected),
    "RES-FS, random": Explorer("RES-FS", RandomInput()),
}


@dataclass(frozen=True)
class Cell(AbstractCell):
    """One explorer on one machine of one seed; ``oracle`` makes the test set."""

    machine: str
    condition: str
    method: str
    seed: int
    episodes: int
    quick: bool = False

    @property
    def missing(self) -> AbstractPart:
        """The physics that the condition is about."""
        return missing(self.machine, self.condition)

    @property
    def planner(self) -> AbstractPlanner:
        """The planner of the commands."""
        signal = METHODS[self.method].signal
        return signal or (QUICK_EXPLORER if self.quick else EXPLORER)

    @property
    def name(self) -> str:
        """The name of its file."""
        words = [self.machine, self.condition, self.method, str(self.seed)]
        return "_".join(words + ["quick"] * self.quick).replace(" ", "-")

    @property
    def arguments(self) -> dict[str, Any]:
        """All that its values depend on, but for how many episodes there are."""
        oracle = self.method == "oracle"
        planner = planner_of(self.quick) if oracle else self.planner
        given = asdict(self) | {"planner": described(planner)}
        del given["episodes"]
        if not given.pop("quick"):
            return given
        return given | {"training": QUICK_TRAINING}

    @property
    def program(self) -> tuple[Hashable, ...]:
        """A learner's forecasts and plans on one machine."""
        return self.machine, self.method

    @property
    def needs(self) -> "Cell | None":
        """The test set of the same machine."""
        return None if self.method == "oracle" else reference(self)

    def enough(self, values: Mapping[str, Any]) -> bool:
        """Whether as many episodes were run."""
        return self.method == "oracle" or len(values["rmse"]) >= self.episodes

    def compute(self, needed: Values | None) -> Values:
        """A test set, or how well a learner predicts it after each episode."""
        return oracle_cell(self) if needed is None else learner_cell(self, needed)


class HeldOut(eqx.Module):
    """Transitions of a swing-up that nobody learns from, and the noise-free truth."""

    state: Float[np.ndarray, "N n"]
    action: Float[np.ndarray, "N m"]
    next_state: Float[np.ndarray, "N n"]
    truth: Float[np.ndarray, "N n"]

    @classmethod
    def of(cls, task: Task, oracle: Mapping[str, Any]) -> "HeldOut":
        """From the oracle's cell."""
        states = np.asarray(oracle["states"], np.float32)
        actions = np.asarray(oracle["actions"], np.float32)
        S, S2 = (x.reshape(-1, x.shape[2]) for x in (states[:, :-1], states[:, 1:]))
        A = actions.reshape(-1, actions.shape[2])
        truth = np.asarray(_steps(task, S, A))[:, : task.size]
        return cls(*(np.asarray(x, float) for x in (S, A, S2, truth)))


@eqx.filter_jit
def _steps(task: Task, S: Any, A: Any) -> Array:
    past = jnp.zeros(task.history * A.shape[1], S.dtype)
    return jax.vmap(lambda s, a: task.dynamics(jnp.concatenate([s, past]), a))(S, A)


@in_float64
def tested(
    belief: AbstractBelief, test: HeldOut, noise: np.ndarray
) -> dict[str, float]:
    """Error (noise sd), negative log density (nats) and coverage, per transition."""
    found = forecast(belief, jnp.asarray(test.state), jnp.asarray(test.action))
    mean, covariance = (np.asarray(x) for x in found)
    L = np.linalg.cholesky(covariance)
    z = np.linalg.solve(L, (test.next_state - mean)[..., None])[..., 0]
    logs = np.log(np.einsum("nii->ni", L)).sum(axis=1)
    nll = 0.5 * (z**2).sum(axis=1) + logs + 0.5 * mean.shape[1] * LOG_2PI
    away = np.abs(test.next_state - mean) / np.sqrt(np.einsum("nii->ni", covariance))
    return {
        "rmse": float(np.sqrt(np.mean(((mean - test.truth) / noise) ** 2))),
        "nll": float(np.mean(nll)),
        "coverage95": float(np.mean(away < 1.96)),
    }


@eqx.filter_jit
def forecast(
    belief: AbstractBelief, S: Float[Array, "N n"], A: Float[Array, "N m"]
) -> tuple[Float[Array, "N n"], Float[Array, "N n n"]]:
    """Mean and covariance of each transition's next state, noise included."""

    def one(s: Array, a: Array) -> tuple[Array, Array]:
        found = belief.predict(s, a)
        return found.mean, found.covariance()

    return jax.vmap(one)(S, A)


def oracle_cell(cell: Cell) -> dict[str, Any]:
    """The seed's truth, as figure 2 finds it, and swing-ups of a planner that knows."""
    found = swingup.oracle_cell(cell)
    task, _ = task_and_model(cell, "SIM2GP", found["redrawn"])
    planner, key = planner_of(cell.quick), jax.random.key(cell.seed)
    world = oracle_world(task)
    ready = planner.init(world, key=key)
    episodes = [
        episode(task, planner, ready, world, key=key_for(key, e, Purpose.TEST))[0]
        for e in range(TESTS)
    ]
    return {
        "redrawn": found["redrawn"],
        "states": [np.asarray(x.state).tolist() for x in episodes],
        "actions": [np.asarray(x.action).tolist() for x in episodes],
    }


def learner_cell(cell: Cell, oracle: Mapping[str, Any]) -> dict[str, Any]:
    """Explore, and test what was learned after each episode."""
    explorer, key = METHODS[cell.method], jax.random.key(cell.seed)
    redrawn = int(oracle["redrawn"])
    task, model = task_and_model(cell, explorer.model, redrawn)
    test, noise = HeldOut.of(task, oracle), np.asarray(task.noise, float)
    before = model.init(key_for(key, 0, Purpose.INIT))
    rows: list[dict[str, float]] = []
    started, failure = time.perf_counter(), None

    def note(done: Episode) -> None:
        nonlocal before
        S, A, _ = done.trajectory.transitions(model.history)
        about = before.untempered()
        gained = about.trajectory_information_gain(jnp.asarray(S), jnp.asarray(A))
        states = jnp.asarray(done.trajectory.state)
        rest = {
            "nats": float(gained),
            "upright": float(jnp.mean(task.at_goal(states))),
            "swung_up": float(task.reached(states)),
        }
        rows.append(tested(done.belief, test, noise) | rest)
        before = done.belief

    early: list[dict[str, float]] = []
    try:
        explored = psal(
            task,
            model,
            cell.planner,
            episodes=cell.episodes,
            key=key,
            together=explorer.together,
            history=model.history,
            on_episode=note,
            world=explorer.world,
        )
        if explorer.model == "SIM2GP":
            early = beginnings(model, explored.data, test, noise, key=key)
    except (NotConverged, NotFinite) as error:
        failure = str(error)
    seconds = time.perf_counter() - started
    columns = {name: [row[name] for row in rows] for name in QUANTITIES}
    return columns | {"early": early, "failure": failure, "seconds": seconds}


def beginnings(
    model: AbstractModel,
    data: Transitions,
    test: HeldOut,
    noise: np.ndarray,
    *,
    key: Key,
) -> list[dict[str, float]]:
    """Errors after the first transitions alone: an episode is long for a simulator."""
    out = []
    for count in BEGINNINGS:
        rows = data.state[:count], data.action[:count], data.next_state[:count]
        some = Transitions.empty(len(data.mask), *(x.shape[1] for x in rows[:2]))
        belief = model.fit(model.init(key), some.extend(*rows), key=key)
        out.append({"transitions": float(count)} | tested(belief, test, noise))
    return out


def reference(cell: Cell) -> Cell:
    """The cell of the same machine's test set."""
    return replace(cell, method="oracle", episodes=0)
