"""Cells on a Ray cluster whose workers die, against the same cells on one machine.

    python benchmarks/ray_sweep.py [--cells N] [--kills N] [--out FILE]

Quick cells of figure 2 (one episode of the simulator's posterior, and their oracles)
are computed by two processes, which own one core each, and by a local Ray cluster.
While the cluster works, randomly chosen workers are killed at random times. All values
must be equal, but for the time that they took.
"""

import argparse
import json
import os
import random
import signal
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from sim2gp.runs.cell_work import AbstractCell, Values, compute_cells, store_of
from sim2gp.runs.executors import AbstractExecutor, Processes, RayCluster
from sim2gp.studies.swingup import Cell

#: s, the most between two kills.
PAUSE = 15.0


def cells_of(count: int) -> list[AbstractCell]:
    """So many, with their oracles, on both machines."""
    return [
        Cell(("furuta", "cartpole")[k % 2], "nominal", "SIM2GP", k // 2, 1, None, True)
        for k in range(count // 2)
    ]


class Killer(threading.Thread):
    """Kills workers of this machine, so many times."""

    def __init__(self, kills: int) -> None:
        super().__init__(daemon=True)
        self.left, self.over = kills, threading.Event()
        self.random = random.Random(0)

    def run(self) -> None:
        while self.left and not self.over.wait(self.random.uniform(1.0, PAUSE)):
            if busy := workers_at_work():
                os.kill(self.random.choice(busy), signal.SIGKILL)
                self.left -= 1


def workers_at_work() -> list[int]:
    """Ray's processes that compute a cell: their title is the function's name."""
    found = []
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            title = place.read_bytes()
        except OSError:  # it has ended
            continue
        if title.startswith(b"ray::_done"):
            found.append(int(place.parent.name))
    return found


def computed(
    cells: list[AbstractCell], executor: AbstractExecutor
) -> tuple[dict[str, Values], float]:
    """Values by name, without the time that they took, and the time of all."""
    started = time.perf_counter()
    with TemporaryDirectory() as folder:
        store = store_of(cells, Path(folder) / "out")
        found = compute_cells(cells, store, executor)
    return {
        cell.name: {k: v for k, v in values.items() if k != "seconds"}
        for cell, values in found.items()
    }, time.perf_counter() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=64)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path("results/ray_sweep.json"))
    asked = parser.parse_args()
    cells = cells_of(asked.cells)
    killer = Killer(asked.kills)
    killer.start()
    there, ray_seconds = computed(cells, RayCluster(retries=asked.kills))
    killer.over.set()
    killer.join()
    here, seconds = computed(cells, Processes(2))
    different = [name for name, values in here.items() if there[name] != values]
    found = {
        "cells": len(here),
        "kills": asked.kills - killer.left,
        "different": different,
        "seconds_ray": round(ray_seconds, 1),
        "seconds_processes": round(seconds, 1),
        "mean_return": float(np.mean([x["returns"][0] for x in here.values()])),
    }
    asked.out.parent.mkdir(parents=True, exist_ok=True)
    asked.out.write_text(json.dumps(found, indent=1) + "\n")
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
