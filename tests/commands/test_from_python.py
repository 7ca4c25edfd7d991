"""Commands as functions: typed results, with the same figures as the terminal's."""

import json
import os
import runpy
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import sim2gp as sg
from sim2gp.cli import main
from sim2gp.errors import InputError

pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "from_python.py"
QUIET = sg.Progress(quiet=True)
#: What depends on where, when and how a run was made.
_OF_THE_RUN = (
    "command_line",
    "wall_seconds",
    "seconds_of_cells",
    "project",
    "title",
    "versions",
    "device",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The notebook's machine and logs, nothing run yet."""
    place, before = tmp_path_factory.mktemp("python"), Path.cwd()
    os.chdir(place)
    cells = NOTEBOOK.read_text(encoding="utf-8").split("# %%")
    (place / "machine.py").write_text("# %%".join(cells[:3]))
    yield place
    os.chdir(before)


@pytest.fixture(scope="module")
def machine(folder: Path) -> dict[str, Any]:
    return runpy.run_path(str(folder / "machine.py"))


@pytest.fixture(scope="module")
def found(machine: dict[str, Any]) -> Any:
    robot = sg.load_project("pendulum.toml")
    return sg.identify(robot, held_out=False, progress=QUIET)


def figures(summary: Mapping[str, Any]) -> dict[str, Any]:
    kept = {k: v for k, v in summary.items() if k not in _OF_THE_RUN}
    return json.loads(json.dumps(kept))


def answer(words: str) -> dict[str, Any]:
    """A command's summary, as its run has it."""
    assert main([*words.split(), "--quiet", "--out", "answer"]) == 0
    return json.loads(Path("answer", "summary.json").read_text())


def test_identify_is_that_of_the_terminal(found: Any) -> None:
    assert figures(answer("identify pendulum.toml --quick")) == figures(found.to_dict())
    damping = found.parameters["joint/hinge/damping"]
    low, high = damping.interval
    assert low < 0.02 < high
    assert damping.unit == "N m s/rad"
    assert damping.verdict == "identified"
    assert "joint/hinge/damping" in found._repr_html_()
    assert "identified" in repr(found)


def test_a_saved_run_is_the_same_object(found: Any, tmp_path: Path) -> None:
    again = sg.load_run(found.save(tmp_path / "run"))
    assert type(again) is type(found)
    assert figures(again.to_dict()) == figures(found.to_dict())
    assert again.to_dict()["project"]["file"] == "pendulum.toml"
    assert again.parameters == found.parameters
    for which in ("posterior", "plain"):
        for x, y in zip(
            *(
                (getattr(f, which).mean, getattr(f, which).scale)
                for f in (again, found)
            ),
            strict=True,
        ):
            np.testing.assert_array_equal(x, y)
    new = sg.read_logs("c.csv", again.project)
    one, two = (f.forecast(new).rmse for f in (found, again))
    assert one == two
    assert one["hinge"] < 0.1 * found.forecast(new).hold_rmse["hinge"]
    kept = sg.load_run(found.forecast(new).save(tmp_path / "held"))
    assert kept.rmse == one


@pytest.mark.nightly  # 9 s
def test_arrays_are_logs(found: Any, machine: dict[str, Any]) -> None:
    """Of the numbers that the files hold, to the last bit."""
    logs = [sg.Log.of(machine["recorded"](k), name=n) for k, n in enumerate("ab")]
    robot = sg.load_project("pendulum.toml")
    own = sg.identify(robot, logs, held_out=False, progress=QUIET)
    assert own.parameters == found.parameters
    columns = machine["recorded"](0)
    with pytest.raises(InputError, match=r"E103 missing column motor"):
        sg.identify(
            found.project, sg.Log.of(time=columns["time"], hinge=columns["hinge"])
        )
    with pytest.raises(InputError, match=r"E160 no logs"):
        sg.identify(found.project, [])


@pytest.mark.nightly  # 22 s
def test_a_machine_without_a_project_file(
    found: Any, machine: dict[str, Any], tmp_path: Path
) -> None:
    """The same machine and likelihood, from Python alone, and read back."""
    robot = found.project.system
    logs = [sg.Log.of(machine["recorded"](k), name=n) for k, n in enumerate("ab")]
    own = sg.identify(robot, logs, held_out=False, progress=QUIET)
    assert own.parameters == found.parameters
    run = own.save(tmp_path / "own")
    with pytest.raises(InputError, match=r"E160 unknown system.*machine="):
        sg.load_run(run)
    assert sg.load_run(run, robot).parameters == own.parameters
    stated = own.summary["window"]["seconds"] / 2.0
    short = sg.project_of_machine(robot, likelihood={"window": stated})
    many = sg.identify(short, logs, held_out=False, progress=QUIET)
    assert many.summary["n_windows"] == 2 * own.summary["n_windows"]
    with pytest.raises(InputError, match=r"likelihood.windw"):
        sg.project_of_machine(robot, likelihood={"windw": 0.1})


@pytest.mark.parametrize(
    "number", [np.float32(0.5), np.int64(2), jnp.asarray(0.5), np.array(0.25)]
)
def test_numbers_of_arrays_are_numbers(found: Any, number: Any) -> None:
    robot = found.project.system
    made = sg.project_of_machine(
        robot, likelihood={"window": number}, limits={"hinge": (-number, number)}
    )
    assert made.spec.likelihood.window == float(number)
    assert made.spec.limits == {"hinge": [-float(number), float(number)]}
    with pytest.raises(InputError, match="E160 wrong value in machine"):
        sg.project_of_machine(robot, likelihood={"window": object()})


def test_logs_are_read_by_the_name_of_their_group(found: Any) -> None:
    """Of a machine in one configuration the name chooses the columns."""
    text = Path("pendulum.toml").read_text()
    text = text.replace('files = ["a.csv"', 'name = "bench"\nfiles = ["a.csv"')
    Path("named.toml").write_text(text)
    robot = sg.load_project("named.toml")
    (log,) = sg.read_logs("c.csv", robot, "bench")
    assert log.name == "c"
    with pytest.raises(InputError, match=r"E152.*bench"):
        sg.read_logs("c.csv", robot, "bank")


def test_only_an_unchanged_project_goes_to_other_processes(found: Any) -> None:
    text = Path("pendulum.toml").read_text()
    for name, content in (
        ("crlf", text.replace("\n", "\r\n").encode()),
        ("bom", b"\xef\xbb\xbf" + text.encode()),
    ):
        file = Path(f"{name}.toml")
        file.write_bytes(content)
        assert sg.load_project(file).can_be_loaded
    Path("other.xml").write_text(Path("pendulum.xml").read_text())
    assert not sg.load_project("pendulum.toml", model=Path("other.xml")).can_be_loaded
    project = sg.load_project(file)
    file.write_bytes(b"\xff\xfe")
    assert not project.can_be_loaded
    file.unlink()
    assert not project.can_be_loaded


def test_apply_shows_and_writes(found: Any, tmp_path: Path) -> None:
    applied = sg.apply(found, progress=QUIET)
    (name,) = applied.constants
    assert f'damping="{applied.constants[name]["is"]!r}"' in applied.diff
    before = Path("pendulum.xml").read_text()
    saved = applied.save_model(tmp_path / "new.xml")
    assert Path("pendulum.xml").read_text() == before
    assert saved.summary["written"] == [str(tmp_path / "new.xml")]


def test_limits_from_python() -> None:
    asked = sg.Limits({"q.velocity": (-1.0, 2.0)}, torque=2.0, rates={"torque": 9.0})
    assert asked.boxes == {"q.velocity": (-1.0, 2.0), "torque": (-2.0, 2.0)}
    assert asked.rates == {"torque": 9.0}
    with pytest.raises(InputError, match="E141 limits of q"):
        sg.Limits(q=(2.0, 1.0))


def test_functions_and_folders_have_names_of_their_own() -> None:
    """A function stays one after it was called, and after its module is loaded."""
    for _ in range(2):
        for name in ("identify", "evaluate", "explain", "compare", "design", "apply"):
            assert callable(getattr(sg, name))
            __import__(f"sim2gp.commands.{name}")


@pytest.mark.nightly
def test_the_notebook_says_what_the_terminal_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(NOTEBOOK))
    for words, name in (
        ("identify pendulum.toml", "found"),
        ("evaluate runs/pendulum --logs c.csv", "unseen"),
        ("evaluate pendulum.toml", "folds"),
        ("explain runs/pendulum", "missing"),
        ("compare pendulum.toml --horizon 0.2", "comparison"),
        ("design runs/pendulum --limit motor=-1:1 --seconds 2", "experiment"),
        ("demo --episodes 1", "demonstration"),
        ("reproduce fig1 --quick", "figure"),
    ):
        assert figures(answer(words)) == figures(names[name].to_dict()), words
    assert main("export runs/pendulum --draws 4 --quiet --out answer".split()) == 0
    stored = json.loads(Path("answer", "summary.json").read_text())
    draws = json.loads(json.dumps(names["draws"]))
    del draws["headline"]  # it says where the notebook has put them
    assert stored == draws
    assert Path("next.csv").read_text() == names["experiment"].files["trajectory.csv"]
