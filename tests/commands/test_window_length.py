"""The length of windows: until the misfit tests speak, and never lost."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.linalg import expm

from linear_system import Linear, linear
from sim2gp.commands import window_length
from sim2gp.commands.window_length import (
    WindowFit,
    choose_window,
    fit_all,
    keeps_samples,
    lengths,
    start_growth,
)
from sim2gp.data.cuts import Cuts
from sim2gp.data.logs import Log
from sim2gp.data.windows import Windows
from sim2gp.errors import NotConverged
from sim2gp.identification.fit import fit_windows
from sim2gp.inference.estimate import Estimate
from sim2gp.project import Project, load_project, training_windows
from sim2gp.project.project import SHORT
from sim2gp.project.training_windows import cut_for_fit
from sim2gp.systems import Channel

RATE, NOISE = 10.0, 0.02  # Hz, m
ROWS, KEY = 400, jax.random.key(0)
PROJECT = """system = "two_link"
[[logs]]
files = ["x.csv"]
columns = {q1 = "q", torque1 = 0.0, torque2 = 0.0}
[likelihood]
start_sd = 1.0
"""


def recording(
    drift: float = 0.0, rows: int = ROWS, rate: float = 0.0, seed: int = 7
) -> Log:
    """``x' = .7 a0 - .4 a1 + drift + rate x``, white noise; inputs are held.

    What grows is held back by the first input.
    """
    rng = np.random.default_rng(seed)
    a = np.repeat(rng.standard_normal((rows // 4 + 1, 2)), 4, axis=0)[:rows]
    x, grown = np.zeros(rows), np.exp(rate / RATE)
    for k in range(rows - 1):
        a[k, 0] -= 2.0 * rate / 0.7 * x[k]
        step = (grown - 1.0) / rate if rate else 1.0 / RATE
        x[k + 1] = grown * x[k] + (a[k] @ [0.7, -0.4] + drift) * step
    return Log(
        name="log",
        source="log.csv",
        time=np.arange(rows) / RATE,
        channels={"x0": x + NOISE * rng.standard_normal(rows)},
        inputs={"a0": a[:, 0], "a1": a[:, 1]},
        mask={"x0": np.ones(rows, bool)},
    )


def project_of(folder: Path, window: float | None = None, rate: float = 0.0) -> Project:
    """A linear machine, whose file states the length of windows or does not."""
    path = folder / "project.toml"
    stated = "" if window is None else f"window = {window}\n"
    path.write_text(PROJECT + stated)
    machine = dataclasses.replace(linear(2, 1), rate=rate)
    return dataclasses.replace(load_project(path), system=machine)


def short_fit(project: Project, log: Log) -> WindowFit:
    cut = cut_for_fit(project, [log], some=True)
    return WindowFit(project, cut, fit_windows(project.system, cut.windows, key=KEY))


def sd_of(fit: WindowFit) -> np.ndarray:
    with jax.enable_x64(True):
        return np.asarray(fit.fitted.posterior.sd())


def dense_sd(log: Log, window: float) -> np.ndarray:
    """Of the two constants by regression on them and on a start of each window."""
    moved = np.stack([log.inputs["a0"], log.inputs["a1"]], axis=1)[:-1] / RATE
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    which = (np.arange(len(moved)) / RATE / window + 1e-9).astype(int)
    X = np.concatenate([moved, np.eye(which.max() + 1)[which]], axis=1)
    precision = X.T @ X / NOISE**2 + np.diag([1.0, 1.0, *np.zeros(which.max() + 1)])
    return np.sqrt(np.diag(np.linalg.inv(precision))[:2])


def test_where_nothing_is_missing_they_are_as_long_as_they_may(tmp_path: Path) -> None:
    log = recording()
    short = short_fit(project_of(tmp_path), log)
    found = choose_window(short, [log], key=KEY)
    assert found.fit.project.window == 5.0
    assert not found.misfit.alarm
    entry = found.as_dict()
    assert (entry["seconds"], entry["chosen"]) == (5.0, True)
    sd = sd_of(found.fit)
    # The noise is estimated, so to some percent.
    np.testing.assert_allclose(sd, dense_sd(log, 5.0), rtol=0.1)
    assert np.max(sd / sd_of(short)) < 0.4
    # The fit is that of a project which states the length.
    stated = short_fit(project_of(tmp_path, 5.0), log)
    means = (x.fitted.posterior.mean for x in (found.fit, stated))
    np.testing.assert_allclose(*means, rtol=0.0, atol=1e-4 * sd.min())


def test_physics_too_slow_for_short_ones_shows_in_longer_ones(tmp_path: Path) -> None:
    log = recording(drift=0.01)
    short = short_fit(project_of(tmp_path), log)
    assert not short.misfit().alarm
    found = choose_window(short, [log], key=KEY)
    assert found.misfit.alarm
    assert "find something in these" in found.why
    # The first length that shows it, none beyond.
    for seconds in (x for x in (1.0, 5.0) if x < found.fit.project.window):
        assert not short_fit(project_of(tmp_path, seconds), log).misfit().alarm


def test_a_simulator_that_loses_its_recordings_is_not_taken(tmp_path: Path) -> None:
    log = recording(drift=0.03)
    found = choose_window(short_fit(project_of(tmp_path), log), [log], key=KEY)
    assert found.fit.project.window < 5.0
    assert "does not follow" in found.why
    sd = float(found.fit.fitted.noise.sd[0])
    longer = short_fit(project_of(tmp_path, 5.0), log)
    assert float(longer.fitted.noise.sd[0]) > 2.0 * sd


def test_where_the_tests_speak_a_stable_machine_has_windows_of_a_second(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log, fits = recording(drift=0.5), []
    short = short_fit(project_of(tmp_path), log)
    assert short.misfit().alarm

    def fit(*given: Any, **how: Any) -> Estimate:
        fits.append(given)
        return fit_windows(*given, **how)

    monkeypatch.setattr(window_length, "fit_windows", fit)
    found = choose_window(short, [log], key=KEY)
    assert len(fits) == 1  # none of 5 s
    assert found.fit.project.window == 1.0
    assert start_growth(found.fit) == pytest.approx(1.0, abs=1e-9)
    # Its noise has grown, which alone does not say that a simulator is lost.
    noise = (float(x.fitted.noise.sd[0]) for x in (found.fit, short))
    assert next(noise) > 2.0 * next(noise)
    assert found.as_dict()["chosen"]
    assert "find something" in found.why


def test_where_the_tests_speak_windows_of_an_unstable_machine_stay(
    tmp_path: Path,
) -> None:
    log, project = recording(drift=0.5, rate=2.0), project_of(tmp_path, rate=2.0)
    short = short_fit(project, log)
    assert short.misfit().alarm
    found = choose_window(short, [log], key=KEY)
    assert found.fit.fitted is short.fitted
    assert "for 1 s the simulator does not follow" in found.why
    second = short_fit(project.with_window(1.0), log)
    assert start_growth(second) == pytest.approx(np.exp(2.0 * 0.9), rel=1e-6)
    # So they do if it follows for so long.
    why = window_length._followed(short, [recording(rate=2.0)], 1.0, KEY, alarm=True)
    assert isinstance(why, str)
    assert f"grow {np.exp(1.8):.2g} times" in why


class Spring(Linear):
    """``q'' = k0 a0 + k1 a1 - 30^2 q``: its velocity is 30 times as large."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return Channel("q", "m"), Channel("q.velocity", "m/s")

    @property
    def actions(self) -> tuple[Channel, ...]:
        return Channel("a0", "m/s^2"), Channel("a1", "m/s^2")

    def ode(self, params: Array, s: Array, a: Array) -> Array:
        return jnp.stack([s[1], a @ params - 900.0 * s[0]])


