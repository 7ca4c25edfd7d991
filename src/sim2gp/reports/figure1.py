"""Figure 1: two data sets of a two-link arm, and what each of them teaches.

(a) the arm over both data sets; (b) the first data set under draws of the prior and of
the first posterior; (c) the second under the first and the second posterior; (d) the
three beliefs in virtual space, with the truth. Without draws, (b) and (c) show the
marginal densities of the two beliefs they compare.
"""

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from sim2gp.reports.scenes import two_link_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Summary = Mapping[str, Any]
Arrays = Mapping[str, np.ndarray]

#: Colour and words of each belief; the colours differ in lightness as well.
STAGES = {
    "prior": ("#8b949e", "prior"),
    "posterior1": ("#d55e00", "posterior 1"),
    "posterior2": ("#0072b2", "posterior 2"),
}
_INK, _SOFT = "#1b1f24", "#59636e"
_FIRST, _SECOND = "#0072b2", "#d55e00"
STYLE = {
    "font.size": 8.0,
    "axes.linewidth": 0.7,
    "axes.edgecolor": _SOFT,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "mathtext.fontset": "dejavusans",
    "svg.hashsalt": "sim2gp",
    "svg.fonttype": "path",
}


def arm_drawing(
    axes: "Axes",
    state: Float[np.ndarray, "T n"],
    lengths: Sequence[float],
    *,
    vertical: bool = False,
    poses: int = 14,
) -> None:
    """Draw the arm over a recording: earlier poses paler, with the path of its tip."""
    l1, l2 = (float(length) for length in lengths)
    elbow, tip = two_link_points(np.asarray(state), (l1, l2), vertical=vertical)
    axes.plot(tip[:, 0], tip[:, 1], color=_SOFT, lw=0.5, alpha=0.45, zorder=1)
    rows = np.unique(np.linspace(0, len(state) - 1, poses).astype(int))
    for order, row in enumerate(rows):
        strength = 0.10 + 0.90 * (order / max(len(rows) - 1, 1)) ** 2
        style: dict[str, Any] = {
            "alpha": strength, "solid_capstyle": "round", "zorder": 2 + order
        }  # fmt: skip
        (x1, y1), (x2, y2) = elbow[row], tip[row]
        axes.plot([0, x1], [0, y1], color=_FIRST, lw=3.0, **style)
        axes.plot([x1, x2], [y1, y2], color=_SECOND, lw=2.2, **style)
        joint = {"color": _INK, "alpha": strength, "zorder": 2 + order}
        axes.plot([x1], [y1], "o", ms=2.4, **joint)
    axes.plot([0], [0], "o", color=_INK, ms=5, zorder=40)
    axes.set_aspect("equal", anchor="W")
    axes.set_axis_off()


def _belief_moments(arrays: Arrays, stage: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean (p,) and covariance (p, p) of one belief in virtual space."""
    mean = np.asarray(arrays[f"figure1/{stage}/mean"], dtype=float)
    scale = np.asarray(arrays[f"figure1/{stage}/scale"], dtype=float)
    return mean, scale @ scale.T


def _axis_range(arrays: Arrays, index: int) -> tuple[float, float]:
    """The axis of one virtual parameter: the prior's bulk and the truth."""
    mean, cov = _belief_moments(arrays, "prior")
    sd = np.sqrt(cov[index, index])
    low, high = mean[index] - 2.6 * sd, mean[index] + 2.6 * sd
    truth = arrays.get("figure1/truth")
    if truth is not None:
        low, high = min(low, truth[index] - sd / 4), max(high, truth[index] + sd / 4)
    return float(low), float(high)


def marginal(axes: "Axes", arrays: Arrays, index: int, stages: Sequence[str]) -> None:
    """Marginal densities of one virtual parameter, each scaled to its peak."""
    low, high = _axis_range(arrays, index)
    for stage in stages:
        mean, cov = _belief_moments(arrays, stage)
        sd = float(np.sqrt(cov[index, index]))
        near = mean[index] + sd * np.linspace(-5, 5, 201)
        at = np.unique(np.clip(np.r_[np.linspace(low, high, 201), near], low, high))
        height = np.exp(-0.5 * ((at - mean[index]) / sd) ** 2)
        colour = STAGES[stage][0]
        axes.fill_between(at, height, color=colour, alpha=0.22, lw=0)
        # The prior's line is broad: it shows beneath a posterior that equals it.
        axes.plot(at, height, color=colour, lw=2.6 if stage == "prior" else 1.1)
    truth = arrays.get("figure1/truth")
    if truth is not None:
        axes.axvline(float(truth[index]), color=_INK, lw=0.9, ls=(0, (3, 2)))
    axes.set_xlim(low, high)
    axes.set_ylim(0, 1.12)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)


