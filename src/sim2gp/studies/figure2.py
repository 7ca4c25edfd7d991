"""Figures 2 and 4: posterior sampling, with and without model mismatch.

Best-seen score against episode, for every learner on both machines: with sampling MPC,
and with policies that are trained off-policy in the sampled world.
"""

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import MACHINES, SOLVED
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies.claims import (
    SAMPLING_PAYS,
    at_least_as_good,
    better_somewhere,
    bootstrap_interval,
    claim,
    difference_in_words,
)
from sim2gp.studies.learners import CONDITIONS, METHODS, TRAINED, WITH_TERM
from sim2gp.studies.study import Arrays, Key, Study
from sim2gp.studies.swingup import (
    Cell,
    Table,
    best_seen,
    first_at,
    median_episode,
    returns_of,
    scores_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLAIM_EPISODES = 5  # claims compare means of the best-seen score over these
#: Each figure's number, its title, how it plans, and the lines it draws.
FIGURES = {
    "fig2": ("2", "posterior sampling with MPC", "mpc", tuple(METHODS)),
    "fig4": (
        "4",
        "posterior sampling with off-policy learning",
        "sac",
        (*METHODS, *TRAINED),
    ),
}
#: Of the median off-policy oracle, against MPC's.
CLOSE = 0.9
#: Learned models that are compared with each other.
RIVALS = tuple(m for m in METHODS if m not in ("point estimate", "Auto", WITH_TERM))


class PosteriorSampling(Study):
    """Every learner on every machine, without and with mismatch.

    A quick look has fewer plans and less training, in cells of its own.
    """

    size = (5, 10)
    quick_size = (2, 4)

    def rows(self) -> dict[Key, list[Cell]]:
        """A row for each machine, condition and learner of the figure."""
        _, _, planning, methods = FIGURES[self.name]
        cell = partial(
            Cell, episodes=self.episodes, quick=self.quick, planning=planning
        )
        return {
            (m, c, w): [cell(m, c, w, seed) for seed in self.seeds]
            for m in MACHINES
            for c in CONDITIONS
            for w in methods
        }

    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """Scores ``figure2/MACHINE/CONDITION/LEARNER``."""
        table = scores_of(self.rows(), values)
        return {f"figure2/{'/'.join(key)}": score for key, score in table.items()}

    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """The claims of figure 2 or of figure 4."""
        number, title, _, methods = FIGURES[self.name]
        table = {key: arrays[f"figure2/{'/'.join(key)}"] for key in self.rows()}
        check = swing_up_claims if self.name == "fig2" else off_policy_claims
        return {
            "title": f"Figure {number}: {title}",
            "figure2": {
                "number": number,
                "machines": list(MACHINES),
                "conditions": list(CONDITIONS),
                "methods": list(methods),
                "episodes": self.episodes,
            },
            "claims": check(table, self.rng),
            **returns_of(values),
            "tables": [_median_score_table(table, methods)],
        }

    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> "dict[str, Figure]":
        """Best-seen score against episode."""
        from sim2gp.reports import figure2

        return {f"figure{summary['figure2']['number']}": figure2(arrays, summary)}


def swing_up_claims(
    table: Table, rng: np.random.Generator
) -> dict[str, dict[str, Any]]:
    """The paper's claims and ours, on paired seeds; a number with each verdict.

    Learners are compared by the mean best-seen score over the first five episodes; an
    interval is the central 95 % of bootstrap means over seeds.
    """
    reached = {key: first_at(score, SOLVED) for key, score in table.items()}
    early = _early(table)
    out: dict[str, dict[str, Any]] = {}
    for machine in MACHINES:
        nominal, wrong = (machine, "nominal"), (machine, "mismatch")
        soon = {
            m: median_episode(reached[*nominal, m]) for m in ("SIM2GP", "RES", "NLM")
        }
        best = max(soon["SIM2GP"], soon["RES"])
        out[f"{machine}_physics_learns_twice_as_fast"] = claim(
            best <= 2.0 and soon["NLM"] >= 2.0 * best,
            ", ".join(f"{m} {x:g}" for m, x in soon.items()),
            "without mismatch SIM2GP and RES reach 95 % by episode 2 and NLM needs at "
            "least twice as many (median episodes)",
        )
        out[f"{machine}_residual_costs_nothing"] = _best(
            "RES", {m: early[*nominal, m] for m in RIVALS}, rng, "without mismatch"
        )
        share = float(np.mean(np.isfinite(reached[*wrong, "SIM2GP"])))
        out[f"{machine}_physics_alone_fails_under_mismatch"] = claim(
            share == 0.0,
            f"{share:.0%} of seeds reach 95 %",
            "under mismatch pure SIM2GP never reaches 95 %",
        )
        out[f"{machine}_literal_function_space_is_best_under_mismatch"] = _best(
            "FS literal", {m: early[*wrong, m] for m in RIVALS}, rng, "under mismatch"
        )
        for name, most, words in (("RES-FS", 3, "three"), ("MissingForces", 2, "two")):
            needed = median_episode(reached[*wrong, name])
            about = f"{name.replace('-', '_')}_solves_mismatch_in_{words}"
            out[f"{machine}_{about}"] = claim(
                needed <= most,
                f"median episode {needed:g}",
                f"under mismatch {name} reaches 95 % in at most {most} episodes",
            )
        out[f"{machine}_MissingForces_is_best_under_mismatch"] = _best(
            "MissingForces",
            {m: early[*wrong, m] for m in RIVALS},
            rng,
            "under mismatch",
        )
    return out | _sampling_pays(early, rng)


def off_policy_claims(
    table: Table, rng: np.random.Generator
) -> dict[str, dict[str, Any]]:
    """As `swing_up_claims`, of policies that were trained in the sampled world."""
    early = _early(table)
    out: dict[str, dict[str, Any]] = {}
    for machine in MACHINES:
        nominal, wrong = (machine, "nominal"), (machine, "mismatch")
        last = [
            float(np.median(best_seen(table[*group, "off-policy oracle"])[:, -1]))
            for group in (nominal, wrong)
        ]
        out[f"{machine}_off_policy_oracle_is_close_to_MPC"] = claim(
            min(last) >= CLOSE,
            f"median best score {last[0]:.2f}, with mismatch {last[1]:.2f}",
            f"trained in the true world, the best score is at least {CLOSE} of MPC's",
        )
        for name, word in (("FS literal", "literal_function_space"), ("FS", "FS")):
            out[f"{machine}_{word}_is_best_under_mismatch"] = _best(
                name, {m: early[*wrong, m] for m in RIVALS}, rng, "under mismatch"
            )
        gain = early[*nominal, "SIM2GP"] - early[*nominal, "domain randomisation"]
        low, high = bootstrap_interval(gain, rng)
        out[f"{machine}_the_posterior_beats_domain_randomisation"] = claim(
            low > 0.0,
            difference_in_words(gain, low, high),
            "without mismatch policies trained in posterior draws are better than one "
            "trained in draws of the prior (mean best-seen score, episodes 1-5)",
        )
    return out | _sampling_pays(early, rng)


def _early(table: Table) -> dict[Key, Float[np.ndarray, " seeds"]]:
    """What learners are compared by."""
    return {
        key: best_seen(score)[:, :CLAIM_EPISODES].mean(axis=1)
        for key, score in table.items()
    }


def _sampling_pays(
    early: dict[Key, Float[np.ndarray, " seeds"]],
    rng: np.random.Generator,
) -> dict[str, dict[str, Any]]:
    pairs = {
        f"{m}, {c}": (early[m, c, "SIM2GP"], early[m, c, "point estimate"])
        for m in MACHINES
        for c in CONDITIONS
    }
    found = better_somewhere(pairs, rng, SAMPLING_PAYS)
    return {"sampling_beats_the_point_estimate_somewhere": found}


def _best(
    name: str,
    early: dict[str, Float[np.ndarray, " seeds"]],
    rng: np.random.Generator,
    when: str,
) -> dict[str, Any]:
    text = f"{when} {name} is at least as good as every other learned model"
    score = "(mean best-seen score, episodes 1-5)"
    return at_least_as_good(name, early, rng, f"{text} {score}")


def _median_score_table(table: Table, methods: tuple[str, ...]) -> dict[str, Any]:
    """Median episodes to 95 %, and the median best score of the last episode."""
    groups = [(m, c) for m in MACHINES for c in CONDITIONS]
    rows = []
    for method in methods:
        row = [method]
        for machine, condition in groups:
            score = table[machine, condition, method]
            needed = median_episode(first_at(score, SOLVED))
            last = float(np.median(best_seen(score)[:, -1]))
            shown = f"{needed:g}" if np.isfinite(needed) else "never"
            row.append(f"{shown} ({last:.2f})")
        rows.append(row)
    return {
        "title": "Episodes to 95 % of the oracle's score (and best score in the end)",
        "columns": ["learner", *(f"{m}, {c}" for m, c in groups)],
        "rows": rows,
        "note": "Medians over seeds; every episode counts, 5 s each.",
    }
