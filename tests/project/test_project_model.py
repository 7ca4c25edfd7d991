"""A model's file as the machine of a project: patterns, ties, priors, faults."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.cli import main
from sim2gp.commands import apply
from sim2gp.commands.design import setting
from sim2gp.commands.identification import restore_identification
from sim2gp.errors import InputError
from sim2gp.experiment_design.verdict import DesignOptions
from sim2gp.project import load_project
from sim2gp.runs import load_run, new_run
from sim2gp.systems.mujoco.load import compiled_all

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

MODEL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody><body name="upper">
    <joint name="shoulder" axis="0 1 0" damping=".05"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.4" mass="1"/>
    <body name="lower" pos="0 0 -.4">
      <joint name="elbow" axis="0 1 0" damping=".02"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass=".5"/>
    </body>
  </body></worldbody>
  <actuator><motor name="push" joint="shoulder" gear="2" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
LOGS = """
[[logs]]
files = ["*.csv"]
[logs.columns]
shoulder = "q1"
elbow = "q2"
push = "u"
"""


def project(folder: Path, text: str) -> Path:
    (folder / "arm.xml").write_text(MODEL)
    path = folder / "arm.toml"
    path.write_text('system = "arm.xml"\n' + text + LOGS)
    return path


def test_patterns_open_constants_and_ties_make_them_one(tmp_path: Path) -> None:
    text = """
[parameters."joint/*/damping"]
tie = true
relative_sd = 0.5
[parameters."body/*/mass"]
relative_sd = 0.1
[parameters]
"actuator/push/gear" = 2.5
"""
    system = load_project(project(tmp_path, text)).system
    table = system.parameters
    names = ("joint/shoulder/damping", "body/upper/mass", "body/lower/mass")
    assert table.names == names
    assert dict(table.fixed) == {"actuator/push/gear": 2.5}
    for name, mean, sd in zip(names, (0.05, 1.0, 0.5), (0.025, 0.1, 0.05), strict=True):
        rng = np.random.default_rng(0)
        p = table[name]
        draws = [p.constrain(x) for x in p.mean + p.sd * rng.standard_normal(800)]
        assert np.mean(draws) == pytest.approx(mean, rel=0.1)
        assert np.std(draws) == pytest.approx(sd, rel=0.1)
    assert (table["body/upper/mass"].low, table["body/upper/mass"].unit) == (0.0, "kg")


def test_a_path_is_the_exception_to_a_pattern(tmp_path: Path) -> None:
    text = """
[parameters."joint/*/damping"]
tie = true
[parameters."joint/elbow/damping"]
value = 0.3
"""
    system = load_project(project(tmp_path, text)).system
    assert system.parameters.names == ("joint/shoulder/damping",)
    assert dict(system.parameters.fixed) == {"joint/elbow/damping": 0.3}
    text = '[parameters]\n"joint/*/damping" = 1.0\n"joint/s*/damping" = 2.0\n'
    with pytest.raises(InputError, match=r"E145 a parameter named twice.*line 2"):
        load_project(project(tmp_path, text))


def test_an_empty_table_opens_all_of_an_inertia(tmp_path: Path) -> None:
    text = '[parameters."body/lower/inertia"]\n[parameters."joint/elbow/damping"]\n'
    table = load_project(project(tmp_path, text + "sd = 0.01\nmean = 0.02\n")).system
    free = {p.name: p for p in table.parameters.free}
    assert len(free) == 11
    alpha = free["body/lower/inertia/alpha"]
    assert (alpha.map, alpha.mean, alpha.sd) == ("identity", 0.0, 0.2)


def test_without_parameters_all_usual_ones_are_open(tmp_path: Path) -> None:
    names = load_project(project(tmp_path, "")).system.parameters.names
    assert {n.split("/")[-1] for n in names} == {"damping", "mass"}
    assert len(names) == 4


def test_an_encoder_of_a_model_may_be_off(tmp_path: Path) -> None:
    text = "[effects.elbow.encoder]\nmean = 0.0\nsd = 0.2\n"
    text += "[effects.shoulder]\nencoder = 0.1"
    system = load_project(project(tmp_path, text)).system
    table = system.parameters
    p = table["elbow.encoder"]
    assert (p.mean, p.sd, p.unit) == (0.0, 0.2, "rad")
    assert dict(table.fixed)["shoulder.encoder"] == 0.1


def test_an_sd_alone_is_about_the_machines_own_number(tmp_path: Path) -> None:
    """The same priors as with that number written as the mean; else a mean is due."""
    pairs = {
        '[parameters."joint/elbow/damping"]': 0.02,
        '[parameters."body/lower/com_x"]': 0.0,
        '[parameters."body/lower/com_z"]': -0.15,
        "[effects.elbow.encoder]": 0.0,
        "[actuators.push.gain]": 1.0,
        "[actuators.push.offset]": 0.0,
    }
    tables = []
    for mean in ("", "mean = {}\n"):
        rows = [f"{head}\nsd = 0.005\n{mean.format(x)}" for head, x in pairs.items()]
        tables.append(load_project(project(tmp_path, "".join(rows))).system.parameters)
    bare, stated = tables
    assert len(bare.free) == len(pairs)
    for one, other in zip(bare.free, stated.free, strict=True):
        assert (one.name, one.map) == (other.name, other.map)
        np.testing.assert_allclose(
            (one.mean, one.sd), (other.mean, other.sd), atol=1e-12
        )
    for text in (
        '[parameters."joint/elbow/frictionloss"]\nsd = 0.1\n',  # zero in the file
        "[actuators.push]\ndelay = {sd = 0.01}\n",
    ):
        with pytest.raises(InputError, match="E160 incomplete prior: mean and sd"):
            load_project(project(tmp_path, text))


TRUTH = {
    "joint/shoulder/damping": 0.08,
    "actuator/push/gear": 1.7,
    "push.delay": 0.01,
}


@pytest.fixture(scope="module")
def identified(tmp_path_factory) -> Path:
    """A run: two constants that were changed, behind a delay; positions measured."""
    folder = tmp_path_factory.mktemp("arm")
    model = mujoco.MjModel.from_xml_string(MODEL)
    model.dof_damping[:] = 0.08
    model.actuator_gear[0, 0] = 1.7
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    rows, u = [], np.repeat(rng.uniform(-1.0, 1.0, 20), 20)
    for i in range(400):
        rows.append([data.time, *(data.qpos + 1e-3 * rng.standard_normal(2)), u[i]])
        data.ctrl[0] = u[i - 2] if i >= 2 else 0.0  # 10 ms late
        mujoco.mj_step(model, data)
    names = "time,q1,q2,u"
    np.savetxt(folder / "a.csv", rows, delimiter=",", header=names, comments="")
    text = """
