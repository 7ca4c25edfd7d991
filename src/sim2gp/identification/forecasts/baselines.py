"""Two predictors without mechanics, and how a model's forecasts compare with them.

One holds the start; the other is a linear regression of the displacement on the start
state and every input of the window. Recorded in closed loop, the inputs leak the
future, which is how a regression can win. A forecast that loses to either is worth
nothing, however small its error: every sentence on forecast errors is made here.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from sim2gp.data.grid import PERIOD, Grid

HOLD, REGRESSION = "holding still", "a linear regression"
ALIKE = 0.05  # a smaller relative difference of two errors is none


def regression_errors(
    train: Grid, test: Grid, rows: Int[np.ndarray, " R"]
) -> Float[np.ndarray, "W R c"]:
    """Errors of the linear regression; NaN where it has more unknowns than windows."""
    inputs = [_mean_inputs(grid, int(rows.max())) for grid in (train, test)]
    parts = []
    for row in rows.tolist():
        (x, moved, known), (x2, moved2, _) = (
            _features(grid, u[:, :row], row)
            for grid, u in zip((train, test), inputs, strict=True)
        )
        if known.sum() > x.shape[1]:
            weights = np.linalg.lstsq(x[known], moved[known], rcond=None)[0]
            parts.append(x2 @ weights - moved2)
        else:
            parts.append(np.full_like(moved2, np.nan))
    return np.stack(parts, axis=1)


def _mean_inputs(grid: Grid, row: int) -> Float[np.ndarray, "W row m"]:
    """Every input's mean over each grid step up to a row."""
    w = grid.windows
    edges = PERIOD * np.arange(row + 1)
    means = [
        [np.diff(np.interp(edges, knots, column)) for column in np.asarray(area).T]
        for knots, area in zip(w.knots, w.area, strict=True)
    ]
    found = np.asarray(means).reshape(len(means), w.area.shape[2], row)
    return found.transpose(0, 2, 1) / PERIOD


def _features(
    grid: Grid, inputs: Float[np.ndarray, "W row m"], row: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Start, inputs and one; the displacement at the row; where it was measured."""
    w = grid.windows
    start = np.asarray(w.start)
    u = inputs.transpose(0, 2, 1).reshape(len(start), -1)
    x = np.concatenate([start, u, np.ones((len(start), 1))], axis=1)
    moved = np.asarray(w.y)[:, row] - start[:, list(w.outputs)]
    return x, moved, np.all(np.asarray(w.mask)[:, row], axis=1, keepdims=False).ravel()


def compare_baselines(
    names: Sequence[str],
    model: Float[np.ndarray, " c"],
    hold: Float[np.ndarray, " c"],
    regression: Float[np.ndarray, " c"],
) -> dict[str, dict[str, Any]]:
    """Of each channel, the better of the two predictors and the model's error in its.

    The errors are root mean squares, NaN where there is none; the ratio is None where
    the better predictor makes no error at all.
    """
    out: dict[str, dict[str, Any]] = {}
    for c, name in enumerate(names):
        errors = {HOLD: float(hold[c]), REGRESSION: float(regression[c])}
        known = {k: v for k, v in errors.items() if np.isfinite(v)}
        if not np.isfinite(model[c]) or not known:
            continue
        best = min(known, key=lambda k: known[k])
        ratio = float(model[c]) / known[best] if known[best] > 0.0 else None
        out[name] = {"better": best, "error": known[best], "ratio": ratio}
    return out


def forecast_sentence(
    about: str,
    error: Mapping[str, float],
    against: Mapping[str, Mapping[str, Any]],
    units: Mapping[str, str],
    coverage: Mapping[str, float] | None = None,
) -> str:
    """Errors by channel, next to those of the better predictor without mechanics.

    ``about`` begins the sentence ("Open-loop error at 0.5 s"), ``against`` is
    `compare_baselines`'s. Where the model loses, a second sentence says so.
    """
    clauses, losses = [], dict[str, list[str]]()
    for name, entry in against.items():
        ratio, better, inside = entry["ratio"], entry["better"], ""
        times = f"where {better} makes no error"
        if ratio is not None:
            times = f"{ratio:.2g} times the error of {better}"
        if coverage is not None:
            inside = f" ({100 * coverage[name]:.0f} % inside the 90 % band)"
        value = f"{error[name]:.3g} {units.get(name, '')}".rstrip()
        clauses.append(f"{name} {value}, {times}{inside}")
        if (how := _lost(ratio)) is not None:
            losses.setdefault(f"{how} than {better}", []).append(name)
    said = [
        f"The model predicts {' and '.join(names)} {how} does."
        for how, names in losses.items()
    ]
    return " ".join([f"{about}: {'; '.join(clauses)}.", *said])


def loss_sentence(
    by_log: Mapping[str, Mapping[str, Mapping[str, Any]]],
    pooled: Mapping[str, Mapping[str, Any]],
) -> str | None:
    """In which logs alone a model is worse than a predictor without mechanics; or None.

    ``by_log`` holds the answer of `compare_baselines` for each log, ``pooled`` that for
    all of them: of a channel that loses there, nothing more is said.
    """
    lost: dict[str, list[str]] = {}
    for log, against in by_log.items():
        for name, entry in against.items():
            over_all = name in pooled and _lost(pooled[name]["ratio"])
            if _lost(entry["ratio"]) == "worse" and not over_all:
                lost.setdefault(name, []).append(log)
    if not lost:
        return None
    clauses = [
        f"{name} in {len(logs)} of {len(by_log)} ({_first(logs)})"
        for name, logs in lost.items()
    ]
    return (
        "Logs in which holding still or a linear regression predicts better: "
        f"{'; '.join(clauses)}."
    )


def _first(logs: Sequence[str]) -> str:
    return ", ".join(logs if len(logs) <= 3 else [*logs[:3], "..."])


def _lost(ratio: float | None) -> str | None:
    """How a model is that does not beat the better predictor; None where it does."""
    if ratio is None or ratio > 1.0 + ALIKE:
        return "worse"
    return "no better" if ratio > 1.0 - ALIKE else None
