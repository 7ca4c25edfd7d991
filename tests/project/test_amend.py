"""A project file gets the missing effect, whole or not at all."""

import os
from pathlib import Path

import pytest

from sim2gp import systems as sy
from sim2gp.errors import InputError
from sim2gp.project import load_project
from sim2gp.project.amend import amend, amend_text
from sim2gp.systems import Candidate

TEXT = """# my machine
system = "cartpole"

[parameters]
cart_mass = {mean = 0.4, sd = 0.05}  # weighed

[[logs]]
files = ["a.csv"]
[logs.columns]
x = "x"
theta = "theta"
voltage = "u"
"""
SPRING = Candidate(sy.Spring("x", 8.0))
DELAY = Candidate(sy.Delay("voltage", 0.04))


@pytest.fixture
def project(tmp_path: Path) -> Path:
    path = tmp_path / "cart.toml"
    path.write_text(TEXT)
    return path


def test_an_effect_becomes_a_free_constant(project: Path) -> None:
    os.chmod(project, 0o640)
    amend(project, SPRING, "found on a Monday")
    text = project.read_text()
    assert text.startswith(TEXT)
    assert text.endswith(
        "\n[effects.x.spring]\n# found on a Monday\nmean = 0.0\nsd = 8.0\n"
    )
    table = load_project(project).system.parameters
    assert table.names[-1] == "x.spring"
    assert (table["x.spring"].map, table["x.spring"].sd) == ("identity", 8.0)
    assert [p.name for p in project.parent.iterdir()] == ["cart.toml"]
    assert project.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("candidate", sy.candidates(sy.CartPole(), windows=True))
def test_every_candidate_can_be_added(project: Path, candidate: Candidate) -> None:
    amend(project, candidate)
    added = load_project(project).system
    assert candidate.name in added.parameters.names
    if not isinstance(candidate.effect, sy.Delay):
        assert isinstance(added, sy.Machine)
        (effect,) = (*added.effects, *added.sensors)
        options = ("width", "smoothing", "speed")
        for name in options:
            wanted = getattr(candidate.effect, name, None)
            assert getattr(effect, name, None) == wanted


def test_a_delay_goes_under_the_header_that_is_there(project: Path) -> None:
    project.write_text(TEXT + '\n[actuators.voltage] # amplifier\ngain = "free"\n')
    amend(project, DELAY)
    assert (
        '[actuators.voltage] # amplifier\ngain = "free"\ndelay = {low = 0.0, high'
        in project.read_text()
    )
    names = load_project(project).system.parameters.names
    assert {"voltage.gain", "voltage.delay"} <= {*names}


def test_what_is_stated_is_not_overwritten(project: Path) -> None:
    stated = TEXT + "\n[actuators.voltage]\ndelay = 0.01\n"
    with pytest.raises(
        InputError,
        match=r"E160.*stated already.*actuators.voltage.delay.*got 0.01.*by hand",
    ):
        amend_text(stated, DELAY)
    project.write_text(stated)
    with pytest.raises(InputError, match=r"E160.*stated already"):
        amend(project, DELAY)
    assert project.read_text() == stated
    with pytest.raises(InputError, match=r"E160.*lag.*delay"):
        amend_text(TEXT, Candidate(sy.Lag("voltage", 0.04)))


def test_an_inline_table_is_edited_in_place(project: Path) -> None:
    project.write_text(
        TEXT.replace("\n[parameters]", "effects = {x = {drag = 1.0}}\n[parameters]")
    )
    amend(project, SPRING)
    assert "effects = {x = {drag = 1.0, spring = {mean = 0.0, sd = 8.0}}}\n" in (
        project.read_text()
    )
    assert load_project(project).system.parameters.names[-1] == "x.spring"


def test_a_table_goes_next_to_its_likes(project: Path) -> None:
    drag = "[effects.theta.drag]  # of the hinge\nvalue = 0.1\n\n"
    drag += "[likelihood]\nwindow = 1\n"
    project.write_text(f"{TEXT}\n{drag}")
    amend(project, SPRING)
    rest = drag.replace(
        "\n[l", "\n[effects.x.spring]\n# added by sim2gp\nmean = 0.0\nsd = 8.0\n[l"
    )
    assert project.read_text().split() == f"{TEXT}\n{rest}".split()


def test_a_file_that_became_no_project_stays_as_it_was(
    project: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "sim2gp.project.amend.amend_text", lambda *given: TEXT + "[effects.x.sprng]\n"
    )
    with pytest.raises(
        InputError, match=r"E160.*cannot be added.*\[effects\.x\.spring\]"
    ):
        amend(project, SPRING)
    assert project.read_text() == TEXT
    assert [p.name for p in project.parent.iterdir()] == ["cart.toml"]
