"""What is held out of a fit: by counting."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from sim2gp.commands import folds
from sim2gp.commands.folds import fit_fold, split_held_out
from sim2gp.data.grid import evaluation_windows
from sim2gp.data.logs import Log
from sim2gp.data.split_log import cut
from sim2gp.identification.forecasts.forecast import Band, Forecast
from sim2gp.identification.forecasts.prediction import (
    forecast_grid,
    forecast_traces,
    scored_rows,
    trace_arrays,
)
from sim2gp.project import load_project
from sim2gp.reports.motion import film
from sim2gp.systems import CartPole
from sim2gp.types import in_float64


def log(source: str, seconds: float, start: float = 0.0) -> Log:
    """A recording of a cart at 100 Hz; its clock may begin late."""
    t = start + 0.01 * np.arange(round(100 * seconds))
    channels = {"x": 0.1 * np.sin(t), "theta": np.cos(t)}
    every = {name: np.ones(len(t), bool) for name in channels}
    return Log(source.removesuffix(".csv"), source, t, channels, {"voltage": t}, every)


def parts(*logs: Log):
    """What `split_held_out` makes of them, with windows and grid."""
    windows, places = cut(logs, CartPole(), window=0.2)
    grid = evaluation_windows(logs, CartPole(), longest=1.0)
    return split_held_out(logs, windows, places, grid), places, grid


def test_the_last_recording_is_left_out_with_all_its_pieces() -> None:
    pieces = log("b.csv", 2.0), log("b.csv", 2.0, start=3.0)
    part, places, grid = parts(log("a.csv", 3.0), *pieces)
    assert part is not None
    of = np.asarray([k for k, _ in places])
    np.testing.assert_array_equal(part.train, of == 0)
    np.testing.assert_array_equal(part.known, grid.log == 0)
    np.testing.assert_array_equal(part.test, grid.log > 0)
    assert (part.recordings, part.words, part.until) == (1, "the log b", math.inf)
    np.testing.assert_array_equal(part.recording, of > 0)  # pieces are one recording


def test_the_end_of_the_only_recording_is_left_out() -> None:
    part, places, grid = parts(log("a.csv", 8.0, start=5.0))
    assert part is not None
    split = 5.0 + 0.75 * 7.99
    since = 5.0 + 0.01 * np.asarray([row for _, row in places])
    np.testing.assert_array_equal(part.train, since + 0.19 <= split)
    np.testing.assert_array_equal(part.test, grid.since >= split)
    assert not (part.known & part.test).any()
    assert grid.since[part.known].max() + 0.1 <= split
    assert part.until == pytest.approx(split)
    assert part.words == "the last 25 % of the log a"


def test_too_short_a_recording_holds_nothing_out() -> None:
    assert parts(log("a.csv", 0.45))[0] is None


def test_neither_fit_nor_band_sees_what_is_held_out(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Whatever `fit_windows` and `fit_band` are given ends before the split."""
    given: dict[str, Any] = {}
    logs = (log("a.csv", 8.0),)
    windows, places = cut(logs, CartPole(), window=0.2)
    grid = evaluation_windows(logs, CartPole(), longest=1.0)
    part = split_held_out(logs, windows, places, grid)
    assert part is not None

    def fitted(system: Any, kept: Any, **_: Any) -> Any:
        given["kept"] = kept
        return SimpleNamespace(posterior=None, with_measurements=lambda table: None)

    def machine(likelihood: Any, recording: Any, **_: Any) -> Any:
        given["chosen_on"] = likelihood.windows  # of forces
        given["recording"] = recording
        return SimpleNamespace(system=likelihood.system, posterior=None, scales={})

    def forecasts(system: Any, posterior: Any, grid: Any, horizon: float) -> Any:
        rows = scored_rows(horizon)
        valid = np.asarray(grid.windows.mask)[:, rows]
        none = np.zeros(valid.shape)
        slopes = [np.zeros((*valid.shape, k)) for k in (4, 1)]
        return Forecast(none, none, valid, *slopes, none, tuple(rows.tolist()))

    def band(found: Forecast, known: Any, recordings: int) -> Band:
        given["found"], given["known"], given["recordings"] = found, known, recordings
        one = np.ones(2)
        return Band(np.ones(4), np.ones(1), one, np.array([0.0]), one[None], 1.0)

    stubs = ("fit_windows", fitted), ("forecast_grid", forecasts)
    monkeypatch.setattr(folds, "at_zero", lambda likelihood, *_: likelihood)
    for name, stub in (*stubs, ("fit_forecast_machine", machine)):
        monkeypatch.setattr(folds, name, stub)
    monkeypatch.setattr(folds, "fit_band", band)
    path = tmp_path / "cart.toml"
    path.write_text('system = "cartpole"\n[[logs]]\nfiles = ["a.csv"]\n'
                    '[logs.columns]\nx = "x"\ntheta = "theta"\n'
                    'voltage = "u"\n')  # fmt: skip
    found = fit_fold(
        load_project(path), windows, grid, part, 0.5, key=jax.random.key(0), starts=2
    )
    np.testing.assert_array_equal(given["chosen_on"].mask, given["kept"].mask)
    assert not given["recording"].any()
    assert len(given["kept"]) == len(windows)  # masked, not removed
    seen = np.asarray(given["kept"].mask).any(axis=(1, 2))
    np.testing.assert_array_equal(seen, part.train)
    result, known = given["found"], given["known"]
    at = known.since[:, None] + 2e-3 * np.asarray(result.rows)
    used = result.valid.any(axis=2)
    assert at[used].max() <= part.until
    assert used[at <= part.until].all()  # and all of what comes before
    assert given["recordings"] == 1
    assert found.tested.since.min() >= part.until
    assert found.judged.valid.shape[0] == part.test.sum()


@in_float64
def test_windows_too_short_to_be_drawn_are_not() -> None:
    """A log of less than half a second has scores, and no picture."""
    short = (log("a.csv", 0.45),)
    grid = evaluation_windows(short, CartPole(), longest=1.0)
    assert len(grid.windows) > 0
    one = np.ones(2)
    band = Band(np.ones(4), np.ones(1), one, np.array([0.0]), one[None], 1.0)
    prior = CartPole().parameters.prior()
    found = forecast_grid(CartPole(), prior, grid, 0.1)
    picture = forecast_traces(found, band, grid)
    assert trace_arrays(picture, grid, short, ["x", "theta"]) == {}
    assert film(CartPole(), prior, picture, grid, short, "none") == ({}, {})
