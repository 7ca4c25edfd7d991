"""identify and evaluate from end to end, on logs whose machine is known."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands.evaluate import evaluate
from sim2gp.commands.identification import restore_identification
from sim2gp.commands.identify import identify
from sim2gp.data.logs import Log
from sim2gp.errors import InputError
from sim2gp.identification.missing_physics.at_zero import forces_of
from sim2gp.project import load_project
from sim2gp.runs import Progress, load_run
from sim2gp.runs.store import new_run
from sim2gp.systems import Furuta, Machine
from simulated_logs import FREE, simulated

QUIET = Progress(quiet=True)
PROJECT = """system = "furuta"

[parameters]
{fixed}

[[logs]]
files = ["logs/*.csv"]

[logs.columns]
theta = "theta"
alpha = "alpha"
voltage = "u"

[likelihood]
window = 0.2
"""


def write(log: Log, path: Path) -> None:
    """The log as a robot would have written it."""
    columns = [log.time, *(log.channels[n] for n in ("theta", "alpha"))]
    table = np.column_stack([*columns, log.inputs["voltage"]])
    path.parent.mkdir(exist_ok=True)
    np.savetxt(path, table, "%.12g", ",", header="time,theta,alpha,u", comments="")


def project_in(folder: Path, extra: str = "") -> Path:
    nominal = Furuta().parameters.nominal()
    fixed = "\n".join(f"{n} = {v}" for n, v in nominal.items() if n not in FREE)
    path = folder / "machine.toml"
    path.write_text(PROJECT.format(fixed=fixed) + extra)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("identify")
    for seed in (1, 2):
        log = simulated(seconds=1.3, seed=seed, noise=5e-4)
        write(log, folder / "logs" / f"log{seed}.csv")
    write(simulated(seconds=1.3, seed=3, noise=5e-4), folder / "held" / "log3.csv")
    return folder


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    path, out = project_in(folder), folder / "run"
    words = ["identify", str(path), "--check", "--quiet", "--out", str(out)]
    assert main(words) == 0
    return out


def test_identify_finds_the_constants(run: Path) -> None:
    summary = load_run(run).summary
    nominal = Furuta().parameters.nominal()
    assert list(summary["parameters"]) == sorted(FREE, key=list(nominal).index)
    for name, entry in summary["parameters"].items():
        assert entry["mean"] == pytest.approx(nominal[name], rel=0.1), name
        assert abs(entry["mean"] - nominal[name]) < 4.0 * entry["sd"], name
        for key in ("unit", "prior_mean", "prior_sd", "q025", "q975", "verdict"):
            assert key in entry
        plain = entry["plain"]
        assert entry["widened"] == pytest.approx(entry["sd"] / plain["sd"])
        assert 1.0 - 1e-9 < entry["widened"] < 2.0, name  # the logs' noise is white
        assert entry["q025"] < plain["q025"] < plain["q975"] < entry["q975"]
    assert summary["intervals"]["which"] == "corrected"
    assert summary["intervals"]["freedom"] > 4.0
    for key in ("log_evidence", "directions", "misfit", "n_transitions", "n_rows"):
        assert key in summary
    assert summary["n_rows"] == 1300
    misfit = summary["misfit"]
    assert [*misfit["tests"]] == ["chi2", "ljung_box", "f_test", "split_half"]
    assert misfit["verdict"].startswith("Nothing in 1200 samples contradicts the model")
    assert not misfit["alarm"]
    assert misfit["tests"]["chi2"]["p"] is None  # the noise was estimated
    assert len(misfit["noise"]) == 2
    assert set(summary["noise"]) == {"theta", "alpha"}
    assert summary["project"] == {"file": "machine.toml", "folder": ".."}


def test_few_programs_are_compiled(folder: Path, compilations: list[str]) -> None:
    """What is small is NumPy's: a program of one operation compiles for 20 ms."""
    project = load_project(project_in(folder))
    jax.clear_caches()
    identify(project, progress=QUIET, held_out=False)
    assert 4 < len(compilations) <= 30


def test_identify_checks_laplace_against_the_exact_posterior(run: Path) -> None:
    summary = load_run(run).summary
    check = summary["check"]
    assert check["verdict"] == "fine"
    assert check["k"] < 0.5
    assert check["draws"] > 100
    for entry in check["constants"].values():
        assert abs(entry["shift"]) < 0.2
        assert entry["sd_ratio"] == pytest.approx(1.0, abs=0.15)
    assert "--check --quiet" in summary["command_line"]


def test_belief_and_intervals_are_both_kept(run: Path) -> None:
    """Draws of the table are those of its intervals; the belief stays Laplace's."""
    stored = load_run(run)
    x, entries = stored.arrays, stored.summary["parameters"]
    plain = np.linalg.norm(x["belief/scale"], axis=1)
    wide = np.linalg.norm(x["intervals/scale"], axis=1)
    assert np.all(wide > plain)
    ratio = [entry["widened"] for entry in entries.values()]
    np.testing.assert_allclose(wide / plain, ratio, rtol=0.02)
    sd = [entry["sd"] for entry in entries.values()]
    np.testing.assert_allclose(x["parameters/samples"].std(axis=0), sd, rtol=0.1)


