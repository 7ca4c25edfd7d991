"""The search for a machine that a simulator on the host moves, without gradients.

Its simulator gives slopes of states, but not how information changes with the commands.
So an evolution strategy draws commands: the next ones lie between two of the best, with
something new. Every motion is simulated with its slopes, as a fit simulates logs.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from sim2gp.data.window_slopes import HostRun, SlopeInputs, about
from sim2gp.data.windows import Pieces
from sim2gp.experiment_design.experiment import (
    Experiment,
    about_constants,
    piece,
    posterior_scale,
)
from sim2gp.experiment_design.goals import AbstractGoal
from sim2gp.experiment_design.limits import LimitBox, all_excess, narrow_limits
from sim2gp.experiment_design.search_method import SearchProblem, SearchPrograms
from sim2gp.experiment_design.signals import AbstractCommandSignal
from sim2gp.systems.host import simulator_of
from sim2gp.types import Key

ROUNDS, SAMPLES, ELITES = 10, 24, 6
SMALL, LARGE = 0.1, 1.0  # coefficients' sd in the first round, from sample to sample
FRESH = 0.3  # of the best ones' sd, what is new in the next
TRIALS = 5  # draws that must keep the limits while searching
CHECKED = 300  # draws that the result is held against
CHEAP, COST = 10.0, 100.0  # of a half of the box, for each direction asked about; nats

States = Float[np.ndarray, "K times n"]


def search_programs(problem: SearchProblem) -> SearchPrograms:
    """Loops of the host around its simulator."""
    experiment, signal, goal, limits, *sampled = problem
    draws, guards, others = map(np.asarray, sampled)
    return SearchPrograms(
        sampling_search(experiment, signal, goal, limits, draws, guards),
        lambda U: states_and_excess(experiment, limits, np.asarray(U), others),
        lambda U: worth(experiment, goal, draws, np.asarray(U)),
    )


def sensitivity_at(
    experiment: Experiment, commands: Float[Array, "T m"], periods: int
) -> Float[Array, "k p"]:
    """`experiment.sensitivity_at`, by the simulator's own slopes."""
    U, tt = np.asarray(commands), experiment.belief.mean
    states = states_of(experiment, U, np.asarray(tt)[None])[0]
    first = np.arange(0, experiment.steps - periods + 1, periods)
    n = states.shape[1]
    asked = about(tt, states[first], np.eye(tt.size), np.zeros(n))
    J = _sensitivity_rows(experiment, asked, U, first, periods)
    return jnp.asarray(J[:, -1, :, n:].reshape(-1, tt.size))


def states_of(
    experiment: Experiment, U: Float[np.ndarray, "T m"], machines: np.ndarray
) -> States:
    """Those at the beginning and after each period, of machines at virtual values."""
    first, start = np.zeros(len(machines), int), np.asarray(experiment.start)
    asked = SlopeInputs.at(machines, np.tile(start, (len(machines), 1)))
    run = _run_pieces(experiment, asked, U, first, experiment.steps)
    return run.states[:, :: experiment.substeps]


def states_and_excess(
    experiment: Experiment, limits: LimitBox, U: np.ndarray, draws: np.ndarray
) -> tuple[States, Float[np.ndarray, " K"]]:
    """Of plausible machines, and how far each leaves the limits; infinite when lost."""
    machines = np.stack([np.asarray(experiment.plausible.at(z)) for z in draws])
    states = states_of(experiment, U, machines)
    return states, np.asarray(_excess(limits, jnp.asarray(states)))


def worth_at(
    experiment: Experiment, goal: AbstractGoal, z: np.ndarray, U: np.ndarray
) -> tuple[float, Float[Array, "p p"]]:
    """Nats of the goal at one machine of the belief, and the belief's scale after."""
    scale = _scale_at(experiment, z, U)
    if scale is None:
        return -np.inf, experiment.belief.scale
    return float(goal.nats(experiment.belief.scale, scale)), scale


def scale_after(
    experiment: Experiment, commands: Float[Array, "T m"]
) -> Float[Array, "p p"]:
    """Square root of the covariance that commands leave, at the belief's mean."""
    mean = np.zeros(experiment.belief.mean.size)
    scale = _scale_at(experiment, mean, np.asarray(commands))
    return experiment.belief.scale if scale is None else scale


