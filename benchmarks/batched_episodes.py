"""Many seeds in one program: seconds of an episode, by how many run at once.

    python benchmarks/batched_episodes.py [--seeds N...] [--out FILE]

Each seed plans in a draw of its own (`MPC()`, five seconds of the Furuta): of SIM2GP,
and with all missing forces. Times are without compilation, which is given apart; the
device is JAX's default one.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp.models import MissingForces, Sim2GP
from sim2gp.planning import MPC, MarkovObjective
from sim2gp.planning.episode import run_episode, world_of
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.systems import Furuta, free_parts


def timed(sim: Sim2GP, count: int) -> dict[str, Any]:
    """Seconds to compile and to run an episode of each of so many draws."""
    task, planner, belief = furuta_swingup(), MPC(), sim.init(jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), count)
    draws = [belief.sample(key) for key in keys]
    tt, delta = (jnp.stack([getattr(d, x) for d in draws]) for x in ("tt", "delta"))

    def one(tt: jax.Array, delta: jax.Array, key: jax.Array) -> jax.Array:
        draw = eqx.tree_at(lambda d: (d.tt, d.delta), draws[0], (tt, delta))
        world = world_of(task, draw, MarkovObjective(task.reward))
        state = planner.init(world, key=key)
        return run_episode(task, planner, state, world, key=key)[0].total

    started = time.perf_counter()
    run = jax.jit(jax.vmap(one)).lower(tt, delta, keys).compile()
    compiled = time.perf_counter()
    jax.block_until_ready(run(tt, delta, keys))
    warm = time.perf_counter()
    returns = jax.block_until_ready(run(tt, delta, keys))
    seconds = time.perf_counter() - warm
    return {
        "seeds": count,
        "compile": round(compiled - started, 2),
        "seconds": round(seconds, 3),
        "seconds_of_a_seed": round(seconds / count, 4),
        "median_return": round(float(jnp.median(returns)), 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 16, 64, 256])
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    sim, rows = Sim2GP(Furuta()), []
    wider = Sim2GP(free_parts(Furuta(), MissingForces(sim).forces))
    for name, each in (("SIM2GP", sim), ("all forces", wider)):
        for count in asked.seeds:
            row = {"draws": name, **timed(each, count)}
            rows.append(row)
            print(row, flush=True)
    if asked.out is not None:
        device = str(jax.devices()[0].device_kind)
        text = json.dumps({"device": device, "jax": jax.__version__, "rows": rows})
        asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