def test_identify_writes_a_report_with_traces(run: Path) -> None:
    text = (run / "report.html").read_text()
    assert 'id="traces"' in text
    assert text.count('<span class="why">plain: ') == len(FREE)
    assert "Gaussian is fine (Pareto k" in text
    assert "Without likelihood.window in the project file" in text
    assert "white noise would" in text
    assert "nan" not in text.lower().replace("nanos", "")
    arrays = load_run(run).arrays
    assert np.isnan(arrays["trace/log1/time"]).any()  # gaps between windows
    assert arrays["trace/log1/low/theta"].shape == arrays["trace/log1/time"].shape


def test_identify_forecasts_a_log_that_it_left_out(run: Path) -> None:
    """Oracle: the same machine, whose errors are far below those of standing still."""
    stored = load_run(run)
    about, x = stored.summary["held_out"], stored.arrays
    assert about["left_out"] == "the log log2"
    assert about["windows"] == 7  # every 0.1 s, half a second before the log's end
    assert about["open_loop_rmse"]["alpha"] < 0.2 * about["hold_rmse"]["alpha"]
    ratio = about["trivial"]["alpha"]["ratio"]
    assert ratio < 0.2
    for words in (about["headline"], (run / "report.html").read_text()):
        assert "A fit without the log log2 predicts it 0.5 s ahead" in words
        assert f"rad, {ratio:.2g} times the error of holding still" in words
    assert about["calibration"]["channels"]["alpha"]["verdict"] == "too few to say"
    logs = {key.split("/")[1] for key in x if key.startswith("unseen/")}
    assert logs == {"log2"}
    both = [x[f"{kind}/log2/predicted/alpha"] for kind in ("unseen", "trace")]
    assert 1e-6 < np.nanmax(np.abs(both[0] - both[1])) < 0.1  # by another fit
    text = (run / "report.html").read_text()
    for words in (
        'id="heldout"',
        'id="calibration"',
        'id="machine"',
        "without the log log2",
    ):
        assert words in text
    command = stored.summary["command_line"]
    assert command == (
        f"sim2gp identify {run.parent / 'machine.toml'} --check --quiet --out {run}"
    )
    assert {"python", "sim2gp", "jax", "numpy"} <= set(stored.summary["versions"])


def test_a_film_shows_what_was_recorded_and_forecast(run: Path) -> None:
    stored = load_run(run)
    about, x = stored.summary["animation"], stored.arrays
    assert about["system"] == "furuta"
    assert about["dt"] == pytest.approx(0.01)
    starts = [round(mark["time"] / about["dt"]) for mark in about["marks"]]
    assert starts[:3] == [0, 50, 100]
    np.testing.assert_allclose(
        x["animation/state"][starts], x["animation/recorded"][starts], atol=5e-3
    )
    pairs = ("state", "predicted"), ("recorded", "measured")
    for row, name in enumerate(("theta", "alpha")):
        for kind, curve in pairs:  # the windows that are drawn, each without its end
            logs = [x[f"trace/log{k}/{curve}/{name}"] for k in (1, 2)]
            drawn = np.concatenate(logs).reshape(-1, 52)[:, :50].ravel()
            np.testing.assert_allclose(x[f"animation/{kind}"][:, row], drawn, atol=1e-6)


def _evaluated(run: Path, folder: Path, *, horizon: float) -> Any:
    fit = restore_identification(run)
    logs = fit.read_logs([folder / "held" / "log3.csv"])
    return evaluate(fit, logs, horizon=horizon, progress=QUIET)


