"""The mismatch map: learners on machines that have what their simulator lacks.

Registered before it is run: the effects and strengths of the catalogue on both machines
(`sim2gp.systems.effects.strengths`) and nothing missing, best scores of two episodes,
and regrets over three. Four learners meet all of it; the others the Furuta's effects,
on the first half of the seeds.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import MACHINES, SOLVED
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies.claims import (
    SAMPLING_PAYS,
    better_somewhere,
    bootstrap_interval,
    bootstrap_weights,
    central,
    claim,
    difference_in_words,
)
from sim2gp.studies.learners import METHODS, WITH_TERM
from sim2gp.studies.study import Arrays, Key, Study
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

NOMINAL = "nominal"
QUICK_EFFECTS = {"furuta": ("spring",), "cartpole": ()}
#: Learners of the whole map; the others meet the effects of `OTHERS_ON`.
EVERYWHERE = ("SIM2GP", "RES", "MissingForces", WITH_TERM)
OTHERS_ON = "furuta"
COLUMNS = (*EVERYWHERE, *(m for m in METHODS if m not in EVERYWHERE))
#: What a force or a function of an input can be; a delay and a geometry are neither.
EXPRESSIBLE = ("coulomb", "dead_zone", "spring", "drag", "tilt")
#: MissingForces is asked to solve so many settings of all that a force can be, in so
#: many episodes, and at most so many times the regret of the right term.
SETTINGS, EPISODES, FORCES_REGRET = 24 / 27, 2, 1.05
#: Of the plain simulator's mean score, where nothing is missing.
LOSS = 0.01
#: Share of seeds in which residuals speak against the fit: at least so many where no
#: force can be what is missing, at most so many where nothing is.
SAID, SAID_WRONGLY = 0.5, 0.1
#: Auto's regret is asked to be at most this many times that of the best fixed model.
REGRET = 1.1
#: Fixed models that know no more than Auto does.
FIXED = tuple(m for m in METHODS if m not in ("Auto", WITH_TERM))


#: Values of MissingForces' cells, by machine and condition.
Found = Mapping[Key, Sequence[Values]]


class MismatchMap(Study):
    """Learners under every effect; a quick look has one effect and one seed."""

    size = (10, 3)
    quick_size = (1, 3)

    def rows(self) -> dict[Key, list[Cell]]:
        """A row for each machine, effect with its strength, and learner."""
        return {
            (machine, condition, method): [
                Cell(machine, condition, method, seed, self.episodes) for seed in seeds
            ]
            for machine in MACHINES
            for condition in self.conditions(machine)
            for method, seeds in self.compared(machine, condition).items()
        }

    def conditions(self, machine: str) -> list[str]:
        """Nothing missing, then each effect at each strength."""
        effects = QUICK_EFFECTS[machine] if self.quick else graded(machine)
        return [
            NOMINAL,
            *(f"{e} {strength}" for e in effects for strength in STRENGTHS),
        ]

    def compared(self, machine: str, condition: str) -> dict[str, Sequence[int]]:
        """The learners of a condition, and their seeds."""
        if machine != OTHERS_ON or condition == NOMINAL:
            return dict.fromkeys(EVERYWHERE, self.seeds)
        half = self.seeds[: (self.count + 1) // 2]
        return {m: self.seeds if m in EVERYWHERE else half for m in METHODS}

    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """Scores ``mismatch/MACHINE/EFFECT/LEARNER``."""
        table = scores_of(self.rows(), values)
        return {f"mismatch/{'/'.join(key)}": score for key, score in table.items()}

    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """Regrets and claims."""
        rows = self.rows()
        table = {key: arrays[f"mismatch/{'/'.join(key)}"] for key in rows}
        found = {
            key[:2]: [values[cell] for cell in row]
            for key, row in rows.items()
            if key[2] == "MissingForces"
        }
        return {
            "title": "Mismatch map: every learner under what its simulator lacks",
            "episodes": self.episodes,
            "mismatch_map": {
                "conditions": {m: self.conditions(m) for m in MACHINES},
                "methods": list(COLUMNS),
                "episodes": EPISODES,
            },
            "regret": regrets(table, EVERYWHERE),
            "claims": claims(table, self.rng)
            | {"what_is_no_force_is_said": said(found)},
            **returns_of(values),
            "tables": [*tables(table), found_table(found)],
        }

    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> "dict[str, Figure]":
        """Best scores of two episodes, by effect and learner."""
        from sim2gp.reports import mismatch_map

        return {"mismatch": mismatch_map(arrays, summary)}


def regret_by_seed(
    table: Table, methods: Sequence[str]
) -> dict[str, Float[np.ndarray, " seeds"]]:
    """Regret of each learner and seed: lost score, summed over effects and episodes.

    Over the conditions that all ``methods`` have met, and the seeds that they share. An
    episode that was not run lost all of it; better than the oracle is no gain.
    """
    out: dict[str, Float[np.ndarray, " seeds"]] = {}
    for place in dict.fromkeys(key[:2] for key in table):
        if place[1] == NOMINAL or not all((*place, m) in table for m in methods):
            continue
        shared = min(len(table[*place, m]) for m in methods)
        for method in methods:
            score = table[*place, method][:shared]
            each = 1.0 - np.minimum(np.where(np.isfinite(score), score, 0.0), 1.0)
            out[method] = out.get(method, 0.0) + each.sum(axis=1)
    return out


def regrets(table: Table, methods: Sequence[str]) -> dict[str, float]:
    """Cumulative regret of each learner, over all seeds that they share."""
    each = regret_by_seed(table, methods)
    return {method: float(regret.sum()) for method, regret in each.items()}


def claims(table: Table, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """What was asked of missing forces, of choosing, and of sampling."""
    whole, fair = regret_by_seed(table, EVERYWHERE), regret_by_seed(table, COLUMNS)
    best = min(FIXED, key=lambda m: fair[m].sum())
    mean = {key: best_seen(score).mean(axis=1) for key, score in table.items()}
    pairs = {}
    for (machine, condition, method), point in mean.items():
        if method == "point estimate":
            sampled = mean[machine, condition, "SIM2GP"][: len(point)]
            pairs[condition] = sampled, point
    return {
        "missing_forces_solve_in_two_episodes": solved_early(table),
        "missing_forces_cost_little_more_than_the_right_term": regret_ratio(
            whole,
            "MissingForces",
            WITH_TERM,
            FORCES_REGRET,
            rng,
            "over all effects of both machines MissingForces' cumulative regret is at "
            f"most {FORCES_REGRET} times that of the simulator with the right term",
        ),
        "missing_forces_cost_nothing_where_nothing_is_missing": nothing_lost(mean, rng),
        "choosing_costs_little": regret_ratio(
            fair,
            "Auto",
            best,
            REGRET,
            rng,
            f"over the {OTHERS_ON}'s effects Auto's cumulative regret is at most "
            f"{REGRET} times that of the best fixed model",
        ),
        "sampling_beats_the_point_estimate_somewhere": better_somewhere(
            pairs, rng, SAMPLING_PAYS
        ),
    }


def solved_early(table: Table) -> dict[str, Any]:
    """In how many settings that a force can be, and which are left."""
    reached = {
        f"{machine}, {condition}": float(np.median(best_seen(score)[:, EPISODES - 1]))
        for (machine, condition, method), score in table.items()
        if method == "MissingForces" and condition.split()[0] in EXPRESSIBLE
    }
    left = [f"{where} ({x:.2f})" for where, x in reached.items() if x < SOLVED]
    solved = len(reached) - len(left)
    figure = f"{solved} of {len(reached)}" + (
        f"; not {', '.join(left)}" if left else ""
    )
    return claim(
        solved >= SETTINGS * len(reached),
        figure,
        f"MissingForces reaches {SOLVED:.0%} of the oracle within {EPISODES} episodes "
        "(median of the best score) in at least 24 of 27 settings that a force or a "
        "function of an input can be",
    )


def said(found: Found) -> dict[str, Any]:
    """Whether a fit with missing forces shows that it is not enough, where it is not.

    Cells whose fit failed count as said: the program has said so.
    """
    share = {key: float(np.mean([_said(v) for v in row])) for key, row in found.items()}
    unknown = {
        k: x for k, x in share.items() if k[1].split()[0] not in (*EXPRESSIBLE, NOMINAL)
    }
    silent = [f"{', '.join(k)} ({x:.0%})" for k, x in unknown.items() if x < SAID]
    wrongly = max(x for k, x in share.items() if k[1] == NOMINAL)
    figure = f"{len(unknown) - len(silent)} of {len(unknown)}"
    figure += f"; not {', '.join(silent)}" if silent else ""
    return claim(
        not silent and wrongly <= SAID_WRONGLY,
        f"{figure}; with nothing missing in {wrongly:.0%}",
        "where no force can be what is missing, the misfit tests of MissingForces' fit "
        f"say so in at least {SAID:.0%} of seeds, with nothing missing in at most "
        f"{SAID_WRONGLY:.0%}",
    )


def _said(values: Values) -> bool:
    return bool(values.get("failure")) or bool(values.get("contradicted"))


def found_table(found: Found) -> dict[str, Any]:
    """Forces that are on after the last fit, and seeds in which they are not enough."""
    rows = []
    for key, row in found.items():
        counts = Counter(name for v in row for name in v.get("forces", ()))
        names = (f"{name} ({n})" for name, n in counts.most_common())
        rows.append([", ".join(key), ", ".join(names), str(sum(map(_said, row)))])
    return {
        "title": "What MissingForces found",
        "columns": ["effect", "forces (seeds)", "seeds with misfit"],
        "rows": rows,
        "note": "After the last fit. Misfit: its residuals, or a fit that failed, say "
        "that forces are not enough.",
    }


def nothing_lost(
    mean: Mapping[Key, Float[np.ndarray, " seeds"]], rng: np.random.Generator
) -> dict[str, Any]:
    """Mean best-seen scores without mismatch, against the plain simulator's."""
    each = [
        mean[machine, NOMINAL, "MissingForces"] - mean[machine, NOMINAL, "SIM2GP"]
        for machine in MACHINES
    ]
    difference = np.mean(each, axis=0)
    low, high = bootstrap_interval(difference, rng)
    return claim(
        bool(difference.mean() >= -LOSS),
        difference_in_words(difference, low, high),
        "where nothing is missing, MissingForces' mean best-seen score is at most "
        f"{LOSS} below the plain simulator's",
    )


