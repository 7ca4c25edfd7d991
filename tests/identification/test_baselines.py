"""Forecasts next to those of two predictors without mechanics, in numbers and words."""

import math

import numpy as np
import pytest

from sim2gp.data.grid import evaluation_windows
from sim2gp.data.logs import Log
from sim2gp.identification.forecasts.baselines import (
    compare_baselines,
    forecast_sentence,
    loss_sentence,
    regression_errors,
)
from sim2gp.identification.forecasts.prediction import ScoredForecasts, forecast_scores
from sim2gp.systems import CartPole

UNITS = {"q1": "rad", "q2": "rad"}


def swinging(seconds: float, phase: float) -> Log:
    """Two harmonics of one frequency: the next state is linear in this one."""
    t = 0.01 * np.arange(round(100 * seconds))
    channels = {"x": 0.1 * np.sin(3.0 * t + phase), "theta": np.cos(3.0 * t + phase)}
    inputs = {"voltage": np.sin(5.0 * t + phase)}
    every = {name: np.ones(len(t), bool) for name in channels}
    return Log(f"log{phase}", f"log{phase}.csv", t, channels, inputs, every)


def test_the_regression_is_exact_where_the_motion_is_linear() -> None:
    """At every row with more windows than unknowns; NaN at the others."""
    train, test = (
        evaluation_windows([swinging(s, p)], CartPole(), longest=0.6)
        for s, p in ((20.0, 0.0), (4.0, 1.0))
    )
    rows = np.asarray([1, 50, 150, 250])
    found = regression_errors(train, test, rows)
    assert found.shape == (len(test.windows), 4, 2)
    moved = np.asarray(test.windows.y)[:, 50] - np.asarray(test.windows.y)[:, 0]
    assert np.sqrt(np.mean(moved**2)) > 0.1
    valid = np.asarray(test.windows.mask)[:, rows[:3]]
    assert np.abs(np.where(valid, found[:, :3], 0.0)).max() < 1e-6
    assert np.isnan(found[:, 3]).all()  # 254 unknowns, fewer windows
    assert len(train.windows) <= 254


def judged(
    errors: dict[str, tuple[float, float]], regression: float
) -> ScoredForecasts:
    """Two logs with five windows each, after a step, .1 and .5 s.

    ``errors`` are the model's and that of holding still, by channel.
    """
    shape = (10, 3, len(errors))
    error, hold = (
        np.broadcast_to(np.asarray([pair[k] for pair in errors.values()]), shape).copy()
        for k in (0, 1)
    )
    valid = np.ones(shape, bool)
    log = np.repeat([0, 1], 5)
    return ScoredForecasts(
        np.array([1, 50, 250]), valid, error, np.ones(shape), np.zeros(shape), hold,
        np.full(shape, regression), log, valid, valid,
    )  # fmt: skip


def said(found: ScoredForecasts) -> str:
    logs = [swinging(1.0, 0.0), swinging(1.0, 1.0)]
    summary, _ = forecast_scores(found, ["q1", "q2"], logs, 0.5)
    error, against = summary["open_loop_rmse"], summary["trivial"]
    return forecast_sentence("Error", error, against, UNITS)


def test_a_forecast_worse_than_none_is_not_praised() -> None:
    """A second joint that hardly moves, as on a real arm: 5.7 times standing still."""
    errors = {"q1": (0.04, 0.29), "q2": (0.0272, 0.0048)}
    assert said(judged(errors, 0.5)) == (
        "Error: q1 0.04 rad, 0.14 times the error of holding still; q2 0.0272 rad, "
        "5.7 times the error of holding still. The model predicts q2 worse than "
        "holding still does."
    )
    # The better of the two counts: a regression that knows the inputs wins here.
    assert said(judged(errors, 0.01)) == (
        "Error: q1 0.04 rad, 4 times the error of a linear regression; q2 0.0272 rad, "
        "5.7 times the error of holding still. The model predicts q1 worse than a "
        "linear regression does. The model predicts q2 worse than holding still does."
    )
    same = {"q1": (0.114, 0.116), "q2": (0.114, 0.116)}
    assert said(judged(same, math.nan)).endswith(
        "The model predicts q1 and q2 no better than holding still does."
    )


def test_both_predictors_are_in_both_tables() -> None:
    errors = {"q1": (0.04, 0.29), "q2": (0.0272, 0.0048)}
    found = judged(errors, 0.5)
    found.regression[:, 1] = 0.25  # at 0.1 s
    logs = [swinging(1.0, 0.0), swinging(1.0, 1.0)]
    summary, _ = forecast_scores(found, ["q1", "q2"], logs, 0.5)
    by_horizon, by_log = summary["tables"]
    for table, rows in ((by_horizon, ("0.25", "0.5")), (by_log, ("0.5",) * 3)):
        for name, (_, hold) in errors.items():
            held = table["columns"].index(f"{name}, held")
            other = table["columns"].index(f"{name}, regression")
            assert [row[held] for row in table["rows"]] == [f"{hold:.4f}"] * len(rows)
            for row, value in zip(table["rows"], rows, strict=True):
                assert float(row[other]) == float(value)
    assert summary["losses"] is None  # q2 loses over all, and the sentence says so
    found.error[:5, :, 1] = 1e-4
    found.hold[:5, :, 1] = 0.1
    summary, _ = forecast_scores(found, ["q1", "q2"], logs, 0.5)
    assert summary["losses"] == (
        "Logs in which holding still or a linear regression predicts better: q2 in 1 "
        "of 2 (log1.0)."
    )
    unknown = judged(errors, math.nan)
    summary, _ = forecast_scores(unknown, ["q1", "q2"], logs, 0.5)
    assert "regression_rmse" not in summary
    assert "-" in summary["tables"][0]["rows"][0]
    assert summary["trivial"]["q1"]["better"] == "holding still"


def test_what_cannot_be_compared_is_left_out() -> None:
    nan = math.nan
    found = compare_baselines(
        ["a", "b", "c", "d"],
        np.asarray([nan, 0.2, 0.3, 0.4]),
        np.asarray([0.1, nan, 0.0, 0.8]),
        np.asarray([0.1, nan, 1.0, 0.5]),
    )
    assert list(found) == ["c", "d"]
    assert found["c"]["ratio"] is None
    assert found["d"]["better"] == "a linear regression"
    assert found["d"]["ratio"] == pytest.approx(0.8)
    text = forecast_sentence("E", {"c": 0.3, "d": 0.4}, found, {}, {"c": 0.5, "d": 1})
    assert text == (
        "E: c 0.3, where holding still makes no error (50 % inside the 90 % band); d "
        "0.4, 0.8 times the error of a linear regression (100 % inside the 90 % band). "
        "The model predicts c worse than holding still does."
    )


def test_logs_that_a_model_loses_are_named() -> None:
    won = {"q": {"better": "holding still", "error": 1.0, "ratio": 0.5}}
    lost = {"q": {"better": "holding still", "error": 1.0, "ratio": 1.5}}
    assert loss_sentence({"a": won, "b": won}, won) is None
    assert loss_sentence({"a": lost, "b": won}, lost) is None
    many = {f"log{k}": lost if k % 2 else won for k in range(10)}
    assert "q in 5 of 10 (log1, log3, log5, ...)" in str(loss_sentence(many, won))
