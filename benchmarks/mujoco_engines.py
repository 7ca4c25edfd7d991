"""C MuJoCo against MJX on this processor: rows a second of steps and of Jacobians.

    taskset -c 0 python benchmarks/mujoco_engines.py [ROWS...]

For a cart-pole, and for a puck that slides on a floor: batches of steps of 10 ms in
float32, as a planner asks for, and steps with their Jacobians in two constants, state
and input in float64, as a fit does. Each engine counts by its median of five turns, in
processor seconds, so that other work on the machine does not count. What compiling
costs is next to it: C MuJoCo's is that of the callback alone.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from sim2gp import systems as sy
from sim2gp.commands.bench_jobs import CART_POLE

TURNS, DT = 5, 0.01
PUCK = """
<mujoco><option timestep="0.005"/><worldbody>
  <geom name="floor" type="plane" size="5 5 .1" friction=".3"/>
  <body name="puck" pos="0 0 .05">
    <joint name="x" type="slide" axis="1 0 0" damping=".1"/>
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom name="puck" type="sphere" size=".05" mass=".3" friction=".4"/></body>
</worldbody><actuator><motor name="u" joint="x" gear="2"/></actuator></mujoco>
"""
MODELS = {
    "cart-pole": (CART_POLE, ["joint/x/damping", "body/pole/mass"]),
    "puck on a floor": (PUCK, ["joint/x/damping", "geom/puck/friction"]),
}


def main() -> None:
    """Print a table: model, task, rows, engine, rows a second, seconds to compile."""
    import mujoco

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("rows", nargs="*", type=int, default=[16, 256, 2048])
    counts = parser.parse_args().rows
    print("model            task         rows engine     rows/s  first s")
    for name, (text, constants) in MODELS.items():
        model = mujoco.MjModel.from_xml_string(text)
        for engine in ("c", "mjx"):
            for task, double in (("steps", False), ("jacobians", True)):
                with jax.enable_x64(double):
                    system = sy.MuJoCo(model, constants, engine=engine)
                    work = compiled(system, task)
                    for count in counts:
                        args = batch(system, count)
                        first, usual = seconds(lambda w=work, a=args: w(*a))
                        rate = f"{count / usual:10.0f} {first:8.2f}"
                        print(
                            f"{name:16} {task:10} {count:6} {engine:6} {rate}",
                            flush=True,
                        )


def compiled(system: sy.MuJoCo, task: str) -> Callable[..., object]:
    """Steps of a batch of rows, or their Jacobians."""

    def step(theta: jax.Array, s: jax.Array, a: jax.Array) -> jax.Array:
        return system.flow(theta, s, a, DT)

    if task == "steps":
        return jax.jit(jax.vmap(step, (None, 0, 0)))
    return jax.jit(jax.vmap(jax.jacfwd(step, (0, 1, 2)), (None, 0, 0)))


def batch(system: sy.MuJoCo, count: int) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One vector of constants, and rows of states and inputs."""
    rng = np.random.default_rng(0)
    theta = jnp.asarray(list(system.parameters.nominal().values()), float)
    S = 0.3 * rng.standard_normal((count, len(system.states)))
    S[:, 1] = 1e-3 * S[:, 1]  # the puck is on the floor
    A = rng.uniform(-1.0, 1.0, (count, 1))
    return theta, jnp.asarray(S, float), jnp.asarray(A, float)


def seconds(work: Callable[[], object]) -> tuple[float, float]:
    """Processor seconds of the first turn, and the median of those after it."""
    taken = []
    for _ in range(1 + TURNS):
        started = time.process_time()
        jax.block_until_ready(work())
        taken.append(time.process_time() - started)
    return taken[0], statistics.median(taken[1:])


if __name__ == "__main__":
    main()
