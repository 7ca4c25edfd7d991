"""Figure 2: posterior sampling with sampling MPC, with and without model mismatch.

Best-seen score against episode, for every learner on both machines. The cells are on
the disk as soon as they are flown: an interrupted figure goes on where it was, and a
finished one is redrawn from them.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.experiments.claims import (
    SAMPLING_PAYS,
    at_least_as_good,
    better_somewhere,
    claim,
)
from sim2gp.experiments.record import provenance
from sim2gp.experiments.swingup import (
    CONDITIONS,
    METHODS,
    WITH_TERM,
    Cell,
    best_seen,
    first_at,
    median_episode,
    study,
)
from sim2gp.runs import Progress, new_run
from sim2gp.tasks import MACHINES, SOLVED

SEEDS, EPISODES = 5, 10
QUICK_SEEDS, QUICK_EPISODES = 2, 4
CLAIM_EPISODES = 5  # claims compare means of the best-seen score over these

Table = dict[tuple[str, str, str], Float[np.ndarray, "seeds E"]]


def run(
    *,
    out: Path,
    seed: int,
    seeds: int | None,
    episodes: int | None,
    quick: bool,
    workers: int,
    progress: Progress,
) -> dict[str, Any]:
    """Fly the missing cells, check the claims, write the run; returns its summary.

    ``seeds`` and ``episodes`` None are the figure's own numbers. The cells of an
    earlier run with the same ``out`` are used again, also for fewer episodes. A
    ``quick`` look is planned with fewer sequences and has cells of its own.
    """
    started = time.perf_counter()
    seeds = seeds or (QUICK_SEEDS if quick else SEEDS)
    episodes = episodes or (QUICK_EPISODES if quick else EPISODES)
    groups = {
        (m, c, w): Cell(m, c, w, seed, episodes, quick=quick)
        for m in MACHINES
        for c in CONDITIONS
        for w in METHODS
    }
    numbers = range(seed, seed + seeds)
    with new_run(out, "reproduce fig2") as writer:
        table, details = study(groups, numbers, out, workers=workers, progress=progress)
        words = f"sim2gp reproduce fig2 --seed {seed} --seeds {seeds} "
        summary: dict[str, Any] = {
            "command": "reproduce fig2",
            "title": "Figure 2: posterior sampling with MPC",
            "figure2": {
                "machines": list(MACHINES),
                "conditions": list(CONDITIONS),
                "methods": list(METHODS),
                "episodes": episodes,
            },
            "seed": seed,
            "seeds": seeds,
            "claims": claims(table, np.random.default_rng(seed)),
            **details,
            "tables": [_table(table)],
            **provenance(words + f"--episodes {episodes}{' --quick' * quick}", started),
        }
        arrays = {f"figure2/{'/'.join(k)}": v for k, v in table.items()}
        from sim2gp.report import figure2, figure_bytes, write_report

        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        writer.write_bytes("figure2.png", figure_bytes(figure2(arrays, summary), "png"))
        writer.write_text("report.html", write_report(summary, arrays))
    return summary


def claims(table: Table, rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """The paper's claims and ours, on paired seeds; a figure beside each verdict.

    Learners are compared by the mean best-seen score over the first five episodes; an
    interval is the central 95 % of bootstrap means over seeds.
    """
    reached = {key: first_at(score, SOLVED) for key, score in table.items()}
    early = {
        key: best_seen(score)[:, :CLAIM_EPISODES].mean(axis=1)
        for key, score in table.items()
    }
    rivals = [m for m in METHODS if m not in ("point estimate", "Auto", WITH_TERM)]
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
            "RES", {m: early[*nominal, m] for m in rivals}, rng, "without mismatch"
        )
        share = float(np.mean(np.isfinite(reached[*wrong, "SIM2GP"])))
        out[f"{machine}_physics_alone_fails_under_mismatch"] = claim(
            share == 0.0,
            f"{share:.0%} of seeds reach 95 %",
            "under mismatch pure SIM2GP never reaches 95 %",
        )
        out[f"{machine}_literal_function_space_is_best_under_mismatch"] = _best(
            "FS literal", {m: early[*wrong, m] for m in rivals}, rng, "under mismatch"
        )
        needed = median_episode(reached[*wrong, "RES-FS"])
        out[f"{machine}_RES_FS_solves_mismatch_in_three"] = claim(
            needed <= 3.0,
            f"median episode {needed:g}",
            "under mismatch RES-FS reaches 95 % in at most 3 episodes",
        )
    pairs = {
        f"{m}, {c}": (early[m, c, "SIM2GP"], early[m, c, "point estimate"])
        for m in MACHINES
        for c in CONDITIONS
    }
    out["sampling_beats_the_point_estimate_somewhere"] = better_somewhere(
        pairs, rng, SAMPLING_PAYS
    )
    return out


def _best(
    name: str,
    early: dict[str, Float[np.ndarray, " seeds"]],
    rng: np.random.Generator,
    when: str,
) -> dict[str, Any]:
    text = f"{when} {name} is at least as good as every other learned model"
    score = "(mean best-seen score, episodes 1-5)"
    return at_least_as_good(name, early, rng, f"{text} {score}")


def _table(table: Table) -> dict[str, Any]:
    """Median episodes to 95 %, and the median best score of the last episode."""
    groups = [(m, c) for m in MACHINES for c in CONDITIONS]
    rows = []
    for method in METHODS:
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
