"""The mismatch map: each learner's score under each effect, as shades."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.reports.figure1 import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def mismatch_map(
    arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]
) -> "Figure":
    """Median best score of two episodes; 1 is the oracle, 0 a pole left hanging."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    about = summary["mismatch_map"]
    conditions, methods = about["conditions"], about["methods"]
    heights = [len(rows) for rows in conditions.values()]
    with mpl.rc_context(STYLE):
        size = 5.4, 1.4 + 0.26 * sum(heights)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(
            len(heights), squeeze=False, gridspec_kw={"height_ratios": heights}
        )
        for ax, (machine, rows) in zip(axes[:, 0], conditions.items(), strict=True):
            scores = [
                [
                    _median(arrays, f"mismatch/{machine}/{row}/{m}", about["episodes"])
                    for m in methods
                ]
                for row in rows
            ]
            _shades(ax, np.asarray(scores), rows)
            ax.set_ylabel(machine)
        names = [name.replace("SIM2GP with", "with") for name in methods]
        axes[0, 0].set_xticks(range(len(methods)), names, rotation=40, ha="left")
    return figure


def _median(arrays: Mapping[str, np.ndarray], name: str, episodes: int) -> float:
    """Over seeds; not a number where a learner was not asked."""
    score = arrays.get(name)
    if score is None:
        return float("nan")
    first = np.asarray(score)[:, :episodes]
    best = np.max(np.where(np.isfinite(first), first, 0.0), axis=1)
    return float(np.median(best))


def _shades(
    ax: "Axes", score: Float[np.ndarray, "rows columns"], rows: Sequence[str]
) -> None:
    """Scores of one machine; effects are set apart from each other."""
    ax.imshow(score, cmap="RdYlBu", vmin=0.2, vmax=1.4, aspect="auto")
    for (i, j), x in np.ndenumerate(score):
        text = "" if np.isnan(x) else f"{x:.2f}".replace("0.", ".")
        ink = "white" if x < 0.35 else "black"
        ax.text(j, i, text, ha="center", va="center", fontsize=8.5, color=ink)
    effects = [row.split()[0] for row in rows]
    for i in range(1, len(rows)):
        if effects[i] != effects[i - 1]:
            ax.axhline(i - 0.5, color="white", lw=3.0)
    ax.xaxis.tick_top()
    ax.set_xticks([])
    ax.set_yticks(range(len(rows)), [row.replace("_", " ") for row in rows])
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
