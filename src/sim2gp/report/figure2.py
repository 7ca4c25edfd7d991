"""Figure 2: best-seen score against episode, a panel per machine and condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.report.figure1 import STYLE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Colours that differ in lightness as well, and a dash for what is not the paper's.
LINES = {
    "SIM2GP": ("#0072b2", "-"),
    "point estimate": ("#56b4e9", "--"),
    "NLM": ("#8b949e", "-"),
    "RES": ("#009e73", "-"),
    "FS literal": ("#e69f00", "-"),
    "FS": ("#d55e00", "--"),
    "RES-FS": ("#cc79a7", "--"),
    "Auto": ("#8a5a00", "-."),
    "SIM2GP with the term": ("#1b1f24", ":"),
}


def figure2(arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> "Figure":
    """Median and quartiles over seeds; 1 is the oracle, 0 a pole left hanging."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    about = summary["figure2"]
    panels = [(m, c) for m in about["machines"] for c in about["conditions"]]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 4.6), layout="constrained")
        axes = figure.subplots(len(about["machines"]), len(about["conditions"]))
        for (machine, condition), ax in zip(panels, np.ravel(axes), strict=True):
            for method in about["methods"]:
                score = np.asarray(arrays[f"figure2/{machine}/{condition}/{method}"])
                flown = np.where(np.isfinite(score), score, -np.inf)
                best = np.maximum(np.maximum.accumulate(flown, axis=1), 0.0)
                low, middle, high = np.quantile(best, [0.25, 0.5, 0.75], axis=0)
                episode = np.arange(1, best.shape[1] + 1)
                colour, dash = LINES.get(method, ("#59636e", "-."))
                ax.plot(episode, middle, dash, color=colour, lw=1.3, label=method)
                ax.fill_between(episode, low, high, color=colour, alpha=0.12, lw=0)
            ax.axhline(0.95, color="#59636e", lw=0.6, ls=(0, (1, 2)))
            ax.set(title=f"{machine}, {condition}")
            ax.set_ylim(-0.03, max(1.05, ax.get_ylim()[1]))  # an oracle can be beaten
            ax.set_xticks(episode)
        for ax in np.atleast_2d(axes)[-1]:
            ax.set_xlabel("episode (5 s each)")
        for ax in np.atleast_2d(axes)[:, 0]:
            ax.set_ylabel("best score so far")
        handles, labels = np.ravel(axes)[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=4, frameon=False
        )
    return figure
