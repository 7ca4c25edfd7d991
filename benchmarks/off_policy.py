"""SAC in worlds made of the truth: how good, how soon, and next to SBX's SAC.

    pip install 'sim2gp[bench]'
    python benchmarks/off_policy.py [--seeds N] [--out DIR]

Each seed's hidden machine is figure 2's, and so is the oracle that returns are compared
with: sampling MPC in the true world. A policy's return is the median of five noisy
episodes on the machine; flying them is not counted as training, compiling is.

1. The seconds of training after which a policy has nine tenths of the oracle's return.
2. Steps of the world with as many updates, per second: the same networks and batches,
   here in 64 worlds that are one program, in SBX in one Gymnasium environment or in 64.
3. SBX's seconds to nine tenths with SBX's defaults, up to `PATIENCE` times ours.
"""

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from sbx import SAC as Theirs
from stable_baselines3.common.vec_env import DummyVecEnv

from sim2gp.data.transitions import Transitions
from sim2gp.planning import SAC, World
from sim2gp.planning.episode import Purpose, key_for, oracle_world
from sim2gp.planning.mpc import from_unit
from sim2gp.planning.sac import Learner, made
from sim2gp.planning.tasks import MACHINES, Task
from sim2gp.runs.cell_work import run_cell
from sim2gp.studies.learners import task_and_model
from sim2gp.studies.swingup import Cell, reference

NEAR = 0.9  # of the oracle's return
EPISODES = 5
PATIENCE = 4.0
LONGEST = 240.0  # s of training, in which ours must be near
CHUNK = 1000  # steps of SBX between two looks
WIDTHS = (64, 128)
#: Looked at every 3,200 updates.
OURS = replace(SAC(), steps=100, capacity=16)


def wrapped(world: World, seed: int) -> Any:
    """A world, one at a time, as Gymnasium sees it; actions in the unit box."""
    import gymnasium

    m, size = world.actions.low.size, world.observe.size

    class WorldEnv(gymnasium.Env):
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (m,))
        observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,))
        key = jax.random.key(seed)

        def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
            self.key, key = jax.random.split(self.key)
            self.state, seen = _reset(world, key)
            self.steps = 0
            return np.asarray(seen), {}

        def step(self, action: np.ndarray) -> Any:
            self.state, seen, reward = _step(world, self.state, action)
            self.steps += 1
            over = self.steps >= world.horizon
            return np.asarray(seen), float(reward), False, over, {}

    return WorldEnv()


@eqx.filter_jit
def _reset(world: World, key: jax.Array) -> Any:
    s = world.reset(key)
    return s, world.observe(s)


@eqx.filter_jit
def _step(world: World, s: jax.Array, u: jax.Array) -> Any:
    s2, reward, _ = made(world, s, u)
    return s2, world.observe(s2), reward


@eqx.filter_jit
def episode_return(
    task: Task, act: Callable[[jax.Array], jax.Array], key: jax.Array
) -> Any:
    """The median return of a policy, a pytree, on the machine."""

    def one(key: jax.Array) -> jax.Array:
        def step(s: jax.Array, t: jax.Array) -> tuple[jax.Array, jax.Array]:
            a = act(s[: task.size])
            s2 = task.step(s, a, key=jax.random.fold_in(key, t))
            return s2, task.reward(s, a, s2)

        _, rewards = jax.lax.scan(step, task.reset(key), jnp.arange(task.horizon))
        return jnp.sum(rewards)

    keys = [key_for(key, e + 1, Purpose.EPISODE) for e in range(EPISODES)]
    return jnp.median(jax.vmap(one)(jnp.stack(keys)))


def met(machine: str, seed: int, out: Path) -> tuple[Task, float]:
    """A seed's hidden machine, and what sampling MPC in the true world returns."""
    cell = Cell(machine, "nominal", "SIM2GP", seed, 1)
    oracle = run_cell(reference(cell), out)
    task, _ = task_and_model(cell, "SIM2GP", int(oracle["redrawn"]))
    return task, float(oracle["oracle_return"])


def ours(task: Task, oracle: float, seed: int) -> list[tuple[float, float]]:
    """Seconds of training and share of the oracle's return, look by look."""
    world, key = oracle_world(task), jax.random.key(seed)
    nothing = Transitions.empty(1, task.size, task.actions.low.size)
    looks: list[tuple[float, float]] = []
    started, away = time.perf_counter(), 0.0
    learner = OURS.init(world, key=key_for(key, 0, Purpose.PREPARE))
    while not looks or (looks[-1][1] < NEAR and looks[-1][0] < LONGEST):
        again = key_for(key, len(looks) + 1, Purpose.PREPARE)
        learner = OURS.prepare(learner, world, nothing, key=again)
        jax.block_until_ready(learner.updates)
        seconds = time.perf_counter() - started - away
        share = float(episode_return(task, learner.policy, key)) / oracle
        away = time.perf_counter() - started - seconds
        looks.append((seconds, share))
    return looks


