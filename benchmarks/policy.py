"""Microseconds a step of an exported policy, in NumPy alone.

python benchmarks/policy.py [--steps N]
"""

import argparse
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

from sim2gp.planning import SAC
from sim2gp.planning.episode import oracle_world
from sim2gp.planning.tasks import furuta_swingup
from sim2gp.robot import NumpyPolicy, load_policy
from sim2gp.robot.export import export_policy
from sim2gp.systems import Furuta

GOAL = 50.0  # us, of 99 in 100 steps
WIDTHS = (64, 128)


def exported(width: int) -> NumpyPolicy:
    """As it begins: what a step costs does not depend on what was learned."""
    sac = SAC(hidden=(width, width), capacity=1, num_envs=1, steps=1)
    learner = sac.init(oracle_world(furuta_swingup()), key=jax.random.key(0))
    with tempfile.TemporaryDirectory() as folder:
        export_policy(learner.policy, Path(folder) / "policy", Furuta())
        return load_policy(Path(folder) / "policy")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=20_000)
    options = parser.parse_args()
    S = np.random.default_rng(0).normal(size=(options.steps, 4)).astype("f4")
    for width in WIDTHS:
        policy, taken = exported(width), np.empty(len(S))
        for i, s in enumerate(S):
            started = time.perf_counter()
            policy(s)
            taken[i] = 1e6 * (time.perf_counter() - started)
        half, most = np.quantile(taken, [0.5, 0.99])
        held = "met" if most <= GOAL else "not met"
        print(
            f"2 x {width}: median {half:.1f}, p99 {most:.1f} us (goal {GOAL:g}: {held})"
        )


if __name__ == "__main__":
    main()