def _scale_at(
    experiment: Experiment, z: np.ndarray, U: np.ndarray
) -> Float[Array, "p p"] | None:
    """The belief's scale after commands, at one machine; None if that diverges."""
    tt = experiment.belief.at(jnp.asarray(z))
    states = states_of(experiment, U, np.asarray(tt)[None])[0]
    if not np.isfinite(states).all():
        return None
    count, p = experiment.window, z.size
    first = np.arange(0, experiment.steps - count + 2, count)
    scale, n = experiment.belief.scale, states.shape[1]
    asked = about(tt, states[first], scale, experiment.start_sd)
    J = _sensitivity_rows(experiment, asked, U, first, count - 1)
    A = _about_constants(jnp.asarray(J.reshape(len(first), -1, n + p)), n)
    return posterior_scale(experiment.belief, A.reshape(-1, p))


def worth(
    experiment: Experiment, goal: AbstractGoal, draws: np.ndarray, U: np.ndarray
) -> tuple[float, Float[Array, "p p"], Float[np.ndarray, "times n"]]:
    """The mean over draws, the scale at the first, and the plausible mean's states."""
    found = [worth_at(experiment, goal, z, U) for z in draws]
    middle = states_of(experiment, U, np.asarray(experiment.plausible.mean)[None])[0]
    return float(np.mean([nats for nats, _ in found])), found[0][1], middle


def sampling_search(
    experiment: Experiment,
    signal: AbstractCommandSignal,
    goal: AbstractGoal,
    limits: LimitBox,
    draws: Float[np.ndarray, "D p"],
    guards: Float[np.ndarray, "G p"],
) -> Callable[[Key], Float[np.ndarray, "k m"]]:
    """From random motions to a better one, in rounds of samples."""
    inner, inputs = narrow_limits(limits), limits.low.size
    costs = goal.directions(experiment.belief.scale) * np.geomspace(CHEAP, COST, ROUNDS)

    def value(C: np.ndarray, z: np.ndarray, cost: float) -> float:
        U = np.asarray(commands(C))
        over = np.maximum(states_and_excess(experiment, inner, U, guards)[1], 0.0)
        if not np.isfinite(over).all():
            return -np.inf
        return worth_at(experiment, goal, z, U)[0] - cost * float(np.mean(over))

    commands = eqx.filter_jit(lambda C: signal.commands(C, limits))

    def motions(key: Key) -> np.ndarray:
        one = jax.vmap(lambda k: signal.random(k, inputs))
        return np.asarray(one(jax.random.split(key, SAMPLES)))

    def improved(key: Key) -> np.ndarray:
        rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        first, *later = jax.random.split(key, ROUNDS)
        C = np.geomspace(SMALL, LARGE, SAMPLES)[:, None, None] * motions(first)
        for i, cost in enumerate(costs):
            z = draws[i % len(draws)]
            values = np.asarray([value(c, z, cost) for c in C])
            best = C[np.argsort(-values, kind="stable")[:ELITES]]
            if i < ROUNDS - 1:
                one, other = best[rng.integers(len(best), size=(2, SAMPLES))]
                share = 0.5 * rng.uniform(size=(SAMPLES, 1, 1))
                new = FRESH * best.std(axis=(0, 1)) * motions(later[i])
                C = np.concatenate([best, one + share * (other - one) + new])
        return np.asarray(best[0])

    return improved


def _sensitivity_rows(
    experiment: Experiment,
    asked: SlopeInputs,
    U: np.ndarray,
    first: Int[np.ndarray, " W"],
    periods: int,
) -> Float[np.ndarray, "W times c k"]:
    """Slopes of what is measured of pieces that begin at states, in noise sd."""
    J = _run_pieces(experiment, asked, U, first, periods).slopes()
    J = J[:, :: experiment.substeps, list(experiment.outputs)]
    return np.asarray(J / np.asarray(experiment.noise)[:, None])


def _run_pieces(
    experiment: Experiment,
    asked: SlopeInputs,
    U: np.ndarray,
    first: Int[np.ndarray, " W"],
    periods: int,
) -> HostRun:
    """Pieces of the experiment that begin at periods ``first``."""
    simulator = simulator_of(experiment.system)
    assert simulator is not None
    found = _pieces(experiment, jnp.asarray(U), jnp.asarray(first), periods)
    return HostRun(simulator, experiment.system, found, asked)


@eqx.filter_jit
def _pieces(experiment: Experiment, U: Array, first: Array, periods: int) -> Pieces:
    found = jax.vmap(lambda i: piece(experiment, U, i, periods))(first)
    return Pieces(found.span, found.knots, found.area)


@eqx.filter_jit
def _about_constants(J: Float[Array, "W N q"], n: int) -> Float[Array, "W rows p"]:
    return jax.vmap(lambda one: about_constants(one, n))(J)


_excess = eqx.filter_jit(all_excess)
