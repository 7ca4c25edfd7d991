"""Seconds of the simulator's own first fit to stored transitions, by any source.

    PYTHONPATH=CHECKOUT/src python benchmarks/plain_fit.py ROWS.npz MACHINE REPEAT

Prints the median of compiled fits. It uses only what every version of the library has;
`first_fit.py --earlier CHECKOUT` runs it.
"""

import sys
import time

import jax
import numpy as np

from sim2gp import Sim2GP, Transitions
from sim2gp.systems import CartPole, Furuta

PLANTS = {"furuta": Furuta, "cartpole": CartPole}


def main() -> None:
    file, machine, repeat = sys.argv[1:]
    rows = Transitions(**np.load(file))
    model, key, found = Sim2GP(PLANTS[machine]()), jax.random.key(0), []
    for _ in range(int(repeat) + 1):
        started = time.perf_counter()
        fitted = model.fit(model.init(key), rows, key=key)
        jax.block_until_ready(fitted.posterior.mean)
        found.append(time.perf_counter() - started)
    print(float(np.median(found[1:])))


if __name__ == "__main__":
    main()
