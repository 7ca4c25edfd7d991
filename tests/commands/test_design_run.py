"""sim2gp design from end to end: from priors, from a fit, and bad input."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands.design import goal_of, setting
from sim2gp.commands.identify import identify
from sim2gp.experiment_design import DOptimal, LimitBox, SubsetDOptimal, by_gradients
from sim2gp.experiment_design.verdict import (
    DesignOptions,
    experiment_verdict,
    prediction_verdict,
)
from sim2gp.project import load_project
from sim2gp.runs import Progress, load_run
from tests.commands.test_identify import folder, project_in

assert folder  # a fixture

SHORT = ["--seconds", "1", "--period", "0.01"]
ASKED = DesignOptions(kind="multisine")
LIMITS = ["--limit", "theta=-1:1", "theta.velocity=-15:15", "--rate", "voltage=200"]


QUICK = {"BLOCK": 5, "BLOCKS": 2, "TRIALS": 40, "GUARDS": 8, "CHECKED": 100}


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    """A fit alone: nothing of it is held out."""
    project, quiet = load_project(project_in(folder)), Progress(quiet=True)
    return identify(project, progress=quiet, held_out=False).save(folder / "run")


@pytest.fixture(autouse=True)
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """A few steps."""
    for name, value in QUICK.items():
        monkeypatch.setattr(by_gradients, name, value)


def rows(path: Path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", names=True, deletechars="")


@pytest.mark.nightly  # 30 s; the search itself is tested by day
def test_before_any_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    project, out = project_in(tmp_path), tmp_path / "next"
    words = ["design", str(project), "--out", str(out), *SHORT, *LIMITS, "--json"]
    assert main(words) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["worth_running"]
    assert summary["information_nats"] > 1.0
    assert "no log was used" in summary["warnings"][0]
    expected = summary["expected_sd"]
    assert set(expected) == {"arm_damping", "motor_constant", "pendulum_length"}
    for entry in expected.values():
        assert 0.0 < entry["expected_sd"] <= entry["sd"] * (1.0 + 1e-9)
    assert summary["violations"] <= 0.01
    table = rows(out / summary["trajectory"])
    assert table.dtype.names[:3] == ("time", "voltage", "expected.theta")
    assert len(table) == 100
    u = table["voltage"]
    assert np.abs(np.diff(u, prepend=0.0)).max() <= 200.0 * 0.01
    assert np.abs(table["expected.theta"]).max() <= 1.0
    stored = load_run(out)
    np.testing.assert_array_equal(stored.arrays["design/command/voltage"], u)
    page = (out / "report.html").read_text()
    assert "The experiment" in page
    assert "expected.theta" not in page
    assert ">limit<" in page


@pytest.mark.nightly
def test_after_a_fit(run: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "next"
    words = ["design", str(run), "--out", str(out), "--seconds", "0.4", *LIMITS]
    assert main([*words, "--kind", "free", "--predict", "0.2", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["period"] == 0.002  # the logs'
    ahead = summary["prediction_sd"]
    gain = np.log(ahead["before"] / ahead["after"])
    assert gain == pytest.approx(summary["information_nats"], rel=0.2)
    assert "0.2 s ahead" in summary["headline"]
    fit = load_run(run).summary["parameters"]
    for name, entry in summary["expected_sd"].items():
        assert entry["sd"] == pytest.approx(fit[name]["plain"]["sd"], rel=1e-6)


def test_what_is_asked_about(tmp_path: Path) -> None:
    asked = dataclasses.replace(ASKED, about=("pendulum_length", "arm_damping"))
    _, experiment, _ = setting(load_project(project_in(tmp_path)), asked)
    names = experiment.system.parameters.names
    box = LimitBox.of(experiment.system, {}, {}, start=np.zeros(4))
    goal = goal_of(asked, experiment, box, jax.random.key(0))
    assert isinstance(goal, SubsetDOptimal)
    assert [names[i] for i in goal.index] == ["pendulum_length", "arm_damping"]
    plain = goal_of(ASKED, experiment, box, jax.random.key(0))
    assert isinstance(plain, DOptimal)


def entry(mean: float, sd: float, left: float, times: float = 1.0) -> dict[str, float]:
    """Of a constant whose corrected sd is ``times`` the plain one."""
    return {"mean": mean, "sd": sd, "of_before": left, "corrected_sd": times * sd}


@pytest.mark.parametrize(
    ("expected", "nats", "worth", "words"),
    [
        ({"m": entry(2.0, 0.2, 0.5)}, 3.0, True, "of m should fall from 10 to 5 %"),
        ({"m": entry(2.0, 0.02, 0.5)}, 3.0, False, "m known within 2 % already"),
        ({"m": entry(2.0, 0.2, 0.999)}, 0.001, False, "nothing narrows m"),
        # Little of many constants adds up to nats, and to no reason.
        ({n: entry(2.0, 0.2, 0.97) for n in "abc"}, 0.1, False, "narrows a, b and c"),
        # What no such experiment narrows is no reason to run it, but it is said.
        (
            {"m": entry(2.0, 0.02, 0.5), "I": entry(1.0, 0.5, 1.0)},
            1.0,
            False,
            "next to nothing about I",
        ),
        # What the model's errors add is no reason to run it, and is not hidden.
        (
            {"m": entry(2.0, 0.02, 0.5, 20.0)},
            1.0,
            False,
            "the model's errors keep m at 20 %",
        ),
        (
            {"m": entry(2.0, 0.2, 0.5, 3.0)},
            3.0,
            True,
            "from 10 to 5 % of its value; with the model's errors it is 30 % now",
        ),
    ],
)
def test_when_to_stop(expected, nats, worth, words) -> None:
    found, text = experiment_verdict(ASKED, expected, nats)
    assert found is worth
    assert words in text


@pytest.mark.parametrize(
    ("before", "after", "times", "worth", "words"),
    [
        (8.0, 2.0, 1, True, "0.5 s ahead, known within 8 sd of the sensors' noise now"),
        (8.0, 2.0, 3, True, "8 sd of the sensors' noise (24 with the model's errors)"),
        (0.9, 0.1, 1, False, "known within 0.9 sd of the sensors' noise already"),
        (8.0, 7.9, 1, False, "nothing narrows what is predicted 0.5 s ahead"),
    ],
)
def test_when_a_prediction_is_good_enough(before, after, times, worth, words) -> None:
    asked = dataclasses.replace(ASKED, predict=0.5)
    ahead = {"before": before, "after": after, "corrected": times * before}
    found, text = prediction_verdict(asked, ahead, 1.4)
    assert found is worth
    assert words in text
