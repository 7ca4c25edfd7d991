"""Figures 2 and 4: best-seen score against episode, by machine and condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.reports.panels import panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure2(arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> "Figure":
    """Median and quartiles over seeds; 1 is the oracle, 0 a pole left hanging."""

    def best(machine: str, condition: str, method: str) -> np.ndarray:
        score = np.asarray(arrays[f"figure2/{machine}/{condition}/{method}"])
        found = np.where(np.isfinite(score), score, -np.inf)
        return np.maximum(np.maximum.accumulate(found, axis=1), 0.0)

    def finish(ax: "Axes") -> None:
        ax.axhline(0.95, color="#59636e", lw=0.6, ls=(0, (1, 2)))
        ax.set_ylim(-0.03, max(1.05, ax.get_ylim()[1]))  # an oracle can be beaten

    return panels(
        summary["figure2"],
        best,
        finish,
        height=4.6,
        xlabel="episode (5 s each)",
        ylabel="best score so far",
    )
