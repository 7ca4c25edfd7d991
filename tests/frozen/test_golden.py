"""Projects and runs that an older version wrote still load, and mean the same.

`golden/` was written at 84a1618: two projects with logs of machines simulated by others
(scipy, MuJoCo), and the runs that ``sim2gp identify`` made of them.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sim2gp as sg
from sim2gp.cli import main
from sim2gp.experiments.identified import restored

GOLDEN = Path(__file__).parent / "golden"
pytestmark = pytest.mark.skipif(
    not GOLDEN.is_dir(), reason="the golden runs are in the repository alone"
)
PROJECTS = ("furuta", "arm")
SD, NATS = 0.01, 0.01  # of a posterior's sd or an interval's width; of log evidence


@pytest.mark.parametrize("name", PROJECTS)
def test_a_project_still_opens_the_same_parameters(name: str) -> None:
    if name == "arm":
        pytest.importorskip("mujoco")
    summary = sg.load_run(GOLDEN / "runs" / name).summary
    project = sg.load_project(GOLDEN / f"{name}.toml")
    assert project.system.parameters.names == tuple(summary["parameters"])


@pytest.mark.parametrize("name", PROJECTS)
def test_a_run_still_has_its_posterior(name: str) -> None:
    if name == "arm":
        pytest.importorskip("mujoco")
    run = sg.load_run(GOLDEN / "runs" / name)
    fit = restored(GOLDEN / "runs" / name)
    for gaussian, prefix in ((fit.posterior, "intervals"), (fit.plain, "belief")):
        np.testing.assert_array_equal(gaussian.mean, run.arrays[f"{prefix}/mean"])
        np.testing.assert_array_equal(gaussian.scale, run.arrays[f"{prefix}/scale"])


@pytest.mark.nightly
@pytest.mark.parametrize("name", PROJECTS)
def test_a_project_is_identified_as_before(name: str, tmp_path: Path) -> None:
    """Posterior, evidence, corrected intervals and forecasts, by what a command writes.

    The noise of the forecasts' bands is compared as a number of the summary.
    """
    for file in GOLDEN.glob(f"{name}*"):
        shutil.copy(file, tmp_path)
    out = tmp_path / "run"
    main(["identify", str(tmp_path / f"{name}.toml"), "--out", str(out)])
    same_run(sg.load_run(GOLDEN / "runs" / name), sg.load_run(out))


def same_run(before: Any, now: Any) -> None:
    """What a run says of parameters, evidence, intervals and held-out forecasts."""
    was, is_ = before.summary, now.summary
    assert abs(is_["log_evidence"] - was["log_evidence"]) < NATS
    for prefix in ("belief", "intervals"):
        sd = np.linalg.norm(before.arrays[f"{prefix}/scale"], axis=1)
        for key in ("mean", "scale"):
            a, b = (x.arrays[f"{prefix}/{key}"] for x in (before, now))
            if key == "scale":
                a, b = (np.linalg.norm(x, axis=1) for x in (a, b))
            assert np.max(np.abs(a - b) / sd) < SD, f"{prefix}/{key}"
    assert {k: e["verdict"] for k, e in was["parameters"].items()} == {
        k: e["verdict"] for k, e in is_["parameters"].items()
    }
    for name, error in was["held_out"]["open_loop_rmse"].items():
        assert is_["held_out"]["open_loop_rmse"][name] == pytest.approx(error, rel=SD)


def test_the_golden_summaries_are_json() -> None:
    for name in PROJECTS:
        text = (GOLDEN / "runs" / name / "summary.json").read_text()
        assert json.loads(text)["command"] == "identify"