@pytest.mark.parametrize("names", [("q", "q.velocity"), ("q",), ("q.velocity",)])
def test_errors_of_starts_have_the_units_of_the_motion(
    tmp_path: Path, names: tuple[str, ...]
) -> None:
    """A spring turns them: a norm in its own units says thirty times.

    Of one state that is measured the error is a cosine.
    """
    rng, log, period = np.random.default_rng(0), recording(), 0.01
    A = expm(period * np.asarray([[0.0, 1.0], [-900.0, 0.0]]))
    a = np.stack([log.inputs["a0"], log.inputs["a1"]], axis=1)
    push = (np.eye(2) - A) @ [1.0 / 900.0, 0.0]  # of a held acceleration
    x = np.zeros((ROWS, 2))
    x[0] = 1.0, 0.0
    for k in range(ROWS - 1):
        x[k + 1] = A @ x[k] + push * (a[k] @ [0.7, -0.4])
    x += [1e-3, 0.03] * rng.standard_normal(x.shape)
    both = {"q": x[:, 0], "q.velocity": x[:, 1]}
    log = dataclasses.replace(
        log,
        time=np.arange(ROWS) * period,
        channels={name: both[name] for name in names},
        mask={name: np.ones(ROWS, bool) for name in names},
    )
    machine = Spring(linear(2, 1).parameters, 2)
    fit = short_fit(dataclasses.replace(project_of(tmp_path), system=machine), log)
    assert start_growth(fit) == pytest.approx(1.0, abs=0.05)


def test_without_a_misfit_an_unstable_machine_may_have_long_windows(
    tmp_path: Path,
) -> None:
    log, project = recording(rate=2.0), project_of(tmp_path, rate=2.0)
    found = choose_window(short_fit(project, log), [log], key=KEY)
    assert found.fit.project.window >= 1.0


