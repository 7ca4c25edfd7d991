"""Figures 3 and 5's bookkeeping: transitions needed, claims, cells, the pictures."""

import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from sim2gp.belief import AbstractBelief
from sim2gp.errors import InputError
from sim2gp.inference.gaussian import Gaussian
from sim2gp.planning.tasks import MACHINES
from sim2gp.reports import figure3 as drawn
from sim2gp.runs import Progress
from sim2gp.runs.cell_work import run_cell
from sim2gp.runs.cells import Cells
from sim2gp.studies import exploring, figure3
from sim2gp.studies.exploring import METHODS, Cell, HeldOut
from sim2gp.studies.figure3 import Exploration
from sim2gp.studies.learners import CONDITIONS, task_and_model


def test_transitions_needed_by_hand():
    """An error that falls as 1 / n: read off exactly, also between two looks."""
    counts = np.asarray([25.0, 50.0, 100.0])
    early = np.stack([counts, 10.0 / counts], axis=1)
    rmse = 10.0 / (250.0 * np.arange(1, 4))
    for count in (30.0, 100.0, 180.0, 250.0, 600.0, 750.0):
        error = 10.0 / count * (1.0 + 1e-12)
        assert figure3.transitions_needed(early, rmse, error) == pytest.approx(count)
    assert figure3.transitions_needed(early, rmse, 1.0) == 25.0
    assert figure3.transitions_needed(early, rmse, 1e-3) == np.inf
    # A look that failed is passed over.
    early[1, 1] = np.nan
    assert figure3.transitions_needed(early, rmse, 0.1) == pytest.approx(100.0)


def planted(best: str, times: float):
    """SIM2GP learns ``times`` as fast as under random input; ``best`` predicts best."""
    rng = np.random.default_rng(0)
    table, early = {}, {}
    steps = 250.0 * np.arange(1, 5)
    looks = np.asarray([25.0, 50.0, 100.0])
    for machine in MACHINES:
        for condition in CONDITIONS:
            for method in METHODS:
                speed = times if method == "SIM2GP" else 1.0
                columns = {q: np.zeros((10, 4)) for q in exploring.QUANTITIES}
                columns["rmse"] = np.tile(10.0 / (speed * steps), (10, 1))
                columns["nll"] = 0.1 * rng.standard_normal((10, 4)) - 5.0
                columns["nll"] -= 2.0 * (method == best)
                columns["swung_up"][:6, 1] = method == "SIM2GP"
                key = machine, condition, method
                table[key] = columns
                rows = np.stack([looks, 10.0 / (speed * looks)], axis=1)
                early[key] = np.tile(rows, (10, 1, 1))
    return table, early


def test_claims_see_what_was_planted():
    def claims(best: str, times: float):
        return figure3.exploration_claims(
            *planted(best, times), np.random.default_rng(1)
        )

    found = claims("RES-FS", 4.0)
    assert found["furuta_exploring_halves_the_data"]["holds"]
    assert found["furuta_exploring_halves_the_data"]["figure"].startswith("0.25 of")
    assert found["cartpole_RES_FS_predicts_best_under_mismatch"]["holds"]
    assert not found["cartpole_FS_predicts_best_under_mismatch"]["holds"]
    assert found["furuta_exploring_alone_swings_up"]["holds"]
    assert "60% of seeds" in found["furuta_exploring_alone_swings_up"]["figure"]
    slow = claims("FS", 1.5)
    assert not slow["furuta_exploring_halves_the_data"]["holds"]
    assert slow["furuta_FS_predicts_best_under_mismatch"]["holds"]
    # What was run for random input is no explorer's: it cannot win the claim.
    other = claims("RES-FS, random", 4.0)
    assert other["furuta_RES_FS_predicts_best_under_mismatch"]["holds"]


def test_a_seed_that_random_input_lost_tells_nothing():
    """All of its fits failed: the claim rests on the others, or on none."""
    table, early = planted("FS", 4.0)
    for machine, lost in (("furuta", slice(0, 1)), ("cartpole", slice(None))):
        table[machine, "nominal", "SIM2GP, random"]["rmse"][lost] = np.nan
    found = figure3.exploration_claims(table, early, np.random.default_rng(1))
    assert found["furuta_exploring_halves_the_data"]["figure"].startswith("0.25 of")
    none = found["cartpole_exploring_halves_the_data"]
    assert not none["holds"]
    assert "no seed" in none["figure"]


class Off(AbstractBelief):
    """Predicts the truth, a given share of the noise aside."""

    truth: jax.Array
    off: float

    @property
    def noise(self):
        return jnp.asarray([0.1, 0.2, 0.3, 0.4])

    def predict(self, s, a):
        i = jnp.argmin(jnp.sum((self.truth[:, 0] - s[None]) ** 2, axis=1))
        scale = jnp.diag(jnp.asarray([0.1, 0.2, 0.3, 0.4]))
        return Gaussian(self.truth[i, 1] + self.off * jnp.diag(scale), scale)

    def latent(self, s, a):
        raise AssertionError("not of interest here")

    sample = point = sensitivity = coordinates = latent


