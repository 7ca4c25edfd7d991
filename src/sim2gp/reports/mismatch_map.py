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
        figure = Figure(figsize=(5.4, 0.9 + 0.3 * len(rows)), layout="constrained")
        ax = figure.add_subplot()
        ax.imshow(score, cmap="RdYlBu", vmin=0.2, vmax=1.4, aspect="auto")
        for (i, j), x in np.ndenumerate(score):
            text = f"{x:.2f}".replace("0.", ".")
            ink = "white" if x < 0.35 else "black"
            ax.text(j, i, text, ha="center", va="center", fontsize=8.5, color=ink)
        effects = [row.split()[0] for row in rows]
        for i in range(1, len(rows)):
            if effects[i] != effects[i - 1]:
                ax.axhline(i - 0.5, color="white", lw=3.0)
        names = [name.replace("SIM2GP with", "with") for name in columns]
        ax.xaxis.tick_top()
        ax.set_xticks(range(len(columns)), names, rotation=40, ha="left")
        ax.set_yticks(range(len(rows)), [row.replace("_", " ") for row in rows])
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
    return figure


def _last_median(score: np.ndarray) -> float:
    """The median of the last episode; an episode that was not run scores nothing."""
    last = np.where(np.isfinite(score[:, -1]), score[:, -1], 0.0)
    return float(np.median(last))