def pair(axes: "Axes", arrays: Arrays, i: int, j: int, stages: Sequence[str]) -> None:
    """Ellipses of one and two standard deviations of parameters i (x) and j (y)."""
    angle = np.linspace(0, 2 * np.pi, 121)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for stage in stages:
        mean, cov = _belief_moments(arrays, stage)
        block = cov[np.ix_([i, j], [i, j])]
        root = np.linalg.cholesky(block)
        colour = STAGES[stage][0]
        for size, alpha in ((2.0, 0.18), (1.0, 0.30)):
            x, y = mean[[i, j], None] + size * root @ circle
            axes.fill(x, y, facecolor=colour, alpha=alpha, lw=0)
            axes.plot(x, y, color=colour, lw=2.2 if stage == "prior" else 0.8)
    truth = arrays.get("figure1/truth")
    if truth is not None:
        axes.plot([truth[i]], [truth[j]], "+", color=_INK, ms=6, mew=1.1, zorder=9)
    axes.set_xlim(*_axis_range(arrays, i))
    axes.set_ylim(*_axis_range(arrays, j))


def _prediction(
    axes: "Axes", arrays: Arrays, data: str, row: int, dt: float, stages: Sequence[str]
) -> None:
    """One joint over a data set: the recording and what draws of each belief do."""
    measured = arrays[f"figure1/{data}/state"][:, row]
    time = dt * np.arange(len(measured))
    for stage in stages:
        draws = arrays.get(f"figure1/{data}/draws/{stage}")
        if draws is None:
            continue
        colour = STAGES[stage][0]
        paths = np.asarray(draws, dtype=float)[:, :, row]
        low, high = np.quantile(paths, [0.05, 0.95], axis=0)
        steps = time[: paths.shape[1]]
        axes.fill_between(steps, low, high, color=colour, alpha=0.22, lw=0)
        for path in paths[:5]:
            axes.plot(steps, path, color=colour, lw=0.6, alpha=0.7)
    axes.plot(time, measured, color=_INK, lw=1.0, ls=(0, (4, 1.5)))
    low, high = float(measured.min()), float(measured.max())
    pad = 0.6 * (high - low) or 0.5
    axes.set_xlim(0, time[-1])
    axes.set_ylim(low - pad, high + pad)


def _parameter_labels(summary: Summary) -> list[str]:
    """Names of the virtual parameters, with a tilde."""
    short = {"mass": "m", "damping": "b"}
    names = []
    for name in summary["figure1"]["names"]:
        stem = str(name).rstrip("0123456789")
        digits = str(name)[len(stem) :]
        letter = short.get(stem, stem)
        plain = len(letter) == 1
        names.append(rf"$\tilde{{{letter}}}_{{{digits}}}$" if plain else str(name))
    return names


def _compare(
    figure: "Figure", grid: Any, arrays: Arrays, summary: Summary,
    data: str, stages: Sequence[str], title: str,
) -> None:  # fmt: skip
    """Panel (b) or (c): two beliefs on one data set."""
    about = summary["figure1"]
    drawn = any(f"figure1/{data}/draws/{stage}" in arrays for stage in stages)
    if drawn:
        state = arrays[f"figure1/{data}/state"]
        rows = [row for row in (0, 1) if np.ptp(state[:, row]) > 1e-6]
        inner = grid.subgridspec(1, len(rows), wspace=0.32)
        for column, row in enumerate(rows):
            axes = figure.add_subplot(inner[column])
            _prediction(axes, arrays, data, row, float(about.get("dt", 0.02)), stages)
            axes.set_xlabel("time, s", labelpad=1)
            axes.set_ylabel(rf"$q_{row + 1}$, rad", labelpad=1)
            if column == 0:
                axes.set_title(title, loc="left", fontsize=8.5)
        return
    names = _parameter_labels(summary)
    inner = grid.subgridspec(1, len(names), wspace=0.12)
    for index, name in enumerate(names):
        axes = figure.add_subplot(inner[index])
        marginal(axes, arrays, index, stages)
        axes.set_xlabel(name, labelpad=1)
        if index == 0:
            axes.set_title(title, loc="left", fontsize=8.5)