def regret_ratio(
    each: Mapping[str, Float[np.ndarray, " seeds"]],
    name: str,
    other: str,
    most: float,
    rng: np.random.Generator,
    text: str,
) -> dict[str, Any]:
    """Whether one's regret is at most so many times another's."""
    weights = bootstrap_weights(len(each[other]), rng)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = each[name].sum() / each[other].sum()
        low, high = central((weights @ each[name]) / (weights @ each[other]))
    figure = f"{ratio:.2f} [{low:.2f}, {high:.2f}] times the regret of {other}"
    return claim(bool(ratio <= most), figure, text)


def tables(table: Table) -> list[dict[str, Any]]:
    """Best scores of two episodes, how many seeds were solved, and the regrets."""
    rows = []
    for machine, condition in dict.fromkeys(key[:2] for key in table):
        row = [f"{machine}, {condition}"]
        for method in COLUMNS:
            score = table.get((machine, condition, method))
            row.append("" if score is None else _in_words(score))
        rows.append(row)
    total = {m: regrets(table, m) for m in (EVERYWHERE, COLUMNS)}
    return [
        {
            "title": f"Best score of {EPISODES} episodes (and seeds that reached 95 %)",
            "columns": ["effect", *COLUMNS],
            "rows": rows,
            "note": "Medians and quartiles over seeds; 1 is the oracle, 0 a pole left "
            "hanging.",
        },
        *(
            {
                "title": f"Cumulative regret over {where}",
                "columns": list(regret),
                "rows": [[f"{x:.1f}" for x in regret.values()]],
                "note": "Lost score, summed over effects, strengths, episodes and the "
                "seeds that all have met.",
            }
            for where, regret in zip(
                ("both machines", f"the {OTHERS_ON}"), total.values(), strict=True
            )
        ),
    ]


def _in_words(score: Float[np.ndarray, "seeds E"]) -> str:
    """Median, quartiles, and how many of the seeds were solved by then."""
    best = best_seen(score)[:, :EPISODES][:, -1]
    low, middle, high = np.quantile(best, (0.25, 0.5, 0.75))
    solved = int(np.sum(first_at(score, SOLVED) <= EPISODES))
    return f"{middle:.2f} [{low:.2f}, {high:.2f}] ({solved}/{len(score)})"
