"""Figures 3 and 5: error or density against data, a panel per machine and condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.report.figure1 import STYLE
from sim2gp.report.figure2 import LINES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Signals of the same model have its colour; a dash says what was flown.
SIGNALS = {
    "SIM2GP, step by step": ("#0072b2", "--"),
    "SIM2GP, random": ("#0072b2", ":"),
    "SIM2GP, chirp": ("#56b4e9", ":"),
    "SIM2GP, multisine": ("#56b4e9", "-."),
    "RES-FS, random": ("#cc79a7", ":"),
}
LABELS = {
    "rmse": "one-step error (noise sd)",
    "nll": "negative log density (nats)",
}


def figure3(
    arrays: Mapping[str, np.ndarray], summary: Mapping[str, Any], shown: str
) -> "Figure":
    """Median and quartiles over seeds, on data that nobody learned from."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    about = summary["figure3"]
    panels = [(m, c) for m in about["machines"] for c in about["conditions"]]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 5.2), layout="constrained")
        axes = figure.subplots(len(about["machines"]), len(about["conditions"]))
        for (machine, condition), ax in zip(panels, np.ravel(axes), strict=True):
            for method in about["methods"]:
                key = f"figure3/{machine}/{condition}/{method}/{shown}"
                values = np.asarray(arrays[key])
                episode = np.arange(1, values.shape[1] + 1)
                low, middle, high = np.nanquantile(values, [0.25, 0.5, 0.75], axis=0)
                colour, dash = (LINES | SIGNALS).get(method, ("#59636e", "-."))
                ax.plot(episode, middle, dash, color=colour, lw=1.3, label=method)
                ax.fill_between(episode, low, high, color=colour, alpha=0.12, lw=0)
            ax.set(title=f"{machine}, {condition}")
            ax.set_xticks(episode)
            if shown == "rmse":
                ax.set_yscale("log")
        for ax in np.atleast_2d(axes)[-1]:
            ax.set_xlabel("episode (5 s, 250 transitions each)")
        for ax in np.atleast_2d(axes)[:, 0]:
            ax.set_ylabel(LABELS[shown])
        handles, labels = np.ravel(axes)[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=4, frameon=False
        )
    return figure
