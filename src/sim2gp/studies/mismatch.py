"""The mismatch map: every learner under five effects at three strengths (Furuta).

Registered before it is run: the effects and strengths of the catalogue
(`sim2gp.systems.effects.strengths`), scores of the third episode, and the cumulative
regret of the model that chooses, against the best model that was fixed beforehand.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import SOLVED
from sim2gp.runs import Progress, new_run
from sim2gp.runs.cells import Old
from sim2gp.runs.provenance import provenance, reproduce
from sim2gp.studies.claims import (
    SAMPLING_PAYS,
    better_somewhere,
    central,
    claim,
    resampled,
)
from sim2gp.studies.swingup import (
    METHODS,
    WITH_TERM,
    Cell,
    best_seen,
    first_at,
    study,
)
from sim2gp.systems.effects.strengths import STRENGTHS, graded

MACHINE = "furuta"
EFFECTS = graded(MACHINE)
SEEDS, EPISODES = 5, 3
QUICK_SEEDS, QUICK_EFFECTS = 1, ("spring",)
#: Auto's regret is asked to be at most this many times that of the best fixed model.
REGRET = 1.1
#: Fixed models that know no more than Auto does.
FIXED = tuple(m for m in METHODS if m not in ("Auto", WITH_TERM))

Table = dict[tuple[str, str], Float[np.ndarray, "seeds E"]]


def run(
    *,
    out: Path,
    seed: int,
    seeds: int | None,
    episodes: int | None,
    quick: bool,
    workers: int,
    progress: Progress,
    old: Old = "refuse",
) -> dict[str, Any]:
    """Fly the missing cells and write the map; returns its summary.

    ``quick`` is one effect and one seed.
    """
    started = time.perf_counter()
    seeds = seeds or (QUICK_SEEDS if quick else SEEDS)
    episodes = episodes or EPISODES
    conditions = [
        f"{effect} {strength}"
        for effect in (QUICK_EFFECTS if quick else EFFECTS)
        for strength in STRENGTHS
    ]
    numbers = range(seed, seed + seeds)
    groups = {
        (c, m): Cell(MACHINE, c, m, seed, episodes) for c in conditions for m in METHODS
    }
    with new_run(out, "reproduce mismatch") as writer:
        table, details = study(
            groups, numbers, out, workers=workers, progress=progress, old=old
        )
        words = reproduce("mismatch", seed, seeds, episodes, quick, old)
        summary: dict[str, Any] = {
            "command": "reproduce mismatch",
            "title": "Mismatch map: every learner under what its simulator lacks",
            "seed": seed,
            "seeds": seeds,
            "episodes": episodes,
            "regret": regrets(table),
            "claims": claims(table, np.random.default_rng(seed)),
            **details,
            "tables": tables(table),
            **provenance(started, words),
        }
        arrays = {f"mismatch/{'/'.join(k)}": v for k, v in table.items()}
        from sim2gp.reports import write_report

        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        writer.write_text("report.html", write_report(summary, arrays))
    return summary


def lost(table: Table) -> dict[str, Float[np.ndarray, " seeds"]]:
    """Regret of each learner and seed: lost score, summed over the map's episodes.

    An episode that was not flown lost all of it; better than the oracle is no gain.
    """
    out: dict[str, Float[np.ndarray, " seeds"]] = {}
    for (_, method), score in table.items():
        each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 0.0), 1.0)
        out[method] = out.get(method, 0.0) + each.sum(axis=1)
    return out


def regrets(table: Table) -> dict[str, float]:
    """Cumulative regret of each learner, over all seeds."""
    return {method: float(each.sum()) for method, each in lost(table).items()}


def claims(table: Table, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Whether choosing costs more than having known the best model in advance.

    And whether sampling pays anywhere, by the mean score of the episodes flown.
    """
    each, regret = lost(table), regrets(table)
    best = min(FIXED, key=lambda m: regret[m])
    weights = resampled(len(each[best]), rng)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = regret["Auto"] / np.float64(regret[best])
        low, high = central((weights @ each["Auto"]) / (weights @ each[best]))
    mean = {key: best_seen(score).mean(axis=1) for key, score in table.items()}
    pairs = {c: (mean[c, "SIM2GP"], mean[c, "point estimate"]) for c, _ in table}
    return {
        "choosing_costs_little": claim(
            bool(ratio <= REGRET),
            f"{ratio:.2f} [{low:.2f}, {high:.2f}] times the regret of {best}",
            f"over the whole map Auto's cumulative regret is at most {REGRET} times "
            "that of the best fixed model",
        ),
        "sampling_beats_the_point_estimate_somewhere": better_somewhere(
            pairs, rng, SAMPLING_PAYS
        ),
    }


def tables(table: Table) -> list[dict[str, Any]]:
    """The last episode's median score, how many seeds were solved, and the regrets."""
    conditions = list(dict.fromkeys(c for c, _ in table))
    rows = []
    for condition in conditions:
        row = [condition]
        for method in METHODS:
            score = table[condition, method]
            last = np.where(np.isfinite(score[:, -1]), score[:, -1], 0.0)
            solved = int(np.sum(np.isfinite(first_at(score, SOLVED))))
            row.append(f"{np.median(last):.2f} ({solved}/{len(score)})")
        rows.append(row)
    total = regrets(table)
    return [
        {
            "title": "Score of the last episode (and seeds that reached 95 % in any)",
            "columns": ["effect", *METHODS],
            "rows": rows,
            "note": "Medians over seeds; 1 is the oracle, 0 a pole left hanging.",
        },
        {
            "title": "Cumulative regret over the map",
            "columns": list(METHODS),
            "rows": [[f"{total[m]:.1f}" for m in METHODS]],
            "note": "Lost score, summed over effects, strengths, seeds and episodes.",
        },
    ]
