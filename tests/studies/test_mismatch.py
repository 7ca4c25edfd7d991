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
from sim2gp.studies.mismatch import EXPRESSIBLE, MismatchMap
from sim2gp.studies.swingup import Cell
from sim2gp.systems import Delay, Furuta
from sim2gp.systems.effects.strengths import effect
from sim2gp.systems.machine import Machine
from sim2gp.systems.parts import AbstractPart

ORACLE = {"hang_return": 50.0, "oracle_return": 150.0, "redrawn": 0, "returns": [150.0]}


def lacking(machine: str, condition: str) -> AbstractPart:
    """What the real machine has and the simulator lacks."""
    (part,) = learners.effects_of(Cell(machine, condition, "SIM2GP", 0, 1))
    return part


def test_the_map_is_the_registered_catalogue():
    """27 settings that a force can be; the others are a delay and a geometry."""
    study = MismatchMap("mismatch")
    rows = study.rows()
    for machine in MACHINES:
        for condition in study.conditions(machine)[1:]:
            found = lacking(machine, condition)
            assert found == effect(machine, *condition.split())
    forces = [m for m, c, w in rows if w == "RES" and c.split()[0] in EXPRESSIBLE]
    assert len(forces) == 27
    assert len(rows) == 4 * (1 + 15 + 1 + 21) + 6 * 15
    assert len(rows["cartpole", "tilt mild", "RES"]) == 10
    assert len(rows["furuta", "spring mild", "FS"]) == 5
    none = lacking("furuta", "nominal")
    assert none == dataclasses.replace(learners.MISSING["furuta"], magnitude=0.0)
    with pytest.raises(InputError, match="did you mean spring"):
        learners.missing("furuta", "sprong mild")


def test_conditions_of_a_figure_are_one_program():
    for machine, (_, preset) in MACHINES.items():
        tasks = [preset(None, (lacking(machine, c),)) for c in CONDITIONS]
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
    """Seeds that both have met, of conditions that both have met."""
    score = np.asarray([[0.0, 0.5, 1.2], [np.nan, np.nan, 0.75], [0.0, 0.0, 0.0]])
    conditions = ("spring mild", "drag mild", "nominal")
    table = {("furuta", c, "RES"): score for c in conditions}
    table |= {("furuta", c, "NLM"): 0.0 * score[:2] for c in conditions[:1]}
    both = mismatch.regrets(table, ("RES", "NLM"))
    assert both == {"RES": pytest.approx(1.5 + 2.25), "NLM": 6.0}
    assert mismatch.regrets(table, ("RES",)) == {"RES": pytest.approx(2 * 6.75)}


def ratio(table, rng):
    """Auto's regret against that of RES."""
    whole = {("furuta", *key): score for key, score in table.items()}
    each = mismatch.regret_by_seed(whole, tuple(METHODS))
    return mismatch.regret_ratio(each, "Auto", "RES", 1.1, rng, "")


@pytest.mark.parametrize(("auto", "holds"), [(1.05, True), (1.2, False)])
def test_auto_is_held_against_the_best_fixed_model(auto, holds):
    """The simulator with the right term does not count: it knows the answer."""
    lost = dict.fromkeys(METHODS, 0.5) | {"RES": 0.2, WITH_TERM: 0.01}
    lost["Auto"] = 0.2 * auto
    claim = mismatch.claims(planted(lost), np.random.default_rng(0))[
        "choosing_costs_little"
    ]
    assert claim["holds"] is holds
    same = f"[{auto:.2f}, {auto:.2f}]"  # both seeds lost alike
    assert claim["figure"] == f"{auto:.2f} {same} times the regret of RES"


def planted(lost, better=()):
    """A whole map on which every learner loses as much in each episode."""
    rows = MismatchMap("mismatch", seeds=2).rows()
    return {
        key: np.full((len(cells), 3), 1.0 - (0.0 if key in better else lost[key[2]]))
        for key, cells in rows.items()
    }


def test_the_ratio_of_regrets_knows_its_seeds():
    """Paired: what a bad seed costs both learners does not widen the interval."""
    rng = np.random.default_rng(0)
    bad = rng.uniform(0.1, 0.9, (30, 1)) * np.ones((1, 3))
    noisy = bad * rng.uniform(0.7, 1.3, (30, 1))
    table = {("drag mild", m): 1.0 - bad for m in METHODS}
    table["drag mild", "Auto"] = 1.0 - noisy
    figure = ratio(table, rng)["figure"]
    low, high = map(float, figure[figure.index("[") + 1 : figure.index("]")].split(","))
    each = noisy[:, 0] / bad[:, 0]
    # The delta method, for the ratio of two means.
    total = bad[:, 0].sum()
    expected = noisy[:, 0].sum() / total
    residual = noisy[:, 0] - expected * bad[:, 0]
    sd = np.sqrt(np.sum(residual**2)) / total
    assert each.std() > 0.1
    assert high - low == pytest.approx(2 * 1.96 * sd, rel=0.2)


