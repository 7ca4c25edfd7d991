"""The mismatch map: every learner under five effects at three strengths (Furuta).

Registered before it is run: the effects and strengths of the catalogue
(`sim2gp.systems.effects.strengths`), scores of the third episode, and the cumulative
regret of the model that chooses, against the best model that was fixed beforehand.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import SOLVED
from sim2gp.studies.claims import (
    SAMPLING_PAYS,
    better_somewhere,
    bootstrap_weights,
    central,
    claim,
)
from sim2gp.studies.learners import METHODS, WITH_TERM
from sim2gp.studies.study import AbstractCell, Arrays, Key, Study, Values
from sim2gp.studies.swingup import (
    Cell,
    Table,
    best_seen,
    first_at,
    returns_of,
    scores_of,
)
from sim2gp.systems.effects.strengths import STRENGTHS, graded

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MACHINE = "furuta"
EFFECTS = graded(MACHINE)
QUICK_EFFECTS = ("spring",)
#: Auto's regret is asked to be at most this many times that of the best fixed model.
REGRET = 1.1
#: Fixed models that know no more than Auto does.
FIXED = tuple(m for m in METHODS if m not in ("Auto", WITH_TERM))


class MismatchMap(Study):
    """Every learner under every effect; a quick look has one effect and one seed."""

    size = (5, 3)
    quick_size = (1, 3)

    def rows(self) -> dict[Key, list[Cell]]:
        """A row for each effect with its strength, and each learner."""
        return {
            (condition, method): [
                Cell(MACHINE, condition, method, seed, self.episodes)
                for seed in self.seeds
            ]
            for effect in (QUICK_EFFECTS if self.quick else EFFECTS)
            for condition in (f"{effect} {strength}" for strength in STRENGTHS)
            for method in METHODS
        }

    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """Scores ``mismatch/EFFECT/LEARNER``."""
        table = scores_of(self.rows(), values)
        return {f"mismatch/{'/'.join(key)}": score for key, score in table.items()}

    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """Regrets and claims."""
        table = {key: arrays[f"mismatch/{'/'.join(key)}"] for key in self.rows()}
        return {
            "title": "Mismatch map: every learner under what its simulator lacks",
            "episodes": self.episodes,
            "mismatch": {
                "conditions": list(dict.fromkeys(c for c, _ in table)),
                "methods": list(METHODS),
            },
            "regret": regrets(table),
            "claims": mismatch_claims(table, self.rng),
            **returns_of(values),
            "tables": tables(table),
        }

    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> "dict[str, Figure]":
        """Scores of the last episode, by effect and learner."""
        from sim2gp.reports import mismatch_map

        return {"mismatch": mismatch_map(arrays, summary)}


def regret_by_seed(table: Table) -> dict[str, Float[np.ndarray, " seeds"]]:
    """Regret of each learner and seed: lost score, summed over the map's episodes.

    An episode that was not run lost all of it; better than the oracle is no gain.
    """
    out: dict[str, Float[np.ndarray, " seeds"]] = {}
    for (_, method), score in table.items():
        each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 0.0), 1.0)
        out[method] = out.get(method, 0.0) + each.sum(axis=1)
    return out


def regrets(table: Table) -> dict[str, float]:
    """Cumulative regret of each learner, over all seeds."""
    return {method: float(each.sum()) for method, each in regret_by_seed(table).items()}


def mismatch_claims(
    table: Table, rng: np.random.Generator
) -> dict[str, dict[str, Any]]:
    """Whether choosing costs more than having known the best model in advance.

    And whether sampling pays anywhere, by the mean score of the episodes.
    """
    each, regret = regret_by_seed(table), regrets(table)
    best = min(FIXED, key=lambda m: regret[m])
    weights = bootstrap_weights(len(each[best]), rng)
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
