"""One self-contained HTML file per run, drawn from summary.json and arrays.npz alone.

Nothing here is computed again: a report shows what the run stored. Figures for papers
and README files are drawn by the same rooms (`figure1`, `animation_gif`).
"""

from sim2gp.reports.animation import animation_gif, animation_png
from sim2gp.reports.document import write_report
from sim2gp.reports.figure1 import arm_drawing, figure1, figure_bytes
from sim2gp.reports.figure2 import figure2
from sim2gp.reports.figure3 import figure3
from sim2gp.reports.mismatch_map import mismatch_map
from sim2gp.reports.notebook import show
from sim2gp.reports.redraw import load_summary, redraw

__all__ = [
    "animation_gif",
    "animation_png",
    "arm_drawing",
    "figure1",
    "figure2",
    "figure3",
    "figure_bytes",
    "load_summary",
    "mismatch_map",
    "redraw",
    "show",
    "write_report",
]
