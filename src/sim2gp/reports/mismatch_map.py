"""The mismatch map: each learner's score under each effect, as shades."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.reports.figure1 import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def mismatch_map(
    arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
) -> "Figure":
    """Median score of the last episode; 1 is the oracle, 0 a pole left hanging."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    about = summary["mismatch"]
    rows, columns = about["conditions"], about["methods"]
    score = np.asarray(
        [[_last_median(arrays[f"mismatch/{r}/{c}"]) for c in columns] for r in rows]
    )
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 0.9 + 0.3 * len(rows)), layout="constrained")
        ax = figure.add_subplot()
        ax.imshow(score, cmap="YlGnBu", vmin=0.0, vmax=1.2, aspect="auto")
        for i, j in np.ndindex(score.shape):
            color = "white" if score[i, j] > 0.75 else "#1f2328"
            ax.text(j, i, f"{score[i, j]:.2f}", ha="center", va="center", color=color)
        ax.set_xticks(range(len(columns)), columns, rotation=30, ha="left")
        ax.xaxis.tick_top()
        ax.set_yticks(range(len(rows)), [r.replace("_", " ") for r in rows])
        ax.tick_params(length=0)
    return figure


def _last_median(score: np.ndarray) -> float:
    """The median of the last episode; an episode that was not run scores nothing."""
    last = np.where(np.isfinite(score[:, -1]), score[:, -1], 0.0)
    return float(np.median(last))
