"""Figures 3 and 5: how well models know a machine that they explored for information.

Error and negative log density on a swing-up that nobody learned from, against episode,
for every model with posterior sampling, and for the signals that identification has
always used. One study has the cells of both figures; they differ in what is drawn.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.planning.tasks import MACHINES
from sim2gp.runs.cell_work import AbstractCell, Values
from sim2gp.studies.claims import at_least_as_good, bootstrap_median, claim
from sim2gp.studies.exploring import METHODS, QUANTITIES, Cell
from sim2gp.studies.learners import CONDITIONS
from sim2gp.studies.study import Arrays, Key, Study

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Variants that a quick look does without: what is left fits into six minutes.
NOT_QUICK = ("FS literal", "SIM2GP, step by step", "RES-FS, random")
STEPS = 250  # transitions of an episode, on both machines
FIGURES = {"fig3": "rmse", "fig5": "nll"}
#: Exploring is asked to need at most this share of the transitions of random input.
SHARE = 0.5

#: Of each machine, condition and method: a row for each seed.
Table = dict[Key, dict[str, Float[np.ndarray, "seeds E"]]]


class Exploration(Study):
    """Every explorer on every machine; both figures use the same cells."""

    size = (5, 10)
    quick_size = (1, 2)

    @property
    def methods(self) -> list[str]:
        """The explorers."""
        return [m for m in METHODS if not (self.quick and m in NOT_QUICK)]

    def rows(self) -> dict[Key, list[Cell]]:
        """A row for each machine, condition and explorer."""
        return {
            (m, c, w): [Cell(m, c, w, n, self.episodes, self.quick) for n in self.seeds]
            for m in MACHINES
            for c in CONDITIONS
            for w in self.methods
        }

    def cells_of(self, out: Path) -> Path:
        """Of both figures."""
        return out.parent / "exploring"

    def arrays(self, values: Mapping[AbstractCell, Values]) -> Arrays:
        """``figure3/MACHINE/CONDITION/METHOD/QUANTITY``, and ``.../early``."""
        arrays: Arrays = {}
        for key, row in self.rows().items():
            found = [values[cell] for cell in row]
            place = f"figure3/{'/'.join(key)}"
            for name, column in _episode_columns(found, self.episodes).items():
                arrays[f"{place}/{name}"] = column
            arrays[f"{place}/early"] = _beginnings(found)
        return arrays

    def summary(
        self, arrays: Arrays, values: Mapping[AbstractCell, Values]
    ) -> dict[str, Any]:
        """The claims of both figures."""
        del values
        keys = list(self.rows())
        table = {
            key: {
                name: arrays[f"figure3/{'/'.join(key)}/{name}"] for name in QUANTITIES
            }
            for key in keys
        }
        early = {key: arrays[f"figure3/{'/'.join(key)}/early"] for key in keys}
        return {
            "title": "Figures 3 and 5: exploring for information",
            "figure3": {
                "machines": list(MACHINES),
                "conditions": list(CONDITIONS),
                "methods": self.methods,
                "episodes": self.episodes,
                "shown": FIGURES[self.name],
            },
            "claims": exploration_claims(table, early, self.rng),
            "tables": _median_tables(table, self.methods),
        }

    def pictures(
        self, arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
    ) -> "dict[str, Figure]":
        """Both figures."""
        from sim2gp.reports import figure3

        return {name: figure3(arrays, summary, x) for name, x in FIGURES.items()}


def _episode_columns(
    values: Sequence[Values], episodes: int
) -> dict[str, Float[np.ndarray, "seeds E"]]:
    """Each quantity of each seed and episode; NaN where nothing was run."""
    out = {name: np.full((len(values), episodes), np.nan) for name in QUANTITIES}
    for i, value in enumerate(values):
        for name, column in out.items():
            found = value.get(name, [])[:episodes]
            column[i, : len(found)] = found
    return out


def _beginnings(values: Sequence[Values]) -> Float[np.ndarray, "seeds looks two"]:
    """Transitions and error of the looks into the first episode."""
    looks = max((len(value["early"]) for value in values), default=0)
    out = np.full((len(values), looks, 2), np.nan)
    for i, value in enumerate(values):
        for j, look in enumerate(value["early"]):
            out[i, j] = look["transitions"], look["rmse"]
    return out


def transitions_needed(
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


def exploration_claims(
    table: Table,
    early: Mapping[Key, Float[np.ndarray, "seeds looks two"]],
    rng: np.random.Generator,
) -> dict[str, dict[str, Any]]:
    """The paper's claims and ours, on paired seeds; a number with each verdict."""
    out: dict[str, dict[str, Any]] = {}
    for machine in MACHINES:
        out[f"{machine}_exploring_halves_the_data"] = _halved(
            table, early, rng, machine, "nominal"
        )
        final = {
            m: -_last_values(table[machine, "mismatch", m]["nll"])
            for m, explorer in METHODS.items()
            if explorer.signal is None
            and explorer.together
            and (machine, "mismatch", m) in table
        }
        for name in ("FS", "RES-FS", "MissingForces"):
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
            mine = transitions_needed(
                early[one][i], table[one]["rmse"][i], float(found[-1])
            )
            ratios.append(
                mine / transitions_needed(early[other][i], rmse, float(found[-1]))
            )
    if not ratios:
        return claim(False, "no seed on which random input has an error", text)
    median, low, high = bootstrap_median(np.asarray(ratios), rng)
    return claim(
        median <= SHARE,
        f"{median:.2f} of its transitions [{low:.2f}, {high:.2f}]",
        text,
    )


def _last_values(values: Float[np.ndarray, "seeds E"]) -> Float[np.ndarray, " seeds"]:
    """The last number of each seed; infinite where there is none."""
    found = [row[np.isfinite(row)] for row in values]
    return np.asarray([row[-1] if row.size else np.inf for row in found])


def _median_tables(table: Table, methods: list[str]) -> list[dict[str, Any]]:
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
                first, last = np.median(values[:, 0]), np.median(_last_values(values))
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