def test_scores_of_a_forecast_by_hand():
    noise = np.asarray([0.1, 0.2, 0.3, 0.4])
    rng = np.random.default_rng(0)
    S, truth = rng.standard_normal((2, 30, 4))
    S2 = truth + noise * rng.standard_normal((30, 4))
    test = HeldOut(S, np.zeros((30, 1)), S2, truth)
    with jax.enable_x64(True):
        belief = Off(jnp.stack([jnp.asarray(S), jnp.asarray(truth)], axis=1), 0.5)
    found = exploring.tested(belief, test, noise)
    assert found["rmse"] == pytest.approx(0.5)
    mean = truth + 0.5 * noise
    density = scipy.stats.norm.logpdf(S2, mean, noise).sum(axis=1)
    assert found["nll"] == pytest.approx(-np.mean(density))
    inside = np.mean(np.abs(S2 - mean) < 1.96 * noise)
    assert found["coverage95"] == pytest.approx(inside)


def test_what_is_tested_is_the_swing_up_of_the_oracle():
    """Rows in their places, and the truth that made them."""
    cell = Cell("furuta", "mismatch", "SIM2GP", 0, 1)
    task, _ = task_and_model(cell, "SIM2GP", 0)
    rng = np.random.default_rng(1)
    states, actions = rng.uniform(-1, 1, (2, 6, 4)), rng.uniform(-1, 1, (2, 5, 1))
    test = HeldOut.of(task, {"states": states, "actions": actions})
    assert test.state.shape == test.truth.shape == (10, 4)
    np.testing.assert_allclose(test.next_state[4], states[0, 5], rtol=1e-6)
    np.testing.assert_allclose(test.state[5], states[1, 0], rtol=1e-6)
    s, a = (jnp.asarray(x[7], jnp.float32) for x in (test.state, test.action))
    np.testing.assert_allclose(test.truth[7], task.dynamics(s, a), atol=1e-5)


def test_a_finished_cell_is_not_flown_again(tmp_path: Path, monkeypatch):
    cells = Cells(tmp_path / "exploring", exploring.__file__)
    cell = Cell("furuta", "nominal", "SIM2GP", 3, 2)
    values = {"rmse": [1.0, 0.5], "failure": None, "early": []}
    saved = cells.save(cell.name, cell.arguments, values)
    assert run_cell(cell, tmp_path / "exploring") == saved
    more = dataclasses.replace(cell, episodes=3)
    monkeypatch.setattr(exploring, "oracle_cell", lambda cell: {"redrawn": 0})
    monkeypatch.setattr(exploring, "learner_cell", lambda cell, oracle: dict(values))
    assert run_cell(more, tmp_path / "exploring") == values | {"device": "cpu"}
    monkeypatch.setattr(exploring, "EXPLORER", exploring.QUICK_EXPLORER)
    with pytest.raises(InputError, match=r"E186 .* 1 with other arguments"):
        cells.load(cell.name, cell.arguments)
    # A first fit that failed is not tried again either.
    lost = {"rmse": [], "failure": "E203", "early": []}
    saved = cells.save(more.name, more.arguments, lost)
    assert run_cell(more, tmp_path / "exploring") == saved
    # Random input needs no planner, whichever it is.
    random = dataclasses.replace(cell, method="SIM2GP, random")
    assert random.arguments["planner"]["type"] == "RandomInput"


@pytest.mark.parametrize(
    "figure", ["fig3", pytest.param("fig5", marks=pytest.mark.nightly)]
)
@pytest.mark.nightly
def test_the_figure_is_written_whole(figure: str, tmp_path: Path, monkeypatch):
    rollout: list[str] = []

    def learner(cell: Cell, oracle):
        rollout.append(cell.name)
        columns = {q: [1.0 / e for e in range(1, 4)] for q in exploring.QUANTITIES}
        looks = [{"transitions": 25.0, "rmse": 3.0}]
        early = looks if METHODS[cell.method].model == "SIM2GP" else []
        return columns | {"early": early, "failure": None, "seconds": 1.0}

    monkeypatch.setattr(exploring, "learner_cell", learner)
    monkeypatch.setattr(exploring, "oracle_cell", lambda cell: {"redrawn": 0})

    def draw(name: str, seeds: int | None = 2, quick: bool = False):
        study = Exploration(name, seeds=seeds, episodes=3, quick=quick)
        return study.run(tmp_path / name, workers=1, progress=Progress(quiet=True))

    summary = draw(figure)
    count = len(rollout)
    assert count == 2 * len(MACHINES) * len(CONDITIONS) * len(METHODS)
    other = {"fig3": "fig5", "fig5": "fig3"}[figure]
    draw(other)
    assert len(rollout) == count  # one study, two pictures
    stored = json.loads((tmp_path / figure / "summary.json").read_text())
    assert stored["claims"].keys() == summary["claims"].keys()
    assert stored["figure3"]["shown"] == figure3.FIGURES[figure]
    names = {path.name for path in (tmp_path / figure).iterdir()}
    assert {"fig3.png", "fig5.png", "report.html", "arrays.npz"} <= names
    with np.load(tmp_path / figure / "arrays.npz") as arrays:
        picture = drawn(dict(arrays), stored, "nll")
    assert len(picture.axes) == 4
    # A quick look has fewer learners, and says which.
    quick = draw(figure, None, quick=True)
    shown = quick["figure3"]["methods"]
    assert set(METHODS) - set(shown) == set(figure3.NOT_QUICK)
    assert len(rollout) - count == len(MACHINES) * len(CONDITIONS) * len(shown)
    assert [row[0] for row in quick["tables"][0]["rows"]] == shown
