"""Panels of a study: median and quartiles over seeds, by machine and condition."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.reports.figure1 import STYLE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    "MissingForces": ("#b30059", "-"),
    "Auto": ("#8a5a00", "-."),
    "SIM2GP with the term": ("#1b1f24", ":"),
    "off-policy oracle": ("#1b1f24", "-"),
    "domain randomisation": ("#8b949e", ":"),
    # Signals of the same model have its colour; the dash shows which signal was run.
    "SIM2GP, step by step": ("#0072b2", "--"),
    "SIM2GP, random": ("#0072b2", ":"),
    "SIM2GP, chirp": ("#56b4e9", ":"),
    "SIM2GP, multisine": ("#56b4e9", "-."),
    "RES-FS, random": ("#cc79a7", ":"),
}
OTHERS = ("#59636e", "-.")


def panels(
    about: Mapping[str, Any],
    values: Callable[[str, str, str], Float[np.ndarray, "seeds E"]],
    finish: Callable[["Axes"], None],
    *,
    height: float,
    xlabel: str,
    ylabel: str,
) -> "Figure":
    """A panel per machine (row) and condition (column), a line per method.

    ``values(machine, condition, method)`` are drawn against episode; NaN is left out.
    ``finish`` sees each panel when its lines are there.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    rows, columns = about["machines"], about["conditions"]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(7.2, height), layout="constrained")
        axes = figure.subplots(len(rows), len(columns), squeeze=False)
        for ax, (machine, condition) in zip(
            axes.flat, [(m, c) for m in rows for c in columns], strict=True
        ):
            for method in about["methods"]:
                shown = values(machine, condition, method)
                low, middle, high = np.nanquantile(shown, [0.25, 0.5, 0.75], axis=0)
                episode = np.arange(1, shown.shape[1] + 1)
                colour, dash = LINES.get(method, OTHERS)
                ax.plot(episode, middle, dash, color=colour, lw=1.3, label=method)
                ax.fill_between(episode, low, high, color=colour, alpha=0.12, lw=0)
            ax.set(title=f"{machine}, {condition}")
            ax.set_xticks(episode)
            finish(ax)
        for ax in axes[-1]:
            ax.set_xlabel(xlabel)
        for ax in axes[:, 0]:
            ax.set_ylabel(ylabel)
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=4, frameon=False
        )
    return figure
