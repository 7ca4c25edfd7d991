"""The mismatch map: conditions, regrets and the claim, on planted cells."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from sim2gp.errors import InputError
from sim2gp.models import PointEstimate
from sim2gp.planning.tasks import MACHINES, furuta_swingup
from sim2gp.runs import Progress
from sim2gp.studies import learners, mismatch, swingup
from sim2gp.studies.learners import CONDITIONS, METHODS, WITH_TERM
from sim2gp.studies.mismatch import MismatchMap
from sim2gp.studies.swingup import Cell
from sim2gp.systems import Delay, Furuta
from sim2gp.systems.effects.strengths import effect
from sim2gp.systems.machine import Machine

ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 0, "returns": [150.0]}


def test_the_map_is_the_registered_catalogue():
    assert mismatch.EFFECTS == ("coulomb", "dead_zone", "spring", "delay", "drag")
    for name in mismatch.EFFECTS:
        for strength in ("mild", "middle", "strong"):
            (found,) = learners.effects_of("furuta", f"{name} {strength}")
            assert found == effect("furuta", name, strength)
    (none,) = learners.effects_of("furuta", "nominal")
    assert none == dataclasses.replace(learners.MISSING["furuta"], magnitude=0.0)
    with pytest.raises(InputError, match="did you mean spring"):
        learners.effects_of("furuta", "sprong mild")


def test_conditions_of_a_figure_are_one_program():
    for machine, (_, preset) in MACHINES.items():
        tasks = [preset(None, learners.effects_of(machine, c)) for c in CONDITIONS]
        nominal, mismatched = map(jax.tree.structure, tasks)
        assert nominal == mismatched
        s, a = tasks[0].start + 0.3, tasks[0].actions.high
        plain = preset().dynamics(s, a)
        # An effect may ask for shorter substeps: apart by what Runge-Kutta leaves.
        np.testing.assert_allclose(tasks[0].dynamics(s, a), plain, rtol=1e-4)
        assert np.any(np.abs(tasks[1].dynamics(s, a) - plain) > 1e-3)


def test_the_right_term_is_there_for_delays_as_well():
    lacking = learners.missing("furuta", "delay strong")
    assert isinstance(lacking, Delay)
    model = METHODS[WITH_TERM](Furuta(), lacking, {})
    assert isinstance(model.system, Machine)
    assert "voltage.delay" in model.system.parameters.names
    low, high = 0.0, 2 * lacking.magnitude
    table = {p.name: p for p in model.system.parameters.free}
    assert (table["voltage.delay"].low, table["voltage.delay"].high) == (low, high)
    assert model.system.history == 2  # 40 ms of past actions, every 20 ms


def test_a_learner_that_wraps_another_keeps_its_past_actions(monkeypatch):
    right = METHODS[WITH_TERM]
    monkeypatch.setitem(METHODS, "wrapped", lambda *x: PointEstimate(right(*x)))
    cell = Cell("furuta", "delay strong", "wrapped", 0, 2)
    for method, expected in (("wrapped", 2), (WITH_TERM, 2), ("SIM2GP", 0)):
        _, model = learners.task_and_model(cell, method, 0)
        assert model.history == expected


def test_the_box_of_a_learner_is_the_tasks():
    reach = learners.reach_of(furuta_swingup(), Furuta())
    found = {name: pytest.approx(half) for name, half in reach.items()}
    assert found == {"theta": 2.0, "theta.velocity": 15.0, "alpha.velocity": 25.0}


def test_regret_by_hand():
    score = np.asarray([[0.0, 0.5, 1.2], [np.nan, np.nan, 0.75]])
    table = {("spring mild", "SIM2GP"): score, ("drag mild", "SIM2GP"): score}
    assert mismatch.regrets(table) == {"SIM2GP": pytest.approx(2 * (1.5 + 2.25))}


@pytest.mark.parametrize(("auto", "holds"), [(1.05, True), (1.2, False)])
def test_auto_is_held_against_the_best_fixed_model(auto, holds):
    """The simulator with the right term does not count: it knows the answer."""
    lost = dict.fromkeys(METHODS, 0.5) | {"RES": 0.2, WITH_TERM: 0.01}
    lost["Auto"] = 0.2 * auto
    table = {("spring mild", m): np.full((2, 3), 1.0 - x) for m, x in lost.items()}
    claim = mismatch.mismatch_claims(table, np.random.default_rng(0))[
        "choosing_costs_little"
    ]
    assert claim["holds"] is holds
    same = f"[{auto:.2f}, {auto:.2f}]"  # both seeds lost alike
    assert claim["figure"] == f"{auto:.2f} {same} times the regret of RES"


def test_the_ratio_of_regrets_knows_its_seeds():
    """Paired: what a bad seed costs both learners does not widen the interval."""
    rng = np.random.default_rng(0)
    bad = rng.uniform(0.1, 0.9, (30, 1)) * np.ones((1, 3))
    noisy = bad * rng.uniform(0.7, 1.3, (30, 1))
    table = {("drag mild", m): 1.0 - bad for m in METHODS}
    table["drag mild", "Auto"] = 1.0 - noisy
    figure = mismatch.mismatch_claims(table, rng)["choosing_costs_little"]["figure"]
    low, high = map(float, figure[figure.index("[") + 1 : figure.index("]")].split(","))
    ratio = noisy[:, 0] / bad[:, 0]
    # The delta method, for the ratio of two means.
    total = bad[:, 0].sum()
    expected = noisy[:, 0].sum() / total
    residual = noisy[:, 0] - expected * bad[:, 0]
    sd = np.sqrt(np.sum(residual**2)) / total
    assert ratio.std() > 0.1
    assert high - low == pytest.approx(2 * 1.96 * sd, rel=0.2)


def test_sampling_is_looked_for_all_over_the_map():
    table = {(c, m): np.full((5, 3), 0.5) for c in ("drag mild", "x") for m in METHODS}
    name = "sampling_beats_the_point_estimate_somewhere"
    assert not mismatch.mismatch_claims(table, np.random.default_rng(0))[name]["holds"]
    table["drag mild", "SIM2GP"] = np.full((5, 3), 0.6)
    claim = mismatch.mismatch_claims(table, np.random.default_rng(0))[name]
    assert claim["holds"]
    assert claim["figure"].startswith("drag mild: +0.100")


def test_the_map_is_written_whole(tmp_path: Path, monkeypatch):
    def learner(cell: Cell, redrawn: int):
        returns = [60.0 + 10.0 * e + cell.seed for e in range(cell.episodes)]
        return {"returns": returns, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)
    study = MismatchMap("mismatch", seeds=2)
    summary = study.run(tmp_path / "map", workers=1, progress=Progress(quiet=True))
    rows = summary["tables"][0]["rows"]
    assert len(rows) == 15
    assert all(row[1] == "0.30 (0/2)" for row in rows)
    assert len(summary["returns"]) == 15 * (2 * len(METHODS) + 2)
    stored = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert stored["regret"]["RES"] == pytest.approx(15 * (2.40 + 2.37))
    assert (tmp_path / "map" / "mismatch.png").stat().st_size > 10_000
    assert "Mismatch map" in (tmp_path / "map" / "report.html").read_text()
