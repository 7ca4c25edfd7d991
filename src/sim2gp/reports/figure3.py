"""Figures 3 and 5: error or density against data, a panel per machine and condition."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.reports.panels import panels

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
        from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

        if shown == "rmse":
            ax.set_yscale("log")
            plain = FuncFormatter(lambda x, _: f"{x:g}")
            low, high = ax.get_ylim()
            ax.yaxis.set_major_formatter(plain)
            ax.yaxis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
            few = high < 300.0 * low  # too few decades to be read without more numbers
            ax.yaxis.set_minor_formatter(plain if few else NullFormatter())
        else:
            # One learner's upper quartile, of hundreds, would flatten all others.
            medians = np.concatenate([line.get_ydata() for line in ax.lines])
            low, high = np.nanmin(medians), np.nanmax(medians)
            ax.set_ylim(low - 0.1 * (high - low), high + 0.1 * (high - low))

    return panels(
        summary["figure3"],
        lambda *of: np.asarray(arrays[f"figure3/{'/'.join(of)}/{shown}"]),
        finish,
        height=5.2,
        xlabel="episode (5 s, 250 transitions each)",
        ylabel=LABELS[shown],
    )
