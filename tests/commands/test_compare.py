"""compare from end to end: a planted missing term must be found, a whole model kept."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

import machines
from sim2gp.cli import main
from sim2gp.commands import compare, compare_setup
from sim2gp.errors import InputError
from sim2gp.models import ResidualFunctionSpace
from sim2gp.project import load_project
from sim2gp.runs import Progress, load_run
from sim2gp.systems import Machine, Spring, UniformRodArm

QUIET = Progress(quiet=True)
#: The simulator and one learned model: each model more is half a minute of compiling,
#: and so is a box of its own for each of the two arms.
BOX = {"q1.velocity": 12.0, "q2.velocity": 20.0}
SOME: compare.Learners = {
    "SIM2GP": compare.MODELS["SIM2GP"],
    "MissingForces": compare.MODELS["MissingForces"],
    "RES-FS": compare.MODELS["RES-FS"]._replace(
        make=lambda sim, reach: ResidualFunctionSpace(
            sim, hidden=(32, 32), steps=900, reach=BOX
        )
    ),
}
SPRINGS = {"q1.spring": 2.0, "q2.spring": 1.0}  # N m/rad
PROJECT = """system = "uniform_rod_arm"

[parameters]
b1 = {b1}
m1 = {m1}
l1 = 0.5
l2 = 0.4

[[logs]]
files = ["{folder}/*.csv"]
time = "t"

