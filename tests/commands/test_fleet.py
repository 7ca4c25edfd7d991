"""`sim2gp identify --each`: machines of one kind, from logs in folders of their own."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands import fleet
from sim2gp.commands.compare_setup import _piece
from sim2gp.commands.fleet import FittedFleet, IdentifiedFleet, _cells, identify_fleet
from sim2gp.commands.load_run import load_run
from sim2gp.commands.window_length import chosen_window
from sim2gp.errors import InputError, NotConverged
from sim2gp.project import Project, load_project
from sim2gp.project.project import SHORT
from sim2gp.runs import Progress
from sim2gp.runs.executors import Processes
from sim2gp.runs.plain import from_exact
from sim2gp.systems import Furuta
from simulated_logs import simulated
from tests.commands.test_identify import project_in, write

QUIET = Progress(quiet=True)
TIMES = {"a": 0.8, "b": 1.0, "c": 1.3}  # the nominal damping of the arm


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """Three pendulums that differ in the damping of the arm; one has two logs."""
    folder = tmp_path_factory.mktemp("fleet")
    damping = Furuta().parameters.nominal()["arm_damping"]
    for seed, (name, times) in enumerate(TIMES.items()):
        (folder / "logs" / name).mkdir(parents=True)
        for run in range(2 if name == "a" else 1):
            changes = {"arm_damping": damping * times}
            log = simulated(
                seconds=1.3, seed=10 * seed + run, noise=5e-4, changes=changes
            )
            write(log, folder / "logs" / name / f"run{run}.csv")
    path = project_in(folder)
    text = path.read_text().replace("logs/*.csv", "logs/{robot}/*.csv")
    path.write_text(text.replace("window = 0.2\n", ""))
    return load_project(path)


@pytest.fixture(scope="module")
def found(project: Project) -> IdentifiedFleet:
    return identify_fleet(project, project.load_each("robot"), progress=QUIET)


def test_machines_and_their_kind_are_found(
    project: Project, found: IdentifiedFleet
) -> None:
    table, damping = project.system.parameters, Furuta().parameters.nominal()
    assert found.summary["machines"] == ["a", "b", "c"]
    assert found.summary["logs"] == {"a": 2, "b": 1, "c": 1}
    entry = found.summary["kind"]["arm_damping"]
    for name, times in TIMES.items():
        one = entry["machines"][name]
        truth = times * damping["arm_damping"]
        assert one["low"] < one["value"] < one["high"]
        assert abs(one["value"] - truth) < one["high"] - one["low"]
    assert 0.1 < entry["spread"]["value"] / damping["arm_damping"] < 0.8
    same = found.summary["kind"]["motor_constant"]
    assert same["spread"]["value"] < 0.01 * same["kind"]["value"]
    with jax.enable_x64(True):
        j = table.names.index("arm_damping")
        wider, kind = found.another.sd()[j], found.kind.sd()[j]
        assert wider > kind > found.machines["b"].sd()[j]


def test_one_machine_chooses_how_long_windows_are(
    project: Project, found: IdentifiedFleet
) -> None:
    """The one with most samples, as `identify` does with its logs."""
    most = project.load_each("robot")["a"]
    alone = chosen_window(project, most, key=jax.random.key(0))
    assert found.project is not None
    assert found.project.window == alone.window > SHORT
    about = found.summary["window"]
    assert (about["seconds"], about["chosen"]) == (alone.window, True)
    assert "a, which has most samples" in about["text"]
    assert about["text"] in (table.get("note") for table in found.summary["tables"])


def fitted_with(
    monkeypatch: pytest.MonkeyPatch, most: float
) -> Callable[..., tuple[FittedFleet, list[float]]]:
    """`fit_machines`, and the lengths that were tried; longer than ``most`` fails."""

    def fit(project: Project, machines: Any) -> tuple[FittedFleet, list[float]]:
        tried = []

        def fails(
            project: Project, machines: Any, said: str, **how: Any
        ) -> FittedFleet:
            tried.append(project.window)
            if project.window > most:
                raise NotConverged("E201", where="c", what="lost", got="", expected="")
            return FittedFleet(project, said, cast(Any, None), [], [])

        monkeypatch.setattr(fleet, "_fit_machines", fails)
        return fleet.fit_machines(project, machines, progress=QUIET), tried

    return fit


def test_where_one_machine_cannot_be_fitted_windows_are_short(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    machines = project.load_each("robot")
    fit = fitted_with(monkeypatch, SHORT)
    found, tried = fit(project, machines)
    assert (found.project.window, len(tried)) == (SHORT, 2)
    assert tried[0] > SHORT
    assert "E201" in found.said
    with pytest.raises(NotConverged):  # a stated length stays
        fit(project.with_window(0.6), machines)


def test_no_machine_is_left_out_because_its_logs_are_short(
    project: Project, monkeypatch: pytest.MonkeyPatch
) -> None:
    machines = project.load_each("robot")
    # A fifth of a second.
    short = tuple(_piece(log, log.time < log.time[100], "") for log in machines["c"])
    fit = fitted_with(monkeypatch, np.inf)
    found, tried = fit(project, dict(machines) | {"c": short})
    assert tried == [SHORT]
    assert "logs of c are too short" in found.said


def test_the_run_is_read_back(found: IdentifiedFleet, tmp_path: Path) -> None:
    again = load_run(found.save(tmp_path / "fleet"))
    assert isinstance(again, IdentifiedFleet)
    for name, known in found.machines.items():
        np.testing.assert_array_equal(again.machines[name].scale, known.scale)
    np.testing.assert_array_equal(again.another.mean, found.another.mean)
    assert "another machine" in (tmp_path / "fleet" / "report.html").read_text()


def test_masked_windows_say_nothing(project: Project) -> None:
    """A machine with fewer windows than another has the posterior of its own alone."""
    cells = _cells(project, project.load_each("robot"), 0)
    (b,) = (cell for cell in cells if cell.machine == "b")
    windows, recording = b._windows()
    own = int(np.asarray(windows.mask).any(axis=(1, 2)).sum())
    assert own < b.count
    assert (recording[own:] == -1).all()
    padded = from_exact(b.compute(None))
    alone = from_exact(replace(b, count=own).compute(None))
    for name, values in padded.items():
        np.testing.assert_allclose(values, alone[name], rtol=1e-6, atol=1e-9)


@pytest.mark.nightly  # two processes that compile for themselves
def test_processes_find_the_same(project: Project, found: IdentifiedFleet) -> None:
    machines = project.load_each("robot")
    two = identify_fleet(project, machines, workers=Processes(2), progress=QUIET)
    assert two.summary["kind"] == found.summary["kind"]


def test_what_cannot_be_is_refused(
    project: Project, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*words: str) -> str:
        assert main(["identify", str(project.path), *words, "--quiet"]) == 2
        return capsys.readouterr().err

    assert "{arm} in each pattern" in said("--each", "arm")
    assert "--nuts" in said("--each", "robot", "--nuts")
    assert "--workers" in said("--workers", "2")
    alone = {"a": project.load_each("robot")["a"]}
    with pytest.raises(InputError, match=r"E160 one machine alone"):
        identify_fleet(project, alone, progress=QUIET)
