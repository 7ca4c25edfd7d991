"""A force of no known shape on an arm: explain draws it, and its table explains it."""

from pathlib import Path

import numpy as np
import pytest

import planted_forces as study
from sim2gp.commands.explain import explain
from sim2gp.commands.identify import identify
from sim2gp.project import load_project
from sim2gp.runs import Progress

QUIET = Progress(quiet=True)
PROJECT = """system = "uniform_rod_arm"
[[logs]]
files = ["log.csv"]
time = "time"
[logs.columns]
q1 = "q1"
q2 = "q2"
torque1 = "torque1"
torque2 = "torque2"
"""


@pytest.mark.nightly
def test_a_found_force_goes_into_the_project_as_a_table(tmp_path: Path) -> None:
    case = study.Case(study.ARM, "notch", 5)
    log, planted = study.arm_log_of(case)
    columns = [log.time, *log.channels.values(), *log.inputs.values()]
    header = "time,q1,q2,torque1,torque2"
    np.savetxt(
        tmp_path / "log.csv",
        np.stack(columns, axis=1),
        delimiter=",",
        header=header,
        comments="",
        fmt="%.9g",
    )
    file = tmp_path / "project.toml"
    file.write_text(PROJECT)
    run = identify(load_project(file), progress=QUIET)
    found = explain(run, progress=QUIET)
    assert found.answer == "none of these"
    entry = found.summary["forces"]["q1 by q1"]
    assert entry["name"] == "none of these"
    assert entry["unit"] == "N m"
    at, mean, _, half = found.arrays["forces/q1 by q1"]
    visited = log.channels["q1"]
    seen = (at > np.quantile(visited, 0.025)) & (at < np.quantile(visited, 0.975))
    away = mean - np.asarray(planted.value(at))
    away = (away - away[seen].mean())[seen]
    assert np.mean(np.abs(away) < half[seen]) > 0.9
    added = found.add_to(file)
    assert added.summary["added"] == str(file)
    assert "[effects.q1.position_table]" in file.read_text()
    again = identify(load_project(file), progress=QUIET)
    assert "q1 by q1" not in again.summary["forces"]