def test_evaluate_predicts_a_log_from_anywhere(
    run: Path, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    log, out = folder / "held" / "log3.csv", tmp_path / "out"
    words = ["evaluate", run, "--logs", log, "--out", out, "--quiet"]
    assert main([str(word) for word in words]) == 0
    summary = load_run(out).summary
    json.dumps(summary, allow_nan=False)
    for key in ("open_loop_rmse", "one_step_rmse", "nll", "coverage90", "coverage95"):
        assert set(summary[key]) == {"theta", "alpha"}
    assert summary["windows"] == 10
    assert summary["open_loop_rmse"]["alpha"] < 0.2 * summary["hold_rmse"]["alpha"]
    assert summary["one_step_rmse"]["alpha"] < 0.01
    assert [row[0] for row in summary["tables"][1]["rows"]] == ["log3", "pooled"]
    assert "training logs" not in " ".join(summary["warnings"])
    assert "times the error of" in summary["headline"]
    for table in summary["tables"][:2]:
        assert {"alpha, held", "alpha, regression"} <= set(table["columns"])
    assert summary["command_line"] == (
        f"sim2gp evaluate {run} --logs {log} --out {out} --quiet"
    )


def stored_with_forces(run: Path, folder: Path, friction: float) -> Path:
    """The run again, with dry friction on both joints in its forecasts."""
    was = load_run(run)
    machine, x = restore_identification(run).machine, was.arrays
    names = ("theta", "alpha", "theta.velocity", "alpha.velocity", "voltage")
    box = {name: [-1.0, 1.0] for name in names}
    forces = forces_of(machine, dict.fromkeys(names, (-1.0, 1.0)))
    p = len(machine.parameters)
    k = p + sum(len(f.values) for f in forces if f.what == "dry_friction")
    mean, scale = np.full(k, friction), np.zeros((k, k))
    mean[:p], scale[:p, :p] = x["belief/mean"], x["belief/scale"]
    entries = {"forecast_forces": {"dry_friction": 1.0}, "forecast_box": box}
    with new_run(folder, "identify") as writer:
        writer.write_summary(was.summary | entries)
        writer.write_arrays(
            "arrays.npz", x | {"forecast/mean": mean, "forecast/scale": scale}
        )
        writer.write_text("project.toml", (run / "project.toml").read_text())
    return folder


def test_a_stored_run_is_evaluated_with_its_forces(
    run: Path, folder: Path, tmp_path: Path
) -> None:
    """Of no size they change nothing, of a size they do; both are named."""
    plain = _evaluated(run, folder, horizon=0.2)
    assert "forecast_forces" not in plain.summary
    for friction, same in ((0.0, True), (2e-3, False)):
        again = stored_with_forces(run, tmp_path / f"run{friction}", friction)
        found = _evaluated(again, folder, horizon=0.2)
        assert found.summary["forecast_forces"] == {"dry_friction": 1.0}
        assert "dry friction" in found.summary["headline"]
        ratio = found.rmse["theta"] / plain.rmse["theta"]
        assert (ratio == pytest.approx(1.0, rel=1e-9)) is same


def test_forces_that_no_fit_has_found_are_refused(run: Path, tmp_path: Path) -> None:
    again = stored_with_forces(run, tmp_path / "run", float("nan"))
    with pytest.raises(InputError, match="E183"):
        restore_identification(again)


@pytest.mark.nightly
def test_leave_one_out_predicts_every_log(folder: Path, tmp_path: Path) -> None:
    project, out = load_project(project_in(folder)), tmp_path / "out"
    found = evaluate(project, progress=QUIET)
    summary = found.summary
    found.save(out)
    rows = summary["tables"][1]["rows"]
    assert [row[0] for row in rows] == ["log1", "log2", "pooled"]
    one, two, pooled = (float(row[2]) for row in rows)
    assert min(one, two) <= pooled <= max(one, two)
    assert [row[0] for row in summary["tables"][2]["rows"]] == ["log1", "log2"]
    kept = load_run(out).arrays
    assert {key.split("/")[1] for key in kept if "/low/" in key} == {"log1", "log2"}
    assert "calibration/share/alpha" in kept


@pytest.mark.nightly  # the same three fits in five processes
def test_folds_are_the_same_wherever_they_are_computed(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In this process; in two; as shares on a Ray cluster, joined."""
    project = str(project_in(folder))

    def evaluated(name: str, *words: str) -> str:
        out = str(tmp_path / name)
        assert main(["evaluate", project, "--quiet", "--out", out, *words]) == 0
        return capsys.readouterr().out

    evaluated("two", "--workers", "2")
    assert "share 1 of 2: 1 of 2 cells" in evaluated("a", "--shard", "1/2", "--ray")
    assert "share 2 of 2: 1 of 2 cells" in evaluated("b", "--shard", "2/2", "--ray")
    evaluated("joined", "--merge", str(tmp_path / "a"), str(tmp_path / "b"))
    two, joined = (load_run(tmp_path / name) for name in ("two", "joined"))
    assert joined.summary["tables"] == two.summary["tables"]
    assert joined.summary["headline"] == two.summary["headline"]
    assert joined.arrays.keys() == two.arrays.keys()
    for name, values in two.arrays.items():
        np.testing.assert_array_equal(joined.arrays[name], values, err_msg=name)
    summary = evaluate(load_project(project), progress=QUIET).summary
    assert summary["tables"] == two.summary["tables"]


def test_effects_are_constants_of_the_machine(folder: Path) -> None:
    effect = "[effects.theta.coulomb]\nmean = 5e-4\nsd = 5e-4\nmap = 'log'\n"
    path = project_in(folder, f"\n{effect}width = 0.02\n[effects.alpha]\ndrag = 0.1\n")
    system = load_project(path).build_system()
    assert isinstance(system, Machine)
    assert [e.name for e in system.effects] == ["theta.coulomb", "alpha.drag"]
    assert system.effects[0].width == 0.02
    assert system.parameters["theta.coulomb"].map == "log"
    assert dict(system.parameters.fixed)["alpha.drag"] == 0.1
