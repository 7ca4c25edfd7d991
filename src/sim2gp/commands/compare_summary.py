"""What a comparison of models says: summary keys, tables, curves, the verdict."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.data.logs import Log
from sim2gp.identification.forecasts import scoring
from sim2gp.identification.forecasts.baselines import (
    compare_baselines,
    forecast_sentence,
)
from sim2gp.identification.forecasts.prediction import recording_names
from sim2gp.identification.forecasts.scoring import PairedComparison
from sim2gp.identification.words import finite_or_none

FEWEST = 4  # recordings that a bootstrap can draw from; of fewer, seconds are drawn
STRETCH = 1.0  # s


@dataclass(frozen=True)
class FoldForecasts:
    """Forecasts of what a fold left out, by all models."""

    error: Float[np.ndarray, "models W R c"]  # prediction minus measurement
    sd: Float[np.ndarray, "models W R c"]
    trivial: Float[np.ndarray, "2 W R c"]  # errors of the start held, and a regression
    valid: Bool[np.ndarray, "W R c"]
    log: Int[np.ndarray, " W"]
    since: Float[np.ndarray, " W"]  # s, on the log's clock
    step_score: Float[np.ndarray, " models"]  # nats per smoothed step
    steps: int  # smoothed steps behind it

    @classmethod
    def joined(cls, parts: Sequence["FoldForecasts"]) -> "FoldForecasts":
        """All folds as one; step scores are averaged over steps."""
        count = np.asarray([part.steps for part in parts])
        scores = np.stack([part.step_score for part in parts])
        return cls(
            np.concatenate([part.error for part in parts], axis=1),
            np.concatenate([part.sd for part in parts], axis=1),
            np.concatenate([part.trivial for part in parts], axis=1),
            np.concatenate([part.valid for part in parts]),
            np.concatenate([part.log for part in parts]),
            np.concatenate([part.since for part in parts]),
            count @ scores / count.sum(),
            int(count.sum()),
        )


@dataclass(frozen=True)
class PooledScores:
    """Pooled scores: of every model, at every step judged, of every channel."""

    rmse: Float[np.ndarray, "models R c"]
    nll: Float[np.ndarray, "models R c"]
    crps: Float[np.ndarray, "models R c"]
    inside: Float[np.ndarray, "models R c"]  # share in the central 90 %


def summarise(
    parts: Sequence[FoldForecasts],
    what: Mapping[str, str],
    channels: Sequence[str],
    logs: Sequence[Log],
    seconds: Float[np.ndarray, " R"],
    horizons: Sequence[float],
    rng: np.random.Generator,
    units: Mapping[str, str],
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary keys and curves; the verdict counts ``horizons`` alone.

    ``what`` gives each model in words. ``seconds`` are the horizons of all steps that
    were judged; ``horizons`` are some of them.
    """
    models = list(what)
    held = FoldForecasts.joined(parts)
    crps = scoring.crps(held.error, held.sd)
    table = _pool_scores(held, crps)
    at = [int(np.argmin(np.abs(seconds - h))) for h in horizons]
    unit, words = units_of(held, logs)
    sums = scoring.crps_by_unit(crps[:, :, at], held.valid[:, at], unit)
    against = [scoring.compare_paired(row, sums[0], rng) for row in sums]
    kept = scoring.select_model(sums, rng)
    entries = {}
    for k, name in enumerate(models):
        entries[name] = _model_scores(table, k, at, horizons, channels)
        entries[name] |= _paired_entries(against[k])
        entries[name]["step_log_score"] = finite_or_none(held.step_score[k])
    tables = [
        _horizon_table(
            held, crps, table, i, f"{h:g}", models, channels, unit, words, rng
        )
        for i, h in zip(at, horizons, strict=True)
    ]
    tables.append(_log_table(crps[:, :, at], held, at, models, logs))
    away = [n for n, entry in entries.items() if entry["crps_change"] is None]
    said = _against_trivial(
        held, table.rmse[kept], models[kept], channels, at, horizons, units
    )
    summary = {
        "headline": " ".join(
            [scoring.selection_sentence(what, against, kept, words), *said]
        ),
        "best": models[kept],
        "horizons": list(horizons),
        "windows": int(held.valid[:, at].any(axis=(1, 2)).sum()),
        "models": entries,
        "tables": tables,
        "warnings": [f"forecasts by {name} ran away: it has no score" for name in away],
    }
    arrays: dict[str, np.ndarray] = {"curve/horizon": seconds}
    for k, name in enumerate(models):
        for c, channel in enumerate(channels):
            if name not in away:
                arrays[f"curve/{name}/{channel}"] = table.rmse[k, :, c]
    return summary, arrays


def _against_trivial(
    held: FoldForecasts,
    rmse: Float[np.ndarray, "R c"],
    model: str,
    channels: Sequence[str],
    at: Sequence[int],
    horizons: Sequence[float],
    units: Mapping[str, str],
) -> list[str]:
    """A sentence for each horizon: a model's errors next to those without mechanics."""
    trivial = np.sqrt(_pooled(held.trivial**2, held.valid))
    measured = np.asarray(held.valid.any(axis=0))
    said = []
    for i, h in zip(at, horizons, strict=True):
        error = np.where(measured[i], rmse[i], np.nan)
        against = compare_baselines(channels, error, trivial[0, i], trivial[1, i])
        named = dict(zip(channels, error.tolist(), strict=True))
        about = f"Error of {model} at {h:g} s"
        said.append(forecast_sentence(about, named, against, units))
    return said


