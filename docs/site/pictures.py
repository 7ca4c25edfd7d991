"""Pictures in docs/ that replace long tables, drawn from results/.

    python docs/site/pictures.py

Each is as wide as a phone's page, and its table is linked below it. The same results
give the same bytes, for one version of matplotlib.
"""

import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim2gp.reports.panels import LINES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
WIDTH = 5.0  # inches: letters of 9 points can be read on a phone
STYLE = {
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "sim2gp",
    "axes.spines.top": False,
    "axes.spines.right": False,
}
GRID = {"color": "#d0d7de", "lw": 0.6}
#: Methods of the interval study: its name for them, ours, colour.
METHODS = [
    ("plain", "plain", "#8b949e"),
    ("scatter", "corrected for noise alone", "#56b4e9"),
    ("chosen", "corrected (reported)", "#0072b2"),
    ("oracle", "oracle", "#1b1f24"),
    ("sysid", "mujoco.sysid", "#d55e00"),
]
MARKS = {"m1": "o", "b1": "^", "m2": "s", "b2": "v"}
CONDITIONS = {
    "white": "white noise",
    "ar80": "coloured noise (AR .8)",
    "ar95": "coloured noise (AR .95)",
    "friction5": "small dry friction is missing",
    "friction20": "large dry friction is missing",
    "sharp20": "the same, five times as sharp",
    "cogging10": "cogging is missing",
}
TERM = "SIM2GP with the term"
EPISODES = [
    ("nominal, SIM2GP", "SIM2GP"),
    ("nominal, NLM", "NLM"),
    ("mismatch, RES", "RES, spring"),
    ("mismatch, RES-FS", "RES-FS, spring"),
    ("mismatch, FS", "FS, spring"),
    (f"mismatch, {TERM}", "with the term, spring"),
]


def main() -> None:
    """Draw all pictures into docs/images."""
    import matplotlib as mpl

    with mpl.rc_context(STYLE):
        drawn = {
            "intervals": intervals(read("intervals/summary.json")),
            "within_episode": within_episode(read("within_episode/scores.json")),
            "session": session(read("session/arms.json")),
        }
        for name, figure in drawn.items():
            file = IMAGES / f"{name}.svg"
            figure.savefig(file, metadata={"Date": None}, facecolor="white")
            # One line ending, and none at the ends of lines, as everywhere here.
            text = re.sub(r"[ \t]+$", "", file.read_text("utf-8"), flags=re.MULTILINE)
            file.write_text(text, encoding="utf-8")


def read(name: str) -> Any:
    """A result that is checked in."""
    return json.loads((ROOT / "results" / name).read_text(encoding="utf-8"))


def blank(height: float) -> "Figure":
    """An empty figure, so high in inches."""
    from matplotlib.figure import Figure

    return Figure((WIDTH, height), layout="constrained")


def intervals(found: dict[str, Any]) -> "Figure":
    """How often nominal 95 % intervals hold the truth, by error, method, parameter."""
    figure = blank(8.2)
    ax = figure.subplots()
    ax.axvspan(0.92, 0.98, color="#dafbe1", lw=0)
    ticks, points, marks, y = [], [], MARKS.items(), 0
    for key, title in CONDITIONS.items():
        ax.text(0.0, y, title, weight="bold", va="center")
        for method, _, colour in METHODS:
            y += 1
            cells = found["conditions"][key]["methods"][method]
            ticks.append((y, method))
            points += [(m, colour, y, cells[name]["coverage"]) for name, m in marks]
        y += 2
    for _, mark in marks:
        for _, _, colour in METHODS:
            at = [(x, y) for m, c, y, x in points if (m, c) == (mark, colour)]
            ax.plot(*np.transpose(at), mark, color=colour, ms=5, mfc="none")
    names = {method: words for method, words, _ in METHODS}
    ax.set_yticks([y for y, _ in ticks], [names[m] for _, m in ticks], fontsize=7.5)
    ax.set(xlim=(-0.02, 1.01), ylim=(y - 1, -1))
    ax.set_xticks([0, 0.25, 0.5, 0.75, 0.95])
    ax.set_xlabel("share of 200 arms whose true value is inside")
    ax.grid(axis="x", **GRID)
    for name, mark in marks:
        ax.plot([], [], mark, color="#59636e", mfc="none", ms=5, label=name)
    where = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0)}
    ax.legend(ncols=len(MARKS), frameon=False, handletextpad=0.2, **where)
    return figure


def within_episode(found: dict[str, Any]) -> "Figure":
    """The best score so far against the episode, learning between or within them."""
    figure = blank(5.4)
    axes = figure.subplots(3, 2, sharex=True, sharey=True)
    for ax, (key, title) in zip(axes.flat, EPISODES, strict=True):
        for every, words, dash in (
            ("episode", "between episodes", "--"),
            ("50", "every second", "-"),
        ):
            score = np.asarray(found["scores"][f"{key}, {every}"])
            best = np.median(np.maximum.accumulate(score, axis=1), axis=0)
            colour = LINES[key.split(", ")[1]][0]
            ax.plot(range(1, len(best) + 1), best, dash, color=colour, label=words)
        ax.axhline(0.95, **GRID)
        ax.set_title(title, fontsize=9)
        ax.set_xticks(range(1, 6))
    axes[0, 0].legend(frameon=False, loc="lower right", fontsize=8)
    figure.supxlabel("episode of 5 s", fontsize=9)
    figure.supylabel("best score so far, median of 5", fontsize=9)
    return figure


def session(found: list[dict[str, Any]]) -> "Figure":
    """The session's error over the multisine's, arm by arm."""

    def rms(row: dict[str, Any], which: str) -> float:
        return float(np.sqrt(np.mean(np.square(row[which]))))

    figure = blank(2.6)
    ax = figure.subplots()
    for which, mark, words in (
        ("as_many", "o", "multisine, as many seconds"),
        ("more", "^", "multisine, twice the seconds"),
    ):
        ratio = sorted(rms(row, "session") / rms(row, which) for row in found)
        ax.plot(range(1, len(ratio) + 1), ratio, mark, mfc="none", ms=5, label=words)
    ax.axhline(1.0, color="#59636e", lw=1)
    ax.set(yscale="log", xlabel="arms, sorted", ylabel="error of the session\n/ other")
    ax.set_yticks([0.25, 0.5, 1, 2], ["1/4", "1/2", "1", "2"])
    ax.minorticks_off()
    ax.set_xticks([1, 5, 10, 15, 20])
    ax.grid(axis="y", **GRID)
    ax.legend(frameon=False, fontsize=8)
    return figure


if __name__ == "__main__":
    main()
