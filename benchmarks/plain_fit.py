"""Seconds of the simulator's own first fit to stored transitions, by any source.

    PYTHONPATH=CHECKOUT/src python benchmarks/plain_fit.py ROWS.npz MACHINE REPEAT

Prints the median of compiled fits. It uses only what every version of the library has;
`first_fit.py --earlier CHECKOUT` runs it.
"""

import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from sim2gp import Sim2GP, Transitions
from sim2gp.systems import CartPole, Furuta

PLANTS = {"furuta": Furuta, "cartpole": CartPole}


def seconds(fit: Callable[[], Any], repeat: int) -> float:
    """Median of so many, after one that compiles."""
    found = []
    for _ in range(repeat + 1):
        started = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(fit()))
        found.append(time.perf_counter() - started)
    return float(np.median(found[1:]))


def main() -> None:
    file, machine, repeat = sys.argv[1:]
    rows, key = Transitions(**np.load(file)), jax.random.key(0)
    model = Sim2GP(PLANTS[machine]())
    print(seconds(lambda: model.fit(model.init(key), rows, key=key), int(repeat)))


if __name__ == "__main__":
    main()
