"""Longer windows: advised where they are worth it, refused where physics is missing."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from linear_system import linear
from sim2gp.commands.longer import TIMES, Longer, advice, fit_longer_windows
from sim2gp.data.logs import Log
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.intervals.scatter import CorrectedFit
from sim2gp.identification.misfit.residuals import misfit_of_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.project import Project, load_project
from sim2gp.project.training_windows import cut_logs

RATE, NOISE, WINDOW = 10.0, 0.02, 0.5  # Hz, m, s
ROWS, KEY = 400, jax.random.key(0)
PROJECT = """system = "two_link"
[[logs]]
files = ["x.csv"]
columns = {q1 = "q", torque1 = 0.0, torque2 = 0.0}
"""


def recording(drift: float = 0.0, rows: int = ROWS) -> Log:
    """``x' = .7 a0 - .4 a1 + drift`` under held inputs, with white noise."""
    rng = np.random.default_rng(7)
    a = np.repeat(rng.standard_normal((rows // 4 + 1, 2)), 4, axis=0)[:rows]
    x = np.cumsum(np.concatenate([[0.0], (a[:-1] @ [0.7, -0.4] + drift) / RATE]))
    return Log(
        name="log",
        source="log.csv",
        time=np.arange(rows) / RATE,
        channels={"x0": x + NOISE * rng.standard_normal(rows)},
        inputs={"a0": a[:, 0], "a1": a[:, 1]},
        mask={"x0": np.ones(rows, bool)},
    )


def fitted(folder: Path, log: Log) -> tuple[Project, list[Log], CorrectedFit]:
    """A project, its log, and the intervals of windows that nothing contradicts."""
    path = folder / "project.toml"
    path.write_text(f"{PROJECT}[likelihood]\nwindow = {WINDOW}\n")
    project = dataclasses.replace(load_project(path), system=linear(2, 1))
    windows, of = cut_logs(project, [log])
    belief = fit_windows(project.system, windows, key=KEY)
    likelihood = WindowsLikelihood(project.system, windows)
    assert not misfit_of_windows(likelihood, belief).alarm
    return project, [log], corrected_windows(at_zero(likelihood, belief, of))


def asked(folder: Path, log: Log, *, alarm: bool = False) -> Longer:
    return fit_longer_windows(*fitted(folder, log), alarm=alarm, key=KEY)


def dense_sd(log: Log, window: float) -> np.ndarray:
    """Of the two constants by regression on them and on a start of each window."""
    moved = np.stack([log.inputs["a0"], log.inputs["a1"]], axis=1)[:-1] / RATE
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    which = (np.arange(len(moved)) / RATE / window + 1e-9).astype(int)
    X = np.concatenate([moved, np.eye(which.max() + 1)[which]], axis=1)
    precision = X.T @ X / NOISE**2 + np.diag([1.0, 1.0, *np.zeros(which.max() + 1)])
    return np.sqrt(np.diag(np.linalg.inv(precision))[:2])


@pytest.mark.nightly
def test_how_much_more_they_tell(tmp_path: Path) -> None:
    log = recording()
    found = asked(tmp_path, log)
    assert found.advised
    assert found.seconds == pytest.approx(TIMES * WINDOW)
    ratio = dense_sd(log, TIMES * WINDOW) / dense_sd(log, WINDOW)
    assert ratio.max() < 0.4
    np.testing.assert_allclose(list(found.ratio.values()), ratio, rtol=0.35)
    assert "likelihood.window = 2.5 makes" in found.words(WINDOW)


@pytest.mark.nightly
def test_physics_too_slow_for_short_ones_refuses_long_ones(
    tmp_path: Path,
) -> None:
    found = asked(tmp_path, recording(drift=0.02))
    assert "physics that is missing" in found.refused
    answer = found.as_dict(WINDOW)
    assert (answer["ratio"], answer["advised"]) == ({}, False)
    assert "no way to know more" in answer["text"]


@pytest.mark.nightly
def test_what_contradicts_the_model_already_is_not_lengthened(tmp_path: Path) -> None:
    assert "already" in asked(tmp_path, recording(), alarm=True).refused


def test_logs_must_be_long_enough(tmp_path: Path) -> None:
    project, _, honest = fitted(tmp_path, recording())

    def refused(rows: int) -> str:
        short = [recording(rows=rows)]
        return fit_longer_windows(project, short, honest, alarm=False, key=KEY).refused

    assert "too few" in refused(60)
    assert "E116" in refused(11)


def test_who_did_not_ask_is_told_that_one_can(tmp_path: Path) -> None:
    fit = fitted(tmp_path, recording())
    said = advice(*fit, alarm=False, key=KEY, asked=False)["longer"]
    assert "--longer" in said["text"]
    assert said["advised"] is None
    assert advice(*fit, alarm=True, key=KEY, asked=False) == {}
    said = advice(*fit, alarm=True, key=KEY, asked=True)["longer"]
    assert said["advised"] is False


def test_hardly_more_is_said_to_be() -> None:
    assert "hardly more" in Longer(1.0, {"m": 0.95, "b": 0.9}).words(0.2)
    assert "0.5 to 0.95 times" in Longer(1.0, {"m": 0.95, "b": 0.5}).words(0.2)