def _corner(figure: "Figure", grid: Any, arrays: Arrays, summary: Summary) -> None:
    """Panel (d): all marginals and pairs in virtual space."""
    names = _parameter_labels(summary)
    count = len(names)
    stages = [stage for stage in STAGES if f"figure1/{stage}/mean" in arrays]
    inner = grid.subgridspec(count, count, wspace=0.10, hspace=0.10)
    for i in range(count):
        for j in range(i + 1):
            axes = figure.add_subplot(inner[i, j])
            if i == j:
                marginal(axes, arrays, i, stages)
            else:
                pair(axes, arrays, j, i, stages)
            if i == count - 1:
                axes.set_xlabel(names[j], labelpad=1)
            else:
                axes.set_xticklabels([])
            if j == 0 and i > 0:
                axes.set_ylabel(names[i], labelpad=1)
            elif i != j:
                axes.set_yticklabels([])
            if i == j == 0:
                axes.set_title("(d) virtual parameters", loc="left", fontsize=8.5)
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=STAGES[stage][0], lw=3, label=STAGES[stage][1])
        for stage in stages
    ]
    if "figure1/truth" in arrays:
        mark = {"marker": "+", "ls": (0, (3, 2)), "lw": 0.9}
        handles.append(Line2D([], [], color=_INK, label="truth", **mark))
    corner = figure.add_subplot(inner[0, count - 1])
    corner.set_axis_off()
    corner.legend(handles=handles, loc="upper right", frameon=False, fontsize=8)


def figure1(arrays: Arrays, summary: Summary) -> "Figure":
    """Figure 1 of the paper, panels (a) to (d); see the module's docstring."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    about = summary["figure1"]
    lengths = about.get("lengths", (0.5, 0.4))
    vertical = bool(about.get("vertical", False))
    with rc_context(STYLE):
        figure = Figure(figsize=(10.6, 5.6), facecolor="white")
        outer = figure.add_gridspec(
            1, 2, width_ratios=(1.0, 1.08), wspace=0.14,
            left=0.045, right=0.985, top=0.945, bottom=0.085,
        )  # fmt: skip
        left = outer[0].subgridspec(3, 1, height_ratios=(1.7, 1, 1), hspace=0.45)
        arms = left[0].subgridspec(1, 2, wspace=0.02)
        titles = ("(a) data set 1: second link alone", "data set 2: both links")
        drawings = []
        for column, title in enumerate(about.get("titles", titles)):
            axes = figure.add_subplot(arms[column])
            drawings.append(axes)
            state = arrays[f"figure1/data{column + 1}/state"]
            arm_drawing(axes, state, lengths, vertical=vertical)
            axes.set_title(title, loc="left", fontsize=8.5)
        # One scale for both drawings: the same arm must look the same.
        x = [end for axes in drawings for end in axes.get_xlim()]
        y = [end for axes in drawings for end in axes.get_ylim()]
        for axes in drawings:
            axes.set_xlim(min(x), max(x))
            axes.set_ylim(min(y), max(y))
        _compare(
            figure, left[1], arrays, summary, "data1", ("prior", "posterior1"),
            "(b) data set 1: prior and posterior 1",
        )  # fmt: skip
        _compare(
            figure, left[2], arrays, summary, "data2", ("posterior1", "posterior2"),
            "(c) data set 2: posterior 1 and 2",
        )  # fmt: skip
        _corner(figure, outer[1], arrays, summary)
    return figure


def figure_bytes(figure: "Figure", kind: str = "svg", dpi: float = 160.0) -> bytes:
    """The figure as a file ("svg", "png" or "pdf") without dates or random names."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    file = io.BytesIO()
    FigureCanvasAgg(figure)
    dated = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
    with rc_context(STYLE):
        figure.savefig(file, format=kind, dpi=dpi, metadata=dated.get(kind, {}))
    return file.getvalue()