def test_sampling_is_looked_for_all_over_the_map():
    name = "sampling_beats_the_point_estimate_somewhere"
    lost = dict.fromkeys(METHODS, 0.5)
    assert not mismatch.claims(planted(lost), np.random.default_rng(0))[name]["holds"]
    table = planted(lost, {("furuta", "drag mild", "SIM2GP")})
    claim = mismatch.claims(table, np.random.default_rng(0))[name]
    assert claim["holds"]
    assert claim["figure"].startswith("drag mild: +0.500")


@pytest.mark.parametrize(("unsolved", "holds"), [(3, True), (4, False)])
def test_settings_that_missing_forces_solve_are_counted(unsolved, holds):
    """By the second episode; a delay does not count, nor the third episode."""
    lost = dict.fromkeys(METHODS, 0.0) | {WITH_TERM: 0.04}
    table = planted(lost)
    keys = [
        k for k in table if k[2] == "MissingForces" and k[1].split()[0] != "nominal"
    ]
    forces = [k for k in keys if k[1].split()[0] in EXPRESSIBLE]
    for key in forces[:unsolved]:
        table[key] = np.asarray([[0.2, 0.9, 1.0], [np.nan, 0.94, 1.0]])
    for key in keys:
        if key not in forces:
            table[key] = np.zeros((2, 3))
    found = mismatch.claims(table, np.random.default_rng(0))
    claim = found["missing_forces_solve_in_two_episodes"]
    assert claim["holds"] is holds
    assert claim["figure"].startswith(f"{27 - unsolved} of 27; not {forces[0][0]}, ")
    assert "(0.92)" in claim["figure"]
    assert not found["missing_forces_cost_little_more_than_the_right_term"]["holds"]


def test_what_missing_forces_cost_where_nothing_is_missing():
    table = planted(dict.fromkeys(METHODS, 0.1))
    name = "missing_forces_cost_nothing_where_nothing_is_missing"
    for machine, score in (("furuta", 0.9), ("cartpole", 0.87)):
        table[machine, "nominal", "MissingForces"] = np.full((2, 3), score)
    found = mismatch.claims(table, np.random.default_rng(0))[name]
    assert not found["holds"]
    assert found["figure"].startswith("-0.015")


def test_what_no_force_can_be_has_to_be_said():
    """A delay unseen by most of its seeds, or noise taken for physics, is a failure."""
    study = MismatchMap("mismatch", seeds=4)
    rows = [key[:2] for key in study.rows() if key[2] == "MissingForces"]
    fine = {"forces": ["theta.position_force"], "contradicted": False}
    doubtful, failed = {"contradicted": True}, {"failure": "E201"}
    seen = {k: [fine] * 4 for k in rows}
    for key in rows:
        if key[1].split()[0] in ("delay", "geometry"):
            seen[key] = [fine, doubtful, failed, fine]
    claim = mismatch.said(seen)
    assert claim["holds"]
    assert claim["figure"] == "9 of 9; with nothing missing in 0%"
    table = {row[0]: row[1:] for row in mismatch.found_table(seen)["rows"]}
    assert table["furuta, spring mild"] == ["theta.position_force (4)", "0"]
    assert table["furuta, delay mild"] == ["theta.position_force (2)", "2"]
    alarmed = seen | {("cartpole", "nominal"): [doubtful, fine, fine, fine]}
    assert not mismatch.said(alarmed)["holds"]
    silent = seen | {("furuta", "delay mild"): [doubtful, fine, fine, fine]}
    assert not mismatch.said(silent)["holds"]
    assert "8 of 9; not furuta, delay mild (25%)" in mismatch.said(silent)["figure"]


def test_the_map_is_written_whole(tmp_path: Path, monkeypatch):
    def learner(cell: Cell, redrawn: int):
        returns = [60.0 + 10.0 * e + cell.seed for e in range(cell.episodes)]
        return {"returns": returns, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(swingup, "learner_cell", learner)
    monkeypatch.setattr(swingup, "oracle_cell", lambda cell: ORACLE)
    study = MismatchMap("mismatch", seeds=2)
    summary = study.run(tmp_path / "map", workers=1, progress=Progress(quiet=True))
    rows = summary["tables"][0]["rows"]
    assert len(rows) == 38
    assert all(row[1].endswith(" [0.20, 0.21] (0/2)") for row in rows)
    assert rows[-1][5] == ""
    stored = json.loads((tmp_path / "map" / "summary.json").read_text())
    assert stored["regret"]["RES"] == pytest.approx(36 * (2.40 + 2.37))
    assert (tmp_path / "map" / "mismatch.png").stat().st_size > 10_000
    assert "Mismatch map" in (tmp_path / "map" / "report.html").read_text()
