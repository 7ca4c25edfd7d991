"""Figures 2 and 4: scores, claims on planted returns, cells that resume."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from sim2gp.errors import InputError, NotConverged
from sim2gp.planning import MPC, SAC
from sim2gp.planning.tasks import MACHINES
from sim2gp.reports import figure2 as drawn
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import run_cell
from sim2gp.runs.cells import Cells
from sim2gp.studies import figure2, learners, swingup
from sim2gp.studies.figure2 import PosteriorSampling
from sim2gp.studies.learners import CONDITIONS, METHODS, TRAINED
from sim2gp.studies.swingup import Cell, Table

ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 1, "returns": [150.0]}


def test_scores_and_the_best_seen_by_hand():
    values = [{"returns": [50.0, 150.0, 100.0]}, {"returns": [60.0]}]
    score = swingup.scores(values, [ORACLE, ORACLE], 3)
    np.testing.assert_allclose(score[0], [0.0, 1.0, 0.5])
    assert score[1, 0] == pytest.approx(0.1)
    assert np.isnan(score[1, 1:]).all()
    best = swingup.best_seen(score)
    np.testing.assert_allclose(best, [[0.0, 1.0, 1.0], [0.1, 0.1, 0.1]])
    np.testing.assert_array_equal(swingup.first_at(score, 0.95), [2.0, np.inf])


def planted(fast: str = "", slow: str = "") -> Table:
    """Everybody solves in episode 2, ``fast`` at once, ``slow`` never; NLM in 5."""
    rng = np.random.default_rng(0)
    table = {}
    for machine in MACHINES:
        for condition in CONDITIONS:
            for method in (*METHODS, *TRAINED):
                score = np.full((10, 6), 1.0) + 1e-3 * rng.standard_normal((10, 6))
                score[:, 0] = 0.1
                if method == "NLM":
                    score[:, :4] = 0.2
                if method == fast:
                    score[:, 0] = 1.0
                if method == slow:
                    score[:] = 0.3
                table[machine, condition, method] = score
    return table


def holds(table: Table, name: str) -> bool:
    return figure2.swing_up_claims(table, np.random.default_rng(1))[name]["holds"]


def test_claims_see_what_was_planted():
    table = planted(fast="FS literal", slow="SIM2GP")
    assert holds(table, "furuta_literal_function_space_is_best_under_mismatch")
    assert holds(table, "furuta_physics_alone_fails_under_mismatch")
    assert not holds(table, "furuta_physics_learns_twice_as_fast")
    assert not holds(table, "furuta_residual_costs_nothing")
    assert not holds(table, "sampling_beats_the_point_estimate_somewhere")
    table = planted(fast="SIM2GP", slow="FS literal")
    assert holds(table, "sampling_beats_the_point_estimate_somewhere")
    assert holds(table, "cartpole_physics_learns_twice_as_fast")
    assert holds(table, "cartpole_RES_FS_solves_mismatch_in_three")
    assert holds(table, "cartpole_MissingForces_solves_mismatch_in_two")
    assert not holds(table, "cartpole_MissingForces_is_best_under_mismatch")
    assert not holds(table, "cartpole_literal_function_space_is_best_under_mismatch")
    assert not holds(table, "cartpole_physics_alone_fails_under_mismatch")
    for claim in figure2.swing_up_claims(table, np.random.default_rng(1)).values():
        assert claim["figure"]
        json.dumps(claim, allow_nan=False)


def test_off_policy_claims_see_what_was_planted():
    def holds(table: Table, name: str) -> bool:
        found = figure2.off_policy_claims(table, np.random.default_rng(1))
        json.dumps(found, allow_nan=False)
        return found[name]["holds"]

    close = "furuta_off_policy_oracle_is_close_to_MPC"
    beaten = "cartpole_the_posterior_beats_domain_randomisation"
    table = planted(fast="FS", slow="domain randomisation")
    assert holds(table, close)
    assert holds(table, beaten)
    assert holds(table, "furuta_FS_is_best_under_mismatch")
    assert not holds(table, "furuta_literal_function_space_is_best_under_mismatch")
    assert not holds(table, "sampling_beats_the_point_estimate_somewhere")
    table = planted(fast="SIM2GP", slow="off-policy oracle")
    assert not holds(table, close)
    assert holds(table, beaten)
    assert not holds(planted(), beaten)
    assert holds(table, "sampling_beats_the_point_estimate_somewhere")


def test_a_policy_that_is_trained_has_cells_of_its_own():
    """Scores are relative to MPC's oracle, whoever learns."""
    cell = Cell("furuta", "nominal", "SIM2GP", 3, 2)
    policy = dataclasses.replace(cell, planning="sac")
    assert isinstance(policy.planner, SAC)
    assert policy.name != cell.name
    assert policy.arguments["planner"]["type"] == "SAC"
    assert set(policy.arguments) == set(cell.arguments)
    assert swingup.reference(policy) == swingup.reference(cell)
    quick = dataclasses.replace(policy, quick=True).planner
    assert quick.steps * quick.updates <= 4000


