"""A run directory back into its report, from summary.json and arrays.npz alone."""

from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.cleanup import replace_file
from sim2gp.reports.document import write_report
from sim2gp.runs import store

REPORT = "report.html"


def load_summary(run_dir: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary and arrays of a finished run (E130, E183, E185 if it is not one)."""
    run = store.load_run(run_dir)
    return run.summary, run.arrays


def redraw(run_dir: str | Path) -> Path:
    """Write report.html again from what the run stored, and return its path.

    The manifest keeps the checksum of the first report; a run's reader checks only what
    a report is drawn from.
    """
    summary, arrays = load_summary(run_dir)
    path = Path(run_dir) / REPORT
    try:
        replace_file(path, write_report(summary, arrays).encode())
    except OSError as error:
        raise store.disk_error(path, error) from error
    return path