def units_of(held: FoldForecasts, logs: Sequence[Log]) -> tuple[np.ndarray, str]:
    """What a bootstrap draws: recordings, or of few recordings their seconds."""
    files = list(dict.fromkeys(recording_names(logs)))
    number = np.asarray([files.index(log.source) for log in logs])
    if len(np.unique(number[held.log])) >= FEWEST:
        return number[held.log], "logs"
    second = np.floor(held.since / STRETCH).astype(int)
    pairs = np.stack([held.log, second], axis=1)
    return np.unique(pairs, axis=0, return_inverse=True)[1].ravel(), "seconds"


def _pool_scores(held: FoldForecasts, crps: np.ndarray) -> PooledScores:
    nll = scoring.nll(held.error, held.sd)
    inside = (np.abs(held.error) <= 1.6448536 * held.sd).astype(float)
    each = [_pooled(x, held.valid) for x in (held.error**2, nll, crps, inside)]
    return PooledScores(np.sqrt(each[0]), *each[1:])


def _pooled(x: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mean over windows; what is not finite stays so."""
    total = np.sum(np.where(valid[None], x, 0.0), axis=1)
    return np.asarray(total / np.maximum(valid.sum(axis=0), 1)[None])


def _model_scores(
    table: PooledScores,
    k: int,
    at: Sequence[int],
    horizons: Sequence[float],
    channels: Sequence[str],
) -> dict[str, Any]:
    """Scores of one model: at the first horizon on top, and at all."""

    def named(values: np.ndarray) -> dict[str, float | None]:
        return dict(zip(channels, map(finite_or_none, values), strict=True))

    return {
        "log_evidence": None,
        "heldout_nll": named(table.nll[k, at[0]]),
        "heldout_rmse": named(table.rmse[k, at[0]]),
        "heldout_crps": named(table.crps[k, at[0]]),
        "horizons": {
            f"{h:g}": {
                "rmse": named(table.rmse[k, i]),
                "nll": named(table.nll[k, i]),
                "crps": named(table.crps[k, i]),
                "coverage90": named(table.inside[k, i]),
            }
            for i, h in zip(at, horizons, strict=True)
        },
    }


def _paired_entries(found: PairedComparison) -> dict[str, Any]:
    return {
        "crps_change": finite_or_none(found.change),
        "crps_change_low": finite_or_none(found.low),
        "crps_change_high": finite_or_none(found.high),
        "better_in": found.better,
        "of": found.units,
    }


def _horizon_table(
    held: FoldForecasts,
    crps: np.ndarray,
    table: PooledScores,
    i: int,
    horizon: str,
    models: Sequence[str],
    channels: Sequence[str],
    unit: np.ndarray,
    words: str,
    rng: np.random.Generator,
) -> dict[str, Any]:
    """All scores at one horizon, model by model."""
    columns = ["model"]
    columns += [f"{what} {c}" for c in channels for what in ("rmse", "CRPS", "nll")]
    columns += [f"{c} in 90 %" for c in channels]
    columns += ["CRPS against SIM2GP", f"better in {words}"]
    sums = scoring.crps_by_unit(crps[:, :, [i]], held.valid[:, [i]], unit)
    rows = []
    for k, name in enumerate(models):
        row = [name]
        for c in range(len(channels)):
            values = (table.rmse[k, i, c], table.crps[k, i, c])
            row += [_format_score(x, ".4f") for x in values]
            row.append(_format_score(table.nll[k, i, c], ".2f"))
        row += [_format_score(x, ".3f") for x in table.inside[k, i]]
        found = scoring.compare_paired(sums[k], sums[0], rng)
        row += [scoring.format_change(found), f"{found.better} of {found.units}"]
        rows.append(row if k else [*row[:-2], "", ""])
    for name, off in zip(("holding still", "regression"), held.trivial, strict=True):
        off, counts = off[None, :, [i]], held.valid[:, [i]]
        rmse, size = np.sqrt(_pooled(off**2, counts)), _pooled(np.abs(off), counts)
        row = [name]
        for c in range(len(channels)):
            values = (rmse[0, 0, c], size[0, 0, c])
            row += [*(_format_score(x, ".4f", "too few windows") for x in values), ""]
        rows.append([*row, *[""] * (len(channels) + 2)])
    return {
        "title": f"Forecasts of what was left out, {horizon} s ahead",
        "columns": columns,
        "rows": rows,
        "note": "Root mean square error and CRPS in the channel's unit, nll in nats, "
        "pooled over windows that start every 0.1 s; change of CRPS over all channels "
        f"with a 95 % interval (bootstrap over {words}). CRPS of a single number is "
        "its absolute error; the regression is linear, on start and inputs.",
    }


def _log_table(
    crps: np.ndarray,
    held: FoldForecasts,
    at: Sequence[int],
    models: Sequence[str],
    logs: Sequence[Log],
) -> dict[str, Any]:
    """CRPS of each log and model, in that of the simulator over all logs."""
    names = list(dict.fromkeys(log.name for log in logs))
    number = np.asarray([names.index(log.name) for log in logs])[held.log]
    valid = held.valid[:, at]
    sums = scoring.crps_by_unit(crps, valid, number)
    # In shares of windows, so that the simulator's mean over windows is one.
    share = np.asarray([np.mean(number == u) for u in np.unique(number)])
    mean = sums / sums[0].sum() / share[None]
    return {
        "title": "CRPS log by log, all horizons, in the simulator's mean",
        "columns": ["log", *models],
        "rows": [
            [names[u], *(_format_score(x, ".3f") for x in mean[:, j])]
            for j, u in enumerate(np.unique(number))
        ],
        "note": "Below the simulator's column: the model foretold this log better.",
    }


def _format_score(x: float, how: str, missing: str = "ran away") -> str:
    return format(x, how) if math.isfinite(x) else missing