@pytest.mark.parametrize(
    "method",
    [
        pytest.param("domain randomisation", marks=pytest.mark.nightly),
        pytest.param("off-policy oracle", marks=pytest.mark.nightly),
    ],
)
def test_policies_are_trained_where_no_episode_changes_anything(method, monkeypatch):
    small = SAC(hidden=(8,), num_envs=4, steps=5, updates=1)
    monkeypatch.setitem(learners.PLANNERS, "sac", small)
    cell = Cell("cartpole", "mismatch", method, 0, 2, planning="sac")
    rollout = swingup.learner_cell(cell, 0)
    assert rollout["failure"] is None
    assert len(rollout["returns"]) == 2
    assert np.isfinite(rollout["returns"]).all()


def test_a_finished_cell_is_not_flown_again(tmp_path: Path, monkeypatch):
    cells = Cells(tmp_path / "fig2", swingup.__file__)
    cell = Cell("furuta", "nominal", "SIM2GP", 3, 2)
    assert cells.load(cell.name, cell.arguments) is None
    saved = cells.save(cell.name, cell.arguments, {"returns": (1.0, np.float64(2.0))})
    assert saved == {"returns": [1.0, 2.0]}
    assert run_cell(cell, tmp_path / "fig2") == saved
    assert not [f for f in cells.folder.iterdir() if f.name.startswith(".")]
    # Fewer episodes are there as well; more are not, nor those of another planner.
    fewer = dataclasses.replace(cell, episodes=1)
    assert run_cell(fewer, tmp_path / "fig2") == saved
    monkeypatch.setattr(swingup, "learner_cell", lambda cell, redrawn: {"returns": []})
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)
    more = dataclasses.replace(cell, episodes=4)
    rollout = run_cell(more, tmp_path / "fig2")
    assert rollout == {"returns": [], "device": "cpu"}
    for other in (MPC(horizon=7), MPC(lengths=(0.5, 1.0))):
        monkeypatch.setitem(learners.PLANNERS, "mpc", other)
        with pytest.raises(InputError, match=r"E186 .* 1 with other arguments"):
            cells.load(cell.name, cell.arguments)


def test_a_changed_default_of_the_planner_is_another_planner(monkeypatch):
    """Named by its class and what was passed alone, old cells would count as new."""
    cell = Cell("furuta", "nominal", "SIM2GP", 3, 2)
    before = cell.arguments
    assert before["planner"]["update"]["type"] == "ICEM"
    assert before["planner"]["lengths"] == MPC().lengths
    monkeypatch.setitem(learners.PLANNERS, "mpc", MPC(lengths=(1.0,)))
    assert cell.arguments != before


def test_a_quick_look_has_a_planner_and_cells_of_its_own(monkeypatch):
    """For the oracle as well: a score is relative to the planner that flew."""
    full = Cell("furuta", "nominal", "RES-FS", 0, 2)
    quick = dataclasses.replace(full, quick=True)
    assert quick.name != full.name
    assert quick.arguments != full.arguments
    assert swingup.reference(quick).name != swingup.reference(full).name
    assert swingup.reference(quick).planner == quick.planner != full.planner
    used = []
    trained = []

    def begun(task, model, planner, *rest):
        used.append(planner)
        trained.append((model.steps, model.refit_steps))
        raise NotConverged("E201", "not begun")

    monkeypatch.setattr(swingup, "SamplingRun", begun)
    swingup.learner_cell(quick, 0)
    swingup.learner_cell(full, 0)
    assert trained[0] == tuple(quick.arguments["training"].values()) < trained[1]

    def accept(preset, system, planner, *, key):
        used.append(planner)
        raise KeyboardInterrupt

    monkeypatch.setattr(swingup, "accept_truth", accept)
    for cell in (quick, full):
        with pytest.raises(KeyboardInterrupt):
            swingup.oracle_cell(swingup.reference(cell))
    assert used == 2 * [learners.QUICK_PLANNERS["mpc"], learners.PLANNERS["mpc"]]


@pytest.mark.parametrize("number", ["2", "4"])
def test_the_figure_goes_on_where_it_was(number, tmp_path: Path, monkeypatch):
    """Interrupted after seven cells, the second run computes only what is missing."""
    rollout: list[str] = []

    def learner(cell: Cell, redrawn: int):
        if len(rollout) == 7:
            raise KeyboardInterrupt
        rollout.append(cell.name)
        assert redrawn == 1
        returns = [60.0 + 10.0 * e + cell.seed for e in range(cell.episodes)]
        return {"returns": returns, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)

    def draw():
        study = PosteriorSampling(f"fig{number}", quick=True)
        return study.run(tmp_path / "run", workers=1, progress=Progress())

    with pytest.raises(KeyboardInterrupt):
        draw()
    assert not (tmp_path / "run").exists()
    first = list(rollout)
    rollout.append("go on")
    summary = draw()
    again = rollout[len(first) + 1 :]
    assert not set(first) & set(again)
    methods = figure2.FIGURES[f"fig{number}"][-1]
    assert len(first) + len(again) == 2 * len(CONDITIONS) * len(methods) * len(MACHINES)
    assert summary["seeds"] == 2
    assert (tmp_path / "run" / f"figure{number}.png").stat().st_size > 20_000
    assert f"Figure {number}" in (tmp_path / "run" / "report.html").read_text()
    # Redrawn from the stored arrays alone.
    with np.load(tmp_path / "run" / "arrays.npz") as arrays:
        figure = drawn(dict(arrays), summary)
    assert len(figure.axes) == 4
    assert len(figure.axes[0].lines) == len(methods) + 1
