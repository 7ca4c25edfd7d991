"""Groups of logs of one machine in several configurations, from file to report."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp.commands.apply import apply
from sim2gp.commands.design import setting as setting_of
from sim2gp.commands.evaluate import evaluate
from sim2gp.commands.explain import load_explainable
from sim2gp.commands.identification import restore_identification
from sim2gp.commands.identify import identify
from sim2gp.data.logs import Log
from sim2gp.errors import InputError
from sim2gp.experiment_design.verdict import DesignOptions
from sim2gp.identification.configurations import configuration_entries
from sim2gp.project import load_project
from sim2gp.runs import Progress, load_run
from sim2gp.systems import Furuta, Variant
from tests.catalogue.bad_project_files import BARE, LOADED, grouped

QUIET = Progress(quiet=True)

# What project files say.


def project_in(folder: Path, *groups: str, more: str = "") -> Path:
    path = folder / "machine.toml"
    path.write_text(grouped(*groups, more=more))
    return path


def test_groups_become_configurations(tmp_path: Path) -> None:
    more = '[parameters."motor_constant @ loaded"]\nmean = 0.04\nsd = 0.01\n'
    more += '[parameters."alpha.payload @ loaded"]\nlow = 0.0\nhigh = 0.01\n'
    loaded = LOADED.replace('["alpha', '["motor_constant", "alpha')
    again = BARE.replace("bare.csv", "other.csv")
    project = load_project(project_in(tmp_path, BARE, loaded, again, more=more))
    table = project.system.parameters
    assert project.system.variants == (
        Variant("bare", fixed=(("alpha.payload", 0.0),)),
        Variant("loaded", own=("motor_constant", "alpha.payload")),
    )
    assert table["motor_constant"].map != table["motor_constant @ loaded"].map == "log"
    assert table["alpha.payload @ loaded"].high == 0.01
    for name in ("bare", "loaded", "other"):
        rows = "".join(f"{0.01 * k},{k},{k**2},1\n" for k in range(30))
        (tmp_path / f"{name}.csv").write_text(f"time,theta,alpha,u\n{rows}")
    logs = project.load_logs()
    assert [(log.name, log.group) for log in logs] == [
        ("bare", 0),
        ("loaded", 1),
        ("other", 0),
    ]
    (held,) = project.read_logs([tmp_path / "other.csv"], "loaded")
    assert held.group == 1
    # A machine in one configuration is what it was, whatever its groups are called.
    plain = [group.split("fixed")[0].split("free")[0] for group in (BARE, LOADED)]
    project = load_project(project_in(tmp_path, *plain))
    assert project.system.variants == ()
    unnamed = LOADED.replace('name = "loaded"\n', "")
    project = load_project(project_in(tmp_path, BARE, unnamed))
    assert project.system.parameters.names[-1] == "alpha.payload @ 2"


def test_a_table_says_what_each_configuration_has(tmp_path: Path) -> None:
    system = load_project(project_in(tmp_path, BARE, LOADED)).system
    names = system.parameters.names
    entries = {name: {"mean": 0.0061, "sd": 2e-4} for name in names}
    t, none = np.arange(2.0), dict[str, Any]()
    logs = [
        Log("x", source, t, none, none, none, group=group)
        for source, group in (("a", 0), ("a", 0), ("b", 1), ("c", 1))
    ]
    found = configuration_entries(system, logs, entries)
    assert found["configurations"] == {
        "bare": {"recordings": 1, "fixed": {"alpha.payload": 0.0}, "own": []},
        "loaded": {"recordings": 2, "fixed": {}, "own": ["alpha.payload"]},
    }
    assert found["tables"][0]["columns"] == ["", "bare", "loaded"]
    assert found["tables"][0]["rows"] == [
        ["recordings", "1", "2"],
        ["alpha.payload", "0 (known)", "0.0061 kg +- 0.0002"],
    ]
    assert configuration_entries(Furuta(), logs, entries) == {}


# A model of MuJoCo's: an arm whose hand weighs 0.1 kg, or some more.

ARM = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody><body name="arm">
    <joint name="shoulder" axis="0 1 0" damping="{damping}"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" mass="{arm}"/>
    <body name="hand" pos="0 0 -.3"><geom size=".03" mass="{hand}"/></body>
  </body></worldbody>
  <actuator><motor name="push" joint="shoulder" ctrlrange="-2 2"/></actuator>
</mujoco>
"""
TRUTH = {"damping": 0.05, "arm": 0.5, "hand": 0.4}
PROJECT = """
system = "arm.xml"
[parameters."joint/shoulder/damping"]
[parameters."body/arm/mass"]
[parameters."body/hand/mass"]
low = 0.05
high = 1.0
[[logs]]
name = "bare"
files = ["bare.csv"]
fixed = {"body/hand/mass" = 0.1}
[logs.columns]
shoulder = "q"
push = "u"
[[logs]]
name = "loaded"
files = ["loaded.csv"]
free = ["body/hand/mass"]
[logs.columns]
shoulder = "q"
push = "u"
"""