[logs.columns]
q1 = "q1"
q2 = "q2"
torque1 = "u1"
torque2 = "u2"
"""


def recorded(path: Path, *, seed: int, share: float, seconds: float = 2.5) -> None:
    """A log of the paper's arm as a file, with a share of two cables at its joints."""
    rng = np.random.default_rng(seed)
    time = 2e-3 * np.arange(int(seconds / 2e-3))
    held = np.repeat(rng.uniform(-1.0, 1.0, (len(time) // 100 + 1, 2)), 100, axis=0)
    arm = Machine(UniformRodArm(), [Spring("q1", 0.0), Spring("q2", 0.0)])
    with jax.enable_x64(True):
        cables = {name: share * value for name, value in SPRINGS.items()}
        values = arm.parameters.nominal() | cables
        params = arm.record({k: jnp.asarray(v, float) for k, v in values.items()})
        ode = jax.jit(lambda s, a: machines.ode(arm, params, s, a))

        def rate(t: float, s: np.ndarray) -> np.ndarray:
            k = int(np.searchsorted(time, t, side="right")) - 1
            return np.asarray(ode(jnp.asarray(s), jnp.asarray(held[k])))

        s0 = rng.uniform(-0.5, 0.5, 4)
        solved = scipy.integrate.solve_ivp(
            rate, (0.0, time[-1]), s0, t_eval=time, rtol=1e-6, atol=1e-8, max_step=0.01
        )
    q = solved.y[:2] + 5e-4 * rng.standard_normal((2, len(time)))
    path.parent.mkdir(exist_ok=True)
    rows = np.column_stack([time, *q, held[: len(time)]])
    np.savetxt(path, rows, "%.9g", ",", header="t,q1,q2,u1,u2", comments="")


def project_in(folder: Path, logs: str) -> Path:
    path = folder / f"{logs}.toml"
    nominal = UniformRodArm().parameters.nominal()
    path.write_text(PROJECT.format(folder=logs, b1=nominal["b1"], m1=nominal["m1"]))
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four logs of an arm as believed, four of one with a cable that nobody knows."""
    folder = tmp_path_factory.mktemp("compare")
    for name, share in (("whole", 0.0), ("cable", 1.0)):
        for seed in range(4):
            path = folder / name / f"log{seed}.csv"
            recorded(path, seed=seed, share=share)
    return folder


def compared(folder: Path, name: str) -> Path:
    """The run on the logs of one of the two arms, left out two at a time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_setup, "MOST_FOLDS", 2)
        project = load_project(project_in(folder, name))
        found = compare.compare(
            project, progress=QUIET, horizons=(0.2, 0.4), models=SOME
        )
        found.save(folder / f"run-{name}")
    return folder / f"run-{name}"


@pytest.fixture(scope="module")
def cable(folder: Path) -> Path:
    return compared(folder, "cable")


@pytest.mark.nightly
def test_a_missing_term_calls_for_more_than_the_simulator(cable: Path) -> None:
    summary = load_run(cable).summary
    for name in ("MissingForces", "RES-FS"):
        entry = summary["models"][name]
        assert entry["crps_change_high"] < -0.3
        assert entry["better_in"] == entry["of"] == 4
    # A cable is a force by position: learned as one, it needs less data.
    assert summary["best"] == "MissingForces"
    words = "The logs support the simulator plus missing forces"
    assert summary["headline"].startswith(words)
    assert "4 of 4 logs" in summary["headline"]
    for horizon in (0.2, 0.4):
        assert f"Error of MissingForces at {horizon} s: q1 " in summary["headline"]
    assert "times the error of" in summary["headline"]
    names = [row[0] for row in summary["tables"][0]["rows"]]
    assert names == [*SOME, "holding still", "regression"]


@pytest.mark.nightly
def test_a_simulator_without_fault_is_kept(folder: Path, cable: Path) -> None:
    del cable  # its compiled functions serve here too
    summary = load_run(compared(folder, "whole")).summary
    assert summary["best"] == "SIM2GP"
    assert summary["headline"].startswith("The logs support the simulator alone")
    assert summary["models"]["RES-FS"]["crps_change_high"] > 0.0
    # A quarter of a degree: the simulator predicts down to start and sensor.
    assert max(summary["models"]["SIM2GP"]["heldout_rmse"].values()) < 0.01


@pytest.mark.nightly
def test_what_a_comparison_stores(cable: Path) -> None:
    run = load_run(cable)
    summary = run.summary
    json.dumps(summary, allow_nan=False)
    assert list(summary["models"]) == list(SOME)
    for name, entry in summary["models"].items():
        assert (entry["log_evidence"] is None) == (name != "SIM2GP")
        for key in ("heldout_nll", "heldout_rmse", "heldout_crps"):
            assert list(entry[key]) == ["q1", "q2"]
            assert all(isinstance(v, float) for v in entry[key].values())
        assert list(entry["horizons"]) == ["0.2", "0.4"]
        assert entry["horizons"]["0.2"]["rmse"] == entry["heldout_rmse"]
        assert isinstance(entry["step_log_score"], float)
    sim = summary["models"]["SIM2GP"]
    assert sim["crps_change"] == sim["crps_change_low"] == sim["crps_change_high"] == 0
    assert summary["period"] == pytest.approx(0.02)
    assert summary["folds"] == 2
    assert summary["n_logs"] == 4
    # Starts at 0.1, 0.2, ... s that leave 0.2 s of the 2.5 s.
    assert summary["windows"] == 4 * 22
    titles = [table["title"] for table in summary["tables"]]
    assert [t.startswith("Forecasts") for t in titles] == [True, True, False]
    page = (cable / "report.html").read_text()
    assert "Error against horizon" in page
    assert "CRPS against SIM2GP" in page
    curve = run.arrays["curve/RES-FS/q1"]
    np.testing.assert_allclose(run.arrays["curve/horizon"], [0.1, 0.2, 0.3, 0.4])
    assert curve[1] == pytest.approx(
        summary["models"]["RES-FS"]["heldout_rmse"]["q1"], rel=1e-12
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--horizon", "nan"], ["E148", "--horizon"]),
        (["--horizon", "0.2", "100"], ["E160", "100 s"]),
        (["--horizon", "0.2", "5"], ["E116", "shorten --horizon"]),
        (["--horizon", "soon"], ["E148", "soon"]),
        (["--horizn", "0.2"], ["E160", "did you mean --horizon"]),
        (["--seed", "-1"], ["E149"]),
    ],
)
def test_bad_arguments_are_one_line(
    folder: Path,
    arguments: list[str],
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    path = project_in(folder, "cable")
    before = sorted(folder.rglob("*"))
    assert main(["compare", str(path), *arguments]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    for word in words:
        assert word in said.err
    assert sorted(folder.rglob("*")) == before


def test_every_position_must_be_measured(folder: Path) -> None:
    path = project_in(folder, "cable")
    lame = folder / "lame.toml"
    lame.write_text(path.read_text().replace('q2 = "q2"\n', ""))
    with pytest.raises(InputError, match="also q2") as caught:
        compare.compare(load_project(lame), progress=QUIET, models=SOME)
    assert caught.value.code == "E103"
    assert "lame.toml:line" in str(caught.value)


def test_one_recording_leaves_out_its_last_quarter(folder: Path) -> None:
    found = load_project(project_in(folder, "cable"))
    logs = found.load_logs()[:1]
    setup, folds = compare_setup.prepare_comparison(found, logs, (0.2,))
    assert [log.name for log in setup.logs] == ["log0", "log0, last quarter"]
    assert folds == [[1]]
    # The box of states without limits holds all that was seen.
    assert list(setup.reach) == list(BOX)
    seen = np.abs(setup.samples.rough[:, 2:]).max(axis=0)
    np.testing.assert_allclose(list(setup.reach.values()), 1.2 * seen)
    before, after = setup.logs
    assert len(before) + len(after) == len(logs[0])
    assert before.time[-1] < after.time[0]
    assert after.duration == pytest.approx(0.25 * logs[0].duration, abs=0.01)
    for name in ("q1", "q2"):
        both = np.concatenate([before.channels[name], after.channels[name]])
        np.testing.assert_array_equal(both, logs[0].channels[name])


def test_many_recordings_are_left_out_in_six_groups(folder: Path) -> None:
    found = load_project(project_in(folder, "cable"))
    log = found.load_logs()[0]
    named = [
        replace(log, name=str(k), source=str(k // 2)) for k in range(16)
    ]  # eight files in two pieces each
    _, folds = compare_setup.prepare_comparison(found, named, (0.2,))
    assert len(folds) == 6
    assert sorted(k for left in folds for k in left) == list(range(16))
    assert folds[0] == [0, 1, 12, 13]
