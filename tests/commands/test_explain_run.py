"""`sim2gp explain` on finished runs: logs, a demo's flights, and its errors."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import planted_effects as study
import stub_commands
from sim2gp import systems as sy
from sim2gp.cli import main
from sim2gp.commands.explain import explain, load_explainable, project_file, window_data
from sim2gp.commands.identify import identify
from sim2gp.errors import InputError
from sim2gp.project import Project, load_project
from sim2gp.runs import Progress, load_run, new_run
from sim2gp.runs.executors import Processes
from simulated_logs import simulated
from tests.commands.test_identify import project_in, write

QUIET = Progress(quiet=True)
SPRING = sy.Spring("theta", 4.5e-3)


def only(monkeypatch: pytest.MonkeyPatch, *kinds: str) -> None:
    """These candidates instead of eighteen: the whole library takes minutes."""

    def short(system: Any, *, windows: bool = False) -> tuple[sy.Candidate, ...]:
        every = sy.candidates(system, windows=windows)
        return tuple(c for c in every if c.name in kinds)

    monkeypatch.setattr(
        "sim2gp.identification.missing_physics.search.registered", short
    )


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "theta.spring", "theta.viscous")


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Project:
    """A machine that has a spring, and of which none is known."""
    folder = tmp_path_factory.mktemp("explain")
    for seed in (1, 2):
        log = simulated(seconds=1.3, seed=seed, noise=5e-4, effects=(SPRING,))
        write(log, folder / "logs" / f"log{seed}.csv")
    return load_project(project_in(folder))


@pytest.fixture(scope="module")
def run(project: Project) -> Path:
    """Its identification."""
    found = identify(project, progress=QUIET, held_out=False)
    return found.save(project.path.parent / "run")


def explained(run: Path, out: Path, *, add: bool) -> dict[str, Any]:
    """The command line's summary; an error of the input is raised."""
    found = load_explainable(run)
    file = project_file(found) if add else None
    missing = explain(found, progress=QUIET)
    missing = missing.add_to(file) if file else missing
    missing.save(out)
    return missing.summary


@pytest.mark.nightly  # two processes that compile for themselves
def test_processes_find_the_same(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "theta.spring", "theta.coulomb", "theta.drag")
    asked = []

    class Counted(Processes):
        def spread(self, work: Any, groups: Any) -> Any:
            asked.append(len(groups))
            return super().spread(work, groups)

    found = load_explainable(run)
    one, two = (explain(found, workers=Counted(n), progress=QUIET) for n in (1, 2))
    (jobs,) = asked
    assert jobs > 1
    assert one.summary["candidates"] == two.summary["candidates"]
    assert one.summary["warnings"] == two.summary["warnings"]
    assert one.summary["misfit"] == two.summary["misfit"]
    assert two.winner is not None
    assert two.winner.scored.candidate.name == "theta.spring"


@pytest.mark.nightly  # 80 s: a run and two searches
@pytest.mark.usefixtures("few")
def test_a_spring_is_found_in_logs_and_added(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    summary = explained(run, out, add=True)
    json.dumps(summary, allow_nan=False)
    assert summary["best"] == "theta.spring"
    assert summary["none_of_these"] is False
    first, last = summary["candidates"]
    assert {"effect", "evidence_gain", "parameter", "value"} <= {*first}
    assert first["effect"] == "spring"
    assert first["evidence_gain"] > summary["threshold"]
    assert abs(first["value"] - SPRING.magnitude) < 4.0 * first["sd"]
    assert last["like"] == ["arm_damping"]
    assert load_run(out).summary["answer"] == "missing"
    assert "theta.spring" in (out / "report.html").read_text()
    project = run.parent / "machine.toml"
    assert load_project(project).system.parameters.names[-1] == "theta.spring"
    # The run was made with another file: nothing is added twice.
    with pytest.raises(InputError, match=r"E160.*changed.*identify again"):
        explained(run, out, add=True)


def test_windows_of_a_second_share_an_error(project: Project) -> None:
    data = window_data(project, project.load_logs())
    assert data.cluster.tolist() == [0] * 5 + [1] + [2] * 5 + [3]
    assert data.period == 0.0


@pytest.mark.usefixtures("few")
@pytest.mark.nightly
def test_a_demo_is_explained_by_its_own_flights(tmp_path: Path) -> None:
    episodes = study.episodes_in("furuta", SPRING, jax.random.key(6))
    with new_run(tmp_path / "demo", "demo") as writer:
        writer.write_summary(
            {
                "command": "demo",
                "machine": "furuta",
                "episodes": 2,
                "animation": {"dt": 0.02},
            }
        )
        states = np.concatenate([S[:-1] for S, _ in episodes])
        inputs = np.concatenate([A for _, A in episodes])
        arrays = {"animation/state": states, "animation/action": inputs}
        writer.write_arrays("arrays.npz", arrays)
    out, demo = tmp_path / "out", tmp_path / "demo"
    summary = explained(demo, out, add=False)
    assert summary["best"] == "theta.spring"
    with pytest.raises(InputError, match=r"E160.*--add without a project"):
        explained(demo, out, add=True)


def test_a_run_without_data_is_told(tmp_path: Path) -> None:
    with new_run(tmp_path / "other", "evaluate") as writer:
        writer.write_summary({"command": "evaluate"})
        writer.write_arrays("arrays.npz", {"x": np.zeros(1)})
    out, other = tmp_path / "out", tmp_path / "other"
    with pytest.raises(
        InputError, match=r"E130.*got evaluate.*identify or sim2gp demo"
    ):
        explained(other, out, add=False)
    assert not out.exists()


@pytest.mark.nightly
def test_the_command_line_hands_on(
    run: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)

    added: list[Path] = []

    class Missing(stub_commands.Returned):
        def add_to(self, file: Path) -> Any:
            added.append(file)
            return self

    def output(found: Any, *, workers: int, progress: Progress) -> Any:
        assert found.training_logs()
        assert workers == 2
        return Missing({"answer": "missing", "path": str(found.path)})

    monkeypatch.setattr("sim2gp.commands.explain.explain", output)
    text = (run / "project.toml").read_text()
    (run.parent / "machine.toml").write_text(text)  # as it was identified
    assert main(["explain", str(run), "--add", "--workers", "2", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["path"] == str(run)
    assert added == [run.parent / "machine.toml"]
    assert load_run(Path("runs/explain-run")).summary == said
    for args, words in (
        (["explain"], "E160 missing RUN"),
        (["explain", str(tmp_path)], "E130"),
        (["explain", str(run), "--ad"], "did you mean --add"),
    ):
        assert main(args) == 2
        fault = capsys.readouterr().err
        assert words in fault
        assert fault.count("\n") == 1
