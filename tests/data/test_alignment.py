"""Commands some rows away from the motion (W118): found where sure, never imagined."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from recordings import Channel
from sim2gp.data.logs import Log
from sim2gp.data.logs.alignment import alignment_notes
from sim2gp.project import load_project

ROOT = Path(__file__).resolve().parents[2]
JOINT = (Channel("q", "rad", angle=True), Channel("q.velocity", "rad/s"))
DT = 0.01


def log_of(
    u: np.ndarray, gain: tuple[float, float] | None = None, noise: float = 0.0
) -> Log:
    """A pendulum with dry friction under held commands, or under a controller."""
    rng = np.random.default_rng(1)
    q, v, last = 0.0, 0.0, 0.0
    seen, given = [], []
    for command in u:
        at = q + noise * rng.standard_normal()
        if gain is not None:
            command = -gain[0] * at - gain[1] * (at - last) / DT + command
        last = at
        seen.append(at)
        given.append(command)
        for _ in range(10):
            friction = 0.1 * v + 0.3 * np.tanh(50 * v)
            v += 0.1 * DT * (command - 9.81 * np.sin(q) - friction)
            q += 0.1 * DT * v
        v += 0.01 * rng.standard_normal() * (gain is not None)
    t = DT * np.arange(len(u))
    channels = {"q": np.asarray(seen)}
    mask = {"q": np.ones(len(u), bool)}
    return Log("a", "a.csv", t, channels, {"u": np.asarray(given)}, mask)


def shifted(log: Log, rows: int) -> Log:
    """Commands logged so many rows late."""
    return replace(log, inputs={n: np.roll(u, rows) for n, u in log.inputs.items()})


@pytest.fixture(scope="module")
def swing() -> Log:
    rng = np.random.default_rng(0)
    return log_of(np.repeat(rng.uniform(-4.0, 4.0, 400), 3), noise=1e-4)


@pytest.mark.parametrize("rows", [-7, -3, -2, -1, 3, 4, 9])
def test_the_shift_is_found(swing: Log, rows: int) -> None:
    (note,) = alignment_notes(shifted(swing, rows), JOINT)
    side = "behind" if rows > 0 else "ahead of"
    word = "row " if abs(rows) == 1 else "rows "
    assert note.code == "W118"
    assert f"u in a.csv: {abs(rows)} {word}{side} the motion" in note.text
    assert f"({10 * abs(rows)} ms)" in note.text
    assert ("delay" in note.text) == (rows < 0)


def test_what_is_in_place_is_not_called_so(swing: Log) -> None:
    assert alignment_notes(swing, JOINT) == []
    for rows in (-3, 3):
        units = shifted(swing, rows)
        (note,) = alignment_notes(units, JOINT)
        scaled = replace(
            units, inputs={"u": 1e3 * units.inputs["u"]}, time=units.time + 1e6
        )
        assert alignment_notes(scaled, JOINT)[0].text == note.text


def test_a_delay_that_the_model_has_is_its_own(swing: Log) -> None:
    late = shifted(swing, -3)
    assert alignment_notes(late, JOINT, 0.03) == []
    assert alignment_notes(late, JOINT, 0.01) != []
    assert alignment_notes(shifted(swing, 4), JOINT, 0.1) != []


@pytest.mark.parametrize("noise", [0.0, 1e-4, 1e-2])
def test_a_controller_is_no_misalignment(noise: float) -> None:
    """Its commands know the noise of the rows before them: a share, but no shift."""
    steps = np.sign(np.sin(0.03 * np.arange(1000)))
    for target in (0.0 * steps, steps, np.sin(0.02 * np.arange(1000))):
        log = log_of(30.0 * target, gain=(30.0, 4.0), noise=noise)
        assert alignment_notes(log, JOINT) == []


def test_nothing_is_said_of_what_tells_nothing(swing: Log) -> None:
    t = DT * np.arange(600)
    slow = log_of(4.0 * np.sin(0.5 * t))
    assert alignment_notes(shifted(slow, 3), JOINT) == []
    still = replace(swing, inputs={"u": 0.0 * swing.inputs["u"]})
    assert alignment_notes(still, JOINT) == []
    resting = replace(swing, channels={"q": 0.0 * swing.channels["q"]})
    assert alignment_notes(resting, JOINT) == []
    rates = replace(swing, channels={"q.velocity": swing.channels["q"]})
    assert alignment_notes(rates, JOINT) == []
    short = replace(
        swing,
        time=swing.time[:40],
        channels={"q": swing.channels["q"][:40]},
        inputs={"u": swing.inputs["u"][:40]},
        mask={"q": swing.mask["q"][:40]},
    )
    assert alignment_notes(short, JOINT) == []


def test_recordings_of_real_machines(shared_data: Path, tmp_path: Path) -> None:
    """As they stand nothing is said; where commands are moved, by how much."""
    for name, every, one in (
        ("double_pendulum", "excitation/*.csv", "excitation/c1_1435*.csv"),
        ("qube", "qube_*.csv", "qube_*317_*.csv"),
    ):
        text = (ROOT / "examples" / f"{name}.toml").read_text().replace(every, one)
        text = text.replace("../../shared/data", shared_data.as_posix())
        (tmp_path / "one.toml").write_text(text)
        project = load_project(tmp_path / "one.toml")
        (log,) = project.load_logs()
        assert "W118" not in [note.code for note in log.notes]
        states = project.system.physical_states
        assert alignment_notes(log, states) == []
    for rows, words in ((-5, "5 rows ahead of"), (12, "12 rows behind")):
        (note,) = alignment_notes(shifted(log, rows), states)
        assert words in note.text