def record(path: Path, seed: int, **changes: float) -> None:
    """A second and a half of the arm, its encoder a milliradian off at each row."""
    mujoco = pytest.importorskip("mujoco", reason="the extra is not installed")
    model = mujoco.MjModel.from_xml_string(ARM.format(**TRUTH | changes))
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    rows = []
    for k, u in enumerate(np.repeat(rng.uniform(-1.5, 1.5, 15), 10)):
        rows.append([0.01 * k, data.qpos[0] + 1e-3 * rng.standard_normal(), u])
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    np.savetxt(path, rows, "%.9g", ",", header="time,q,u", comments="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("groups")
    record(folder / "bare.csv", seed=1, hand=0.1)
    record(folder / "loaded.csv", seed=2)
    record(folder / "held.csv", seed=3)
    (folder / "arm.xml").write_text(ARM.format(damping=0.1, arm=0.7, hand=0.1))
    (folder / "arm.toml").write_text(PROJECT)
    return folder


def identified(path: Path, out: Path, *, held_out: bool = True) -> None:
    found = identify(load_project(path), progress=QUIET, held_out=held_out)
    found.save(out)


@pytest.fixture(scope="module")
def run(folder: Path) -> Path:
    identified(folder / "arm.toml", folder / "run", held_out=False)
    return folder / "run"


NAMES = ("joint/shoulder/damping", "body/arm/mass", "body/hand/mass @ loaded")


def test_a_joint_fit_names_each_column(run: Path) -> None:
    summary = load_run(run).summary
    found = summary["parameters"]
    assert (*found,) == NAMES
    for name, truth in zip(NAMES, TRUTH.values(), strict=True):
        assert abs(found[name]["mean"] - truth) < 4.0 * found[name]["sd"], name
        assert found[name]["sd"] < 0.05 * truth
    assert found[NAMES[2]]["unit"] == "kg"
    assert summary["configurations"] == {
        "bare": {"recordings": 1, "fixed": {"body/hand/mass": 0.1}, "own": []},
        "loaded": {"recordings": 1, "fixed": {}, "own": ["body/hand/mass"]},
    }
    (table,) = summary["tables"]
    assert table["columns"] == ["", "bare", "loaded"]
    (name, bare, loaded) = table["rows"][1]
    assert (name, bare) == ("body/hand/mass", "0.1 (known)")
    assert loaded.startswith("0.")
    assert " kg +- " in loaded
    assert not summary["misfit"]["alarm"]
    page = (run / "report.html").read_text()
    assert "configurations</" in page
    assert "body/hand/mass @ loaded" in page
    assert summary["animation"]["title"].endswith("; the machine bare")
    marks = [mark["text"] for mark in summary["animation"]["marks"]]
    assert marks
    assert all(text.startswith("bare, ") for text in marks)  # one machine, not two


@pytest.mark.nightly
def test_held_out_logs_are_of_one_configuration(
    run: Path, folder: Path, tmp_path: Path
) -> None:
    def error(name: str | None) -> dict[str, Any]:
        fit = restore_identification(run)
        logs = fit.read_logs([folder / "held.csv"], name)
        return evaluate(fit, logs, progress=QUIET).summary

    right, wrong = error("loaded"), error("bare")
    assert (
        right["open_loop_rmse"]["shoulder"] < 0.5 * wrong["open_loop_rmse"]["shoulder"]
    )
    json.dumps(right, allow_nan=False)
    with pytest.raises(InputError, match=r"E152 which configuration.*bare, loaded"):
        error(None)
    with pytest.raises(InputError, match="E152 unknown configuration: got laoded"):
        error("laoded")


@pytest.mark.nightly
def test_an_experiment_is_for_the_machine_as_it_stands(run: Path) -> None:
    def setting(name: str | None) -> Any:
        asked = DesignOptions(seconds=1.0, configuration=name)
        return setting_of(restore_identification(run), asked)[1]

    x = load_run(run).arrays
    bare, loaded = setting("bare"), setting("loaded")
    assert bare.system.parameters.names == NAMES[:2]
    assert dict(bare.system.parameters.fixed) == {"body/hand/mass": 0.1}
    assert loaded.system.parameters.names == (*NAMES[:2], "body/hand/mass")
    np.testing.assert_allclose(loaded.belief.mean, x["belief/mean"])
    whole = x["belief/scale"] @ x["belief/scale"].T
    for found, p in ((loaded, 3), (bare, 2)):
        scale = np.asarray(found.belief.scale)
        np.testing.assert_allclose(scale @ scale.T, whole[:p, :p], rtol=1e-9)
    with pytest.raises(InputError, match="E152"):
        setting(None)


@pytest.mark.nightly
def test_a_models_file_gets_the_constants_of_one(run: Path, tmp_path: Path) -> None:
    def applied(name: str | None) -> Any:
        found = apply(restore_identification(run), progress=QUIET, configuration=name)
        return found.save_model(tmp_path / f"{name}.xml").constants

    found = load_run(run).summary["parameters"]
    hand = applied("loaded")["body/hand/mass"]["is"]
    assert hand == pytest.approx(found[NAMES[2]]["mean"], rel=0.01)
    assert applied("bare").get("body/hand/mass", {"is": 0.1})["is"] == 0.1
    with pytest.raises(InputError, match="E152"):
        applied(None)


@pytest.mark.nightly
def test_commands_for_one_configuration_say_so(run: Path, folder: Path) -> None:
    path = folder / "arm.toml"
    one = "E160 several configurations, which explain and compare do not take"
    with pytest.raises(InputError, match=one):
        load_project(path).load_logs(alike=True)
    with pytest.raises(InputError, match=one):
        load_explainable(run)


@pytest.mark.nightly
def test_a_weighed_sum_is_known_before_the_logs(
    run: Path, folder: Path, tmp_path: Path
) -> None:
    path = folder / "weighed.toml"
    both = ("body/arm/mass", "body/hand/mass @ loaded")
    known = f"[[weighed]]\nof = {json.dumps(both)}\nvalue = 0.9\nsd = 0.001\n"
    path.write_text(PROJECT.replace("[[logs]]", f"{known}[[logs]]", 1))
    identified(path, tmp_path / "run")
    plain, answer = (load_run(x).summary for x in (run, tmp_path / "run"))
    for name in both:
        now, before = answer["parameters"][name], plain["parameters"][name]
        assert abs(now["mean"] - before["mean"]) < 3.0 * before["sd"]
        assert now["plain"]["sd"] < before["plain"]["sd"]
        assert now["prior_sd"] < 0.95 * before["prior_sd"]
    total = sum(answer["parameters"][name]["mean"] for name in both)
    assert total == pytest.approx(0.9, abs=0.003)
    damping = NAMES[0]
    prior = [x["parameters"][damping]["prior_sd"] for x in (plain, answer)]
    assert prior[0] == pytest.approx(prior[1])
    assert not answer["misfit"]["alarm"]