@pytest.mark.parametrize(("window", "said"), [(0.2, True), (20.0, False)])
def test_a_stated_length_stays(tmp_path: Path, window: float, said: bool) -> None:
    log = recording()
    short = short_fit(project_of(tmp_path, window), log)
    found = choose_window(short, [log], key=KEY)
    assert found.fit is short
    assert found.as_dict()["chosen"] is False
    assert bool(found.why) is said


def test_longer_windows_that_cannot_be_fitted_are_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recording()
    short = short_fit(project_of(tmp_path), log)

    def fails(*given: object, **how: object) -> None:
        raise NotConverged("E201", where="here", what="lost", got="", expected="")

    monkeypatch.setattr(window_length, "fit_windows", fails)
    found = choose_window(short, [log], key=KEY)
    assert found.fit.fitted is short.fitted
    assert "E201" in found.why


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> int:
    """Steps that are fitted all at once; of more, some choose. There are 20,000."""
    steps = 12_000
    monkeypatch.setattr(training_windows, "MANY", steps)
    monkeypatch.setattr(training_windows, "FEWEST", 2)
    return steps


def test_some_of_very_many_choose_and_all_are_fitted(
    tmp_path: Path, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recording()
    short = short_fit(project_of(tmp_path), log)
    assert len(short.cut.windows) * short.cut.windows.length <= few
    assert short.cut.total == ROWS // 2
    some = choose_window(short, [log], key=KEY)
    assert (len(some.fit.cut.windows), some.fit.cut.total) == (4, 8)
    found = fit_all(some, [log], key=KEY)
    assert isinstance(found.fit.cut.windows, Cuts)
    assert found.fit.cut.is_whole()
    assert found.why == some.why
    assert "a fit of 4 of 8" in found.why
    assert found.as_dict()["seconds"] == 5.0
    # As a project that states the length has them, all at once.
    with monkeypatch.context() as patch:
        patch.setattr(training_windows, "MANY", 10 * few)
        stated = short_fit(project_of(tmp_path, 5.0), log)
    assert isinstance(stated.cut.windows, Windows)
    means = (x.fitted.posterior.mean for x in (found.fit, stated))
    np.testing.assert_allclose(*means, rtol=0.0, atol=1e-4 * sd_of(stated).min())
    np.testing.assert_allclose(sd_of(found.fit), sd_of(stated), rtol=1e-4)


def test_all_are_short_if_some_recordings_lose_the_simulator(
    tmp_path: Path, few: int
) -> None:
    log = recording()
    some = choose_window(short_fit(project_of(tmp_path), log), [log], key=KEY)
    wild = dataclasses.replace(
        log, channels={"x0": log.channels["x0"] + 0.5 * log.time**2}
    )
    found = fit_all(some, [wild], key=KEY)
    assert found.as_dict()["seconds"] == SHORT
    assert found.fit.cut.is_whole()
    assert "does not follow" in found.why
    assert "chosen by" not in found.why


def test_longer_windows_must_have_most_samples(tmp_path: Path) -> None:
    """Of logs that are shorter than half of them nothing would be left."""
    project = project_of(tmp_path)
    logs = [recording(), *(recording(rows=20, seed=k) for k in range(20))]  # 2 s
    assert not keeps_samples(project.with_window(5.0), logs)
    assert keeps_samples(project.with_window(1.0), logs)
    cut = cut_for_fit(project, logs)
    fitted = fit_windows(project.system, cut.windows, key=KEY)
    found = choose_window(WindowFit(project, cut, fitted), logs, key=KEY)
    assert found.fit.project.window == 1.0
    assert "too short for those of 5 s" in found.why


def test_windows_that_take_many_steps_to_fit_are_not_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = recording()
    short = short_fit(project_of(tmp_path), log)
    monkeypatch.setattr(window_length, "SLOW", 2)
    found = choose_window(short, [log], key=KEY)
    assert found.fit.fitted is short.fitted
    assert "of 1 s takes" in found.why


def test_of_very_many_short_ones_all_are_fitted(
    tmp_path: Path, few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An unstable machine whose tests speak."""
    monkeypatch.setattr(training_windows, "MANY", few // 2)
    log, project = recording(drift=0.5, rate=2.0), project_of(tmp_path, rate=2.0)
    some = choose_window(short_fit(project, log), [log], key=KEY)
    found = fit_all(some, [log], key=KEY)
    assert len(some.fit.cut.windows) < some.fit.cut.total
    assert found.fit.cut.is_whole()
    assert found.fit.project.window == SHORT


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        (0.3, []),
        (1.0, [0.5]),
        (1.6, [0.8]),
        (3.0, [1.0, 1.5]),
        (10.0, [1.0, 5.0]),
        (12.0, [1.0, 4.0]),
        (60.0, [1.0, 5.0]),
    ],
)
def test_lengths_are_even_parts_of_the_longest_log(
    seconds: float, expected: list[float]
) -> None:
    logs = [recording(rows=round(x * RATE)) for x in (0.5 * seconds, seconds)]
    assert lengths(logs) == expected
