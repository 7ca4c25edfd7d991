"""What one planned action costs, by the model whose draw it is planned in.

    python benchmarks/mpc_step.py [--steps N]

iCEM with 128 sequences, 30 steps ahead, 4 rounds, on the Furuta; the worlds take turns
in one run, so that ratios hold on a busy machine too. Each model was fitted to five
seconds of random input. `MissingForces` plans with the forces that are on: with none
it is SIM2GP, with one (of the arm's position) or with all are draws of the prior.
Medians over steps, without compilation.
"""

import argparse
import time
from collections.abc import Mapping

import equinox as eqx
import jax
import numpy as np

from one_step import EPISODES, STEPS, random_episode
from sim2gp.commands.compare import MODELS
from sim2gp.data.transitions import Transitions
from sim2gp.models import MissingForces, Sim2GP
from sim2gp.planning import MPC, MarkovObjective, World
from sim2gp.planning.episode import oracle_world, world_of
from sim2gp.planning.icem import ICEM
from sim2gp.planning.tasks import Task, furuta_swingup
from sim2gp.systems import Furuta, free_parts

SIMULATOR, LINEAR = "plain simulator", "SIM2GP"
PLANNER = MPC(update=ICEM(samples=128, iterations=4), horizon=30)
#: The project's goals: neural draws, and linearised draws over the simulator.
MILLISECONDS, TIMES = 25.0, 3.0


def random_data(task: Task) -> Transitions:
    """Five seconds of random input."""
    data = Transitions.empty(EPISODES * STEPS, task.size, 1)
    for seed in range(EPISODES):
        data = data.extend(*random_episode(task, seed))
    return data


def worlds(task: Task) -> dict[str, World]:
    """A draw of each fitted model as a world, and the simulator itself."""
    sim, data, key = Sim2GP(Furuta()), random_data(task), jax.random.key(1)
    beliefs = {}
    for name, learner in MODELS.items():
        model = learner.make(sim, {})
        beliefs[name] = model.fit(model.init(key), data, key=key)
    forces = MissingForces(sim).forces
    for name, some in (("one force", forces[:1]), ("all forces", forces)):
        beliefs[name] = Sim2GP(free_parts(Furuta(), some)).init(key)
    objective = MarkovObjective(task.reward)
    return {SIMULATOR: oracle_world(task)} | {
        name: world_of(task, belief.sample(key), objective, history=0)
        for name, belief in beliefs.items()
    }


def measured(found: Mapping[str, World], task: Task, steps: int) -> dict[str, list]:
    """Seconds of each planned action; one action in every world, then the next."""
    act = eqx.filter_jit(PLANNER.act)
    key, s = jax.random.key(2), task.reset(jax.random.key(3))
    states = {name: PLANNER.init(w, key=key) for name, w in found.items()}
    for name, world in found.items():
        jax.block_until_ready(act(states[name], world, s, key=key))
    spent: dict[str, list] = {name: [] for name in found}
    for t in range(steps):
        for name, world in found.items():
            started = time.perf_counter()
            plan = act(states[name], world, s, key=jax.random.fold_in(key, t))
            _, states[name] = jax.block_until_ready(plan)
            spent[name].append(time.perf_counter() - started)
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    arguments = parser.parse_args()
    task = furuta_swingup()
    spent = measured(worlds(task), task, arguments.steps)
    half = {name: 1e3 * float(np.median(row)) for name, row in spent.items()}
    print(f"{'world':16s} {'p50, ms':>8s} {'p95, ms':>8s} {'of the simulator':>17s}")
    for name, row in spent.items():
        tail, times = 1e3 * np.quantile(row, 0.95), half[name] / half[SIMULATOR]
        print(f"{name:16s} {half[name]:8.1f} {tail:8.1f} {times:17.2f}")
    slowest = max(half[name] for name in ("NLM", "RES", "FS"))
    for what, holds in (
        (f"NLM, RES and FS draws within {MILLISECONDS:g} ms", slowest <= MILLISECONDS),
        (f"{LINEAR} within {TIMES:g} times", half[LINEAR] <= TIMES * half[SIMULATOR]),
    ):
        print(f"{what}: {'holds' if holds else 'does not hold'}")


if __name__ == "__main__":
    main()
