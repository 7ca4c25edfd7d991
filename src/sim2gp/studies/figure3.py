"""Figures 3 and 5: how well models know a machine that they explored for information.

Error and negative log density on a swing-up that nobody learned from, against episode,
for every model with posterior sampling, and for the signals that identification has
always used. One study has the cells of both figures; they differ in what is drawn.
"""

import time
from collections.abc import Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import MACHINES
from sim2gp.runs import Progress, new_run
from sim2gp.runs.cells import Cells, Old
from sim2gp.runs.provenance import provenance, reproduce
from sim2gp.studies import exploring
from sim2gp.studies.claims import at_least_as_good, claim, of_median
from sim2gp.studies.exploring import (
    METHODS,
    QUANTITIES,
    Cell,
    explore_cell,
    reference,
)
from sim2gp.studies.stages import in_stages
from sim2gp.studies.swingup import CONDITIONS

SEEDS, EPISODES = 5, 10
QUICK_SEEDS, QUICK_EPISODES = 1, 2
#: Variants that a quick look does without: what is left fits into six minutes.
NOT_QUICK = ("FS literal", "SIM2GP, step by step", "RES-FS, random")
STEPS = 250  # transitions of an episode, on both machines
FIGURES = {"fig3": "rmse", "fig5": "nll"}
#: Exploring is asked to need at most this share of the transitions of random input.
SHARE = 0.5

Key = tuple[str, str, str]
#: Of each machine, condition and method: a row for each seed.
Table = dict[Key, dict[str, Float[np.ndarray, "seeds E"]]]


def run(
    *,
    out: Path,
    seed: int,
    seeds: int | None,
    episodes: int | None,
    quick: bool,
    workers: int,
    progress: Progress,
    figure: str = "fig3",
    old: Old = "refuse",
) -> dict[str, Any]:
    """Fly the missing cells, check the claims, write the run; returns its summary.

    ``figure`` is drawn first, the other one beside it. Other arguments as for figure 2.
    """
    started = time.perf_counter()
    seeds = seeds or (QUICK_SEEDS if quick else SEEDS)
    episodes = episodes or (QUICK_EPISODES if quick else EPISODES)
    numbers = range(seed, seed + seeds)
    methods = [m for m in METHODS if not (quick and m in NOT_QUICK)]
    groups = {
        (m, c, w): [Cell(m, c, w, n, episodes, quick) for n in numbers]
        for m in MACHINES
        for c in CONDITIONS
        for w in methods
    }
    with new_run(out, f"reproduce {figure}") as writer:
        flown, about = _flown(groups, out, workers=workers, progress=progress, old=old)
        of_key = {k: [flown[cell] for cell in row] for k, row in groups.items()}
        table = {key: _columns(values, episodes) for key, values in of_key.items()}
        early = {key: _beginnings(values) for key, values in of_key.items()}
        summary: dict[str, Any] = {
            "command": f"reproduce {figure}",
            "title": "Figures 3 and 5: exploring for information",
            "figure3": {
                "machines": list(MACHINES),
                "conditions": list(CONDITIONS),
                "methods": methods,
                "episodes": episodes,
                "shown": FIGURES[figure],
            },
            "seed": seed,
            "seeds": seeds,
            "claims": claims(table, early, np.random.default_rng(seed)),
            **about,
            "tables": _tables(table, methods),
            **provenance(started, reproduce(figure, seed, seeds, episodes, quick, old)),
        }
        arrays = _arrays(table, early)
        from sim2gp.reports import figure3, figure_bytes, write_report

        writer.write_summary(summary)
        writer.write_arrays("arrays.npz", arrays)
        for name, shown in FIGURES.items():
            drawn = figure3(arrays, summary, shown)
            writer.write_bytes(f"{name}.png", figure_bytes(drawn, "png"))
        writer.write_text("report.html", write_report(summary, arrays))
    return summary


def _arrays(table: Table, early: Mapping[Key, np.ndarray]) -> dict[str, np.ndarray]:
    """As the figures are drawn from: figure3/MACHINE/CONDITION/METHOD/QUANTITY."""
    arrays = {
        f"figure3/{'/'.join(key)}/{name}": values
        for key, columns in table.items()
        for name, values in columns.items()
    }
    return arrays | {f"figure3/{'/'.join(k)}/early": v for k, v in early.items()}


def _flown(
    groups: Mapping[Key, list[Cell]],
    out: Path,
    *,
    workers: int,
    progress: Progress,
    old: Old,
) -> tuple[dict[Cell, dict[str, Any]], dict[str, Any]]:
    """The values of every cell, and what a summary says of their source (E186)."""
    every = list(chain.from_iterable(groups.values()))
    stages = (list(dict.fromkeys(map(reference, every))), every)

    def alike(cell: Cell) -> Any:
        return cell.machine, cell.method

    # Both figures are drawn from the same cells.
    shared = out.parent / "exploring"
    stored = Cells(shared, exploring.__file__, old)
    named = [(cell.name, cell.arguments) for cell in dict.fromkeys(chain(*stages))]
    stored.check(named)
    work = partial(explore_cell, out=shared, old=old)
    flown = in_stages(stages, work, alike, workers=workers, progress=progress)
    return flown, _told(flown) | stored.summary(named)


def _columns(
    values: list[dict[str, Any]], episodes: int
) -> dict[str, Float[np.ndarray, "seeds E"]]:
    """Each quantity of each seed and episode; NaN where nothing was flown."""
    out = {name: np.full((len(values), episodes), np.nan) for name in QUANTITIES}
    for i, value in enumerate(values):
        for name, column in out.items():
            flown = value.get(name, [])[:episodes]
            column[i, : len(flown)] = flown
    return out


