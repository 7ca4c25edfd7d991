"""A run directory back into its report: summary.json and arrays.npz are all it needs."""

import json
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.errors import InputError
from sim2gp.report.document import write_report


def load_run(run_dir: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Summary and arrays of a run; E161 if the folder does not hold a readable run.

    A run without arrays.npz is a run without drawings, and no error.
    """
    folder = Path(run_dir)
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            "E161",
            "no readable summary.json",
            where=str(folder),
            got=type(error).__name__,
            expected="the folder of a finished run",
            fix="give the --out folder of an earlier command",
        ) from error
    path = folder / "arrays.npz"
    if not path.exists():
        return summary, {}
    try:
        with np.load(path, allow_pickle=False) as stored:
            return summary, {key: stored[key] for key in stored.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise InputError(
            "E161",
            "arrays.npz cannot be read",
            where=str(path),
            got=type(error).__name__,
            expected="the arrays of this run",
            fix="run the command again",
        ) from error


def redraw(run_dir: str | Path) -> Path:
    """Write report.html anew from what the run stored, and return its path."""
    summary, arrays = load_run(run_dir)
    path = Path(run_dir) / "report.html"
    _write(path, write_report(summary, arrays))
    return path


def _write(path: Path, text: str) -> None:
    """Write aside and rename: a reader sees the old report or the new, never half."""
    handle, aside = tempfile.mkstemp(dir=path.parent, prefix=".report-")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="\n") as file:
            file.write(text)
        os.chmod(aside, 0o644)
        os.replace(aside, path)
    except BaseException:
        os.unlink(aside)
        raise