[parameters."joint/*/damping"]
tie = true
relative_sd = 1.0
[parameters."actuator/push/gear"]
tie = true
[parameters]
"body/lower/mass" = 0.5
[actuators.push]
delay = {low = 0.0, high = 0.02}
"""
    path = project(folder, text)
    words = ["identify", str(path), "--quick", "--quiet"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MUJOCO_GL", "disable")
        assert main([*words, "--out", str(folder / "run")]) == 0
    return folder / "run"


def test_identify_from_a_file_and_logs(identified: Path) -> None:
    parameters = json.loads((identified / "summary.json").read_text())["parameters"]
    assert set(parameters) == set(TRUTH)
    for name, value in TRUTH.items():
        found = parameters[name]
        assert abs(found["mean"] - value) < 4.0 * found["sd"], name
        assert found["verdict"] == "identified"
        assert found["sd"] < 0.1 * value


def test_its_report_has_a_stick_figure(identified: Path) -> None:
    """Posed by MuJoCo: as the closed form of two links says, at what was recorded."""
    stored = load_run(identified)
    about, x = stored.summary["animation"], stored.arrays
    assert about["title"].startswith("Forecasts of fitted data")
    assert [strip[1] for strip in about["strips"]] == ["shoulder", "elbow"]
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    for row in (0, 30, 60):
        data.qpos[:] = x["animation/recorded"][row]
        mujoco.mj_kinematics(model, data)
        found = x["animation/recorded_points"][row]
        np.testing.assert_allclose(found[:2], data.xanchor, atol=1e-5)
    assert "mujoco" in stored.summary["versions"]
    assert "held_out" not in stored.summary
    assert " --quick " in stored.summary["command_line"]
    assert "animation/frames" not in x
    assert "<polyline data-i=" in (identified / "report.html").read_text()


def test_its_constants_go_into_the_file(identified: Path, capsys) -> None:
    """Both of a tie; the delay and the source stay; the diff is what changed."""
    run, out = str(identified), identified.parent / "learned.xml"
    before = {p.name: p.read_bytes() for p in identified.parent.glob("*.*")}
    assert main(["apply", run, "--quiet"]) == 0
    shown = capsys.readouterr().out
    assert {p.name: p.read_bytes() for p in identified.parent.glob("*.*")} == before
    assert main(["apply", run, "--out", str(out), "--json", "--quiet"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["written"] == [str(out)]
    assert summary["not_written"] == {"push.delay": "no parameter of the model's file"}
    model = mujoco.MjModel.from_xml_path(str(out))
    damping, gear = model.dof_damping[0], model.actuator_gear[0, 0]
    assert model.dof_damping.tolist() == [damping, damping]
    parameters = json.loads((identified / "summary.json").read_text())["parameters"]
    assert damping == pytest.approx(
        parameters["joint/shoulder/damping"]["mean"], rel=0.02
    )
    assert gear == pytest.approx(parameters["actuator/push/gear"]["mean"], rel=0.02)
    lines = out.read_text().split("\n")
    changed = [(b, a) for b, a in zip(MODEL.split("\n"), lines, strict=True) if a != b]
    assert len(changed) == 3
    for old, new in changed:
        assert f"-{old}\n" in shown
        assert f"+{new}\n" in shown
        assert f"+{new}\n" in summary["diff"]
    assert main(["apply", run, "--out", str(out)]) == 2
    assert "E132 file exists" in capsys.readouterr().err


def test_what_leaves_a_run_is_as_wide_as_its_report(
    identified: Path, tmp_path: Path, capsys
) -> None:
    """Draws, files and `apply`: the corrected posterior, or the plain one by its name.

    Of a run whose corrected posterior is far from the plain one, by copying it so.
    """
    stored, run = load_run(identified), identified.parent / "wide"
    table = restore_identification(identified).project.system.parameters
    x = dict(stored.arrays)
    rng = np.random.default_rng(0)
    x["intervals/scale"] = (
        20.0
        * x["belief/scale"]
        @ np.linalg.qr(rng.normal(size=x["belief/scale"].shape)).Q
    )
    x["intervals/mean"] = x["belief/mean"] + 0.05
    with jax.enable_x64(True):
        x["intervals/theta"] = np.asarray(
            table.constrain(jnp.asarray(x["intervals/mean"]))
        )
    with new_run(run, "identify") as writer:
        writer.write_arrays("arrays.npz", x)
        writer.write_summary(stored.summary)
        writer.write_text("project.toml", (identified / "project.toml").read_text())

    fit, eps = restore_identification(run), []
    for prefix, known in (("intervals", fit.posterior), ("belief", fit.plain)):
        np.testing.assert_array_equal(known.mean, x[f"{prefix}/mean"])
        np.testing.assert_array_equal(known.scale, x[f"{prefix}/scale"])
        which = {"intervals": "corrected", "belief": "plain"}[prefix]
        asked = [] if which == "corrected" else ["--posterior", "plain"]
        out = tmp_path / which
        words = ["export", str(run), "--out", str(out), "--draws", "6", "--json"]
        assert main([*words, *asked, "--quiet"]) == 0
        about = json.loads(capsys.readouterr().out)["model"]
        assert about["posterior"] == which
        rows = load_run(out).arrays
        draws = np.stack([rows[f"draws/{name}"] for name in table.names], axis=1)
        with jax.enable_x64(True):
            tt = np.asarray(jax.vmap(table.unconstrain)(jnp.asarray(draws)))
        eps.append(np.linalg.solve(x[f"{prefix}/scale"], (tt - x[f"{prefix}/mean"]).T))
        assert (out / "variant_005.xml").exists()

        assert main(["apply", str(run), "--json", "--quiet", *asked]) == 0
        applied = json.loads(capsys.readouterr().out)
        assert applied["posterior"] == which
        theta = dict(zip(table.names, x[f"{prefix}/theta"], strict=True))
        for name, entry in applied["constants"].items():
            if name in theta:
                assert entry["is"] == pytest.approx(theta[name], rel=1e-9)

    # Of one seed they are the same standard normal numbers, each in its own posterior.
    np.testing.assert_allclose(eps[0], eps[1], atol=1e-6)
    assert 0.5 < eps[0].std() < 1.6
    question = DesignOptions(seconds=1.0)
    _, experiment, _ = setting(fit, question)
    np.testing.assert_array_equal(experiment.belief.scale, x["belief/scale"])
    np.testing.assert_array_equal(experiment.plausible.mean, x["intervals/mean"])


def test_a_file_that_was_changed_in_place_is_no_longer_the_one_fitted(
    identified: Path, tmp_path: Path, capsys
) -> None:
    """Its own numbers are what relative priors are about; `apply` keeps its values."""
    other = tmp_path / "other.xml"
    other.write_text(MODEL.replace('damping=".02"', 'damping=".7"'))
    given = ["apply", str(identified), "--model", str(other), "--in-place", "--quiet"]
    for count in (3, 0):
        assert main([*given, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert len(found["constants"]) == count
    model = mujoco.MjModel.from_xml_path(str(other))
    assert model.dof_damping[0] == model.dof_damping[1] < 0.1
    machine = identified.parent / "arm.xml"
    machine.write_bytes(other.read_bytes())
    try:
        with pytest.raises(InputError, match=r"E170 another machine than was fitted"):
            restore_identification(identified)
    finally:
        machine.write_text(MODEL)
    assert (
        restore_identification(identified).project.system.states[0].name == "shoulder"
    )
    assert list(tmp_path.iterdir()) == [other]


def test_a_file_that_cannot_say_it_leaves_nothing_behind(
    identified: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    """Not the model's constants; or another model than was wanted, seen at the end."""
    other, out = tmp_path / "other.xml", tmp_path / "out" / "new.xml"
    out.parent.mkdir()
    given = ["apply", str(identified), "--model", str(other), "--out", str(out)]
    other.write_text(MODEL.replace('name="lower"', 'name="fore"'))
    assert main(given) == 2
    assert "E170" in capsys.readouterr().err
    other.write_text(MODEL)

    def heavier(paths: list[Path]) -> list:
        models = compiled_all(paths)
        models[0].body_mass[1] *= 1.0 if paths[0].parent != out.parent else 1.001
        return models

    monkeypatch.setattr(apply, "compiled_all", heavier)
    assert main(given) == 2
    assert "E170 body/upper/mass cannot be written" in capsys.readouterr().err
    assert not list(out.parent.iterdir())