def theirs(task: Task, oracle: float, seed: int, most: float) -> Any:
    """The same of SBX, with its defaults, until it is near or ``most`` seconds old."""
    world, key = oracle_world(task), jax.random.key(seed)
    looks: list[tuple[float, float]] = []
    started, away = time.perf_counter(), 0.0
    model = Theirs("MlpPolicy", wrapped(world, seed), seed=seed)

    def act(actor: Any, s: jax.Array) -> jax.Array:
        u = actor.apply_fn(actor.params, world.observe(s)[None]).mode()
        return from_unit(u, world.actions)[0]

    while not looks or (looks[-1][1] < NEAR and looks[-1][0] < most):
        model.learn(CHUNK, reset_num_timesteps=not looks)
        seconds = time.perf_counter() - started - away
        policy = eqx.Partial(act, model.policy.actor_state)
        share = float(episode_return(task, policy, key)) / oracle
        away = time.perf_counter() - started - seconds
        looks.append((seconds, share))
    return looks


def speed_ours(world: World, width: int) -> float:
    """Steps with as many updates, per second, compiled before."""
    sac = SAC(hidden=(width, width), num_envs=64, updates=64, steps=40)
    key = jax.random.key(0)
    n, m = world.reset(key).size, world.actions.low.size
    nothing = Transitions.empty(1, n, m)
    learner: Learner = sac.init(world, key=key)
    seconds = []
    for i in range(3):
        started = time.perf_counter()
        learner = sac.prepare(learner, world, nothing, key=jax.random.fold_in(key, i))
        jax.block_until_ready(learner.updates)
        seconds.append(time.perf_counter() - started)
    return sac.num_envs * sac.steps / min(seconds[1:])


def speed_theirs(world: World, width: int, worlds: int) -> float:
    """Steps with as many updates, per second, compiled before."""
    envs = DummyVecEnv([lambda i=i: wrapped(world, i) for i in range(worlds)])
    model = Theirs(
        "MlpPolicy",
        envs,
        gradient_steps=worlds,
        policy_kwargs={"net_arch": [width, width]},
        learning_starts=4 * max(worlds, 100),
    )
    model.learn(8 * max(worlds, 100))
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        model.learn(1280, reset_num_timesteps=False)
        seconds.append(time.perf_counter() - started)
    return 1280 / min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("results/off_policy"))
    options = parser.parse_args()
    found: dict[str, Any] = {"speed": {}, "ours": {}, "theirs": {}}
    for width in WIDTHS:
        world = oracle_world(met("furuta", 0, options.out)[0])
        each = {"ours": speed_ours(world, width)}
        each |= {f"SBX in {n} world(s)": speed_theirs(world, width, n) for n in (1, 64)}
        found["speed"][width] = each
        print(width, each, flush=True)
    for machine in MACHINES:
        for seed in range(options.seeds):
            task, oracle = met(machine, seed, options.out)
            mine = ours(task, oracle, seed)
            found["ours"].setdefault(machine, []).append(mine)
            most = PATIENCE * mine[-1][0]
            other = theirs(task, oracle, seed, most)
            found["theirs"].setdefault(machine, []).append(other)
            print(machine, seed, mine[-1], other[-1], flush=True)
    text = "\n".join(lines(found))
    print(text)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "table.txt").write_text(text + "\n")
    (options.out / "looks.json").write_text(json.dumps(found, indent=1) + "\n")


def reached(looks: list[tuple[float, float]]) -> float:
    """Seconds to nine tenths; inf where they were not reached."""
    seconds, share = looks[-1]
    return seconds if share >= NEAR else np.inf


def lines(found: dict[str, Any]) -> list[str]:
    """The figures, and the goals."""
    out = ["steps with as many updates, per second (goal: 1.5 times SBX's in one)"]
    for width, each in found["speed"].items():
        mine = each["ours"]
        rest = ", ".join(
            f"{name} {value:.0f} ({mine / value:.2f} times)"
            for name, value in each.items()
            if name != "ours"
        )
        out.append(f"  networks of {width}: ours {mine:.0f}; {rest}")
    out.append(f"seconds to {NEAR:.0%} of MPC's return (goal: 180; a third of SBX's)")
    for machine in found["ours"]:
        mine = np.asarray([reached(x) for x in found["ours"][machine]])
        other = np.asarray([reached(x) for x in found["theirs"][machine]])
        lasted = np.asarray([x[-1][0] for x in found["theirs"][machine]])
        ratio = mine / np.minimum(other, lasted)
        near = f"{np.isfinite(other).sum()} of {len(other)}"
        out.append(
            f"  {machine}: {np.median(mine):.0f} (slowest {mine.max():.0f}); SBX "
            f"{np.median(other):.0f}, {near} before they were given up: at most "
            f"{np.median(ratio):.2f} of SBX's (median)"
        )
    return out


if __name__ == "__main__":
    main()
