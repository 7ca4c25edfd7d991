"""Figures 3 and 5: error or density against data, a panel per machine and condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.report.panels import panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LABELS = {
    "rmse": "one-step error (noise sd)",
    "nll": "negative log density (nats)",
}


def figure3(
    arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any], shown: str
) -> "Figure":
    """Median and quartiles over seeds, on data that nobody learned from."""

    def finish(ax: "Axes") -> None:
        if shown == "rmse":
            ax.set_yscale("log")

    return panels(
        summary["figure3"],
        lambda *of: np.asarray(arrays[f"figure3/{'/'.join(of)}/{shown}"]),
        finish,
        height=5.2,
        xlabel="episode (5 s, 250 transitions each)",
        ylabel=LABELS[shown],
    )
