"""Cells of a study on an accelerator: in batches, and the same as alone."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotConverged
from sim2gp.models import Sim2GP
from sim2gp.planning.episode import Trajectory
from sim2gp.planning.loop import SamplingRun
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import run_cell
from sim2gp.studies import swingup
from sim2gp.studies.study import run_cells
from sim2gp.studies.swingup import Cell
from sim2gp.systems import Furuta

ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 0, "returns": [150.0]}


def draw(out: Path) -> dict[str, Any]:
    """What a study of three learners and two seeds says of its cells."""
    rows = {
        (m,): [Cell("furuta", "nominal", m, seed, 2) for seed in (0, 1)]
        for m in ("SIM2GP", "RES", "NLM")
    }
    return run_cells(rows, out, workers=1, progress=Progress(quiet=True))[1]


def test_an_accelerator_computes_a_row_as_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same cells as alone; what is stored is not computed again."""
    out, batches, names = tmp_path / "fig2", [], []

    def learner(cell: Cell, redrawn: int) -> dict[str, Any]:
        names.append(cell.name)
        return {"returns": [1.0, 2.0], "failure": None, "seconds": 1.0}

    def learners(cells: list[Cell], redrawn: list[int]) -> list[dict[str, Any]]:
        batches.append([cell.name for cell in cells])
        return [
            swingup.learner_cell(*pair) for pair in zip(cells, redrawn, strict=True)
        ]

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "learner_cells", learners)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)
    monkeypatch.setattr(swingup, "oracle_cells", lambda cells: [ORACLE] * len(cells))
    run_cell(Cell("furuta", "nominal", "SIM2GP", 0, 2), out)
    alone = draw(tmp_path / "other")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    names.clear()
    about = draw(out)
    assert sorted(map(len, batches)) == [1, 2, 2]
    assert about["devices_of_cells"] == {"cpu": 2, "gpu": 6}
    assert alone["devices_of_cells"] == {"cpu": 8}
    del about["devices_of_cells"], alone["devices_of_cells"]
    assert about == alone
    draw(out)
    assert len(names) == len(set(names)) == 5


@pytest.mark.parametrize("fails", [False, True])
def test_a_cell_has_what_its_last_fit_found(
    fails: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a fit that failed nothing but the failure; together with others the same.

    The pole hangs in the first episode, and in the second it is up.
    """
    before = Sim2GP(Furuta()).init(jax.random.key(0))
    after = eqx.tree_at(lambda b: b.count, before, jnp.asarray(250))
    nothing, rows = np.zeros((0, 1)), np.ones((1, 1))

    class Run(SamplingRun):
        def __init__(self) -> None:
            self.trajectories, self.belief = [], before
            self.task = swingup.task_and_model(cell, "SIM2GP", 0)[0]
            self.data = Transitions.of(nothing, nothing, nothing)

        def next(self, update_every: int | None = None) -> Trajectory:
            states = np.pi * len(self.trajectories) * np.ones((60, 4))
            self.trajectories.append(Trajectory(states, rows, rows[0], rows[0] > 2.0))
            return self.trajectories[-1]

        def fit(self) -> None:
            if fails:
                raise NotConverged("E201", "no MAP")
            self.belief = after

    cell = Cell("furuta", "nominal", "SIM2GP", 0, 2)
    run = Run()

    def misfit(belief: Any, data: Any) -> SimpleNamespace:
        assert belief is after
        assert data is run.data
        return SimpleNamespace(alarm=True)

    monkeypatch.setattr(swingup, "_sampling", lambda cell, redrawn: run)
    monkeypatch.setattr(swingup, "misfit_of_belief", misfit)
    values = swingup.learner_cell(cell, 0)
    run.belief = after
    ended = run.trajectories, values["failure"] or ""
    monkeypatch.setattr(swingup, "learn_together", lambda runs, episodes: [ended])
    (together,) = swingup.learner_cells([cell], [0])
    del values["seconds"], together["seconds"]
    assert together == values
    if fails:
        one = {"returns": [1.0], "reached": [False], "failure": "E201 no MAP."}
        assert values == one
    else:
        found = {"forces": [], "contradicted": True}
        both = {"returns": [1.0, 1.0], "reached": [False, True], "failure": None}
        assert values == both | found