def _beginnings(values: list[dict[str, Any]]) -> Float[np.ndarray, "seeds looks two"]:
    """Transitions and error of the looks into the first episode."""
    looks = max((len(value["early"]) for value in values), default=0)
    out = np.full((len(values), looks, 2), np.nan)
    for i, value in enumerate(values):
        for j, look in enumerate(value["early"]):
            out[i, j] = look["transitions"], look["rmse"]
    return out


def needed(
    early: Float[np.ndarray, "looks two"], rmse: Float[np.ndarray, " E"], error: float
) -> float:
    """Transitions until the error is first at most ``error``; infinite if never.

    Between two looks it is taken to fall as a power of their number.
    """
    later = np.stack([STEPS * np.arange(1.0, len(rmse) + 1), rmse], axis=1)
    looks = np.concatenate([early, later])
    looks = looks[np.isfinite(looks).all(axis=1)]
    for i, (count, value) in enumerate(looks):
        if value <= error:
            if i == 0:
                return float(count)
            before, above = looks[i - 1]
            share = np.log(above / error) / np.log(above / value)
            return float(before * (count / before) ** share)
    return float("inf")


def claims(
    table: Table,
    early: Mapping[Key, Float[np.ndarray, "seeds looks two"]],
    rng: np.random.Generator,
) -> dict[str, dict[str, Any]]:
    """The paper's claims and ours, on paired seeds; a figure beside each verdict."""
    out: dict[str, dict[str, Any]] = {}
    for machine in MACHINES:
        out[f"{machine}_exploring_halves_the_data"] = _halved(
            table, early, rng, machine, "nominal"
        )
        final = {
            m: -_last(table[machine, "mismatch", m]["nll"])
            for m, explorer in METHODS.items()
            if explorer.signal is None
            and explorer.together
            and (machine, "mismatch", m) in table
        }
        for name in ("FS", "RES-FS"):
            out[f"{machine}_{name}_predicts_best_under_mismatch".replace("-", "_")] = (
                at_least_as_good(
                    name,
                    final,
                    rng,
                    f"under mismatch {name} has the lowest final negative log density "
                    "of all explorers (mean nats per transition)",
                )
            )
        up = table[machine, "nominal", "SIM2GP"]
        share = float(np.mean(np.nanmax(up["swung_up"], axis=1) > 0.0))
        most = float(np.median(np.nanmax(up["upright"], axis=1)))
        out[f"{machine}_exploring_alone_swings_up"] = claim(
            share >= 0.5,
            f"{share:.0%} of seeds hold the pole up for a last second; upright for "
            f"{most:.0%} of the best episode (median)",
            "exploring for information alone swings the pole up and keeps it there",
        )
    return out


def _halved(
    table: Table,
    early: Mapping[Key, Float[np.ndarray, "seeds looks two"]],
    rng: np.random.Generator,
    machine: str,
    condition: str,
) -> dict[str, Any]:
    """Transitions to the error that random input has in the end, against its own."""
    one, other = (machine, condition, "SIM2GP"), (machine, condition, "SIM2GP, random")
    text = (
        "without mismatch SIM2GP that explores reaches the final error of SIM2GP with "
        f"random input with at most {SHARE:.0%} of the transitions (median of seeds)"
    )
    ratios = []
    for i, rmse in enumerate(table[other]["rmse"]):
        found = rmse[np.isfinite(rmse)]
        if found.size:  # else random input lost the seed: there is nothing to reach
            mine = needed(early[one][i], table[one]["rmse"][i], float(found[-1]))
            ratios.append(mine / needed(early[other][i], rmse, float(found[-1])))
    if not ratios:
        return claim(False, "no seed on which random input has an error", text)
    median, low, high = of_median(np.asarray(ratios), rng)
    return claim(
        median <= SHARE,
        f"{median:.2f} of its transitions [{low:.2f}, {high:.2f}]",
        text,
    )


def _last(values: Float[np.ndarray, "seeds E"]) -> Float[np.ndarray, " seeds"]:
    """The last number of each seed; infinite where there is none."""
    found = [row[np.isfinite(row)] for row in values]
    return np.asarray([row[-1] if row.size else np.inf for row in found])


def _told(flown: Mapping[Cell, Mapping[str, Any]]) -> dict[str, Any]:
    """What a summary says of its cells: failures and seconds."""
    spent: dict[str, float] = {}
    for cell, value in flown.items():
        if cell.method != "oracle":
            spent[cell.method] = spent.get(cell.method, 0.0) + value["seconds"]
    return {
        "fits_not_converged": [
            f"{cell.name}: {value['failure']}"
            for cell, value in flown.items()
            if value.get("failure")
        ],
        "seconds_of_cells": spent,
    }


def _tables(table: Table, methods: list[str]) -> list[dict[str, Any]]:
    """Medians after the first and the last episode."""
    groups = [(m, c) for m in MACHINES for c in CONDITIONS]
    titles = {
        "rmse": "Error after the first and the last episode (sd of the noise)",
        "nll": "Negative log density after the first and the last episode (nats)",
    }
    out = []
    for name, title in titles.items():
        rows = []
        for method in methods:
            row = [method]
            for group in groups:
                values = table[*group, method][name]
                first, last = np.median(values[:, 0]), np.median(_last(values))
                row.append(f"{first:.2f} to {last:.2f}")
            rows.append(row)
        out.append(
            {
                "title": title,
                "columns": ["learner", *(f"{m}, {c}" for m, c in groups)],
                "rows": rows,
                "note": f"Medians over seeds; {STEPS} transitions an episode.",
            }
        )
    return out
