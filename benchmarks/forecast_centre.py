"""Where forecasts start from: the MAP, or the mean of the corrected posterior.

    python benchmarks/forecast_centre.py [PROJECT...]

Fits the first half of each project's recordings and forecasts the others, open loop.
Default: both examples, whose recordings are in ``../shared/data``. Prints the root mean
square error of each channel at some horizons, for both centres.
"""

import argparse
from pathlib import Path

import jax
import numpy as np

from sim2gp.data.grid import CURVE, evaluation_windows, steps_of
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts.prediction import (
    channels,
    forecast_grid,
    recording_names,
)
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.project import load_project
from sim2gp.project.training_windows import cut_logs
from sim2gp.types import in_float64

EXAMPLES = Path(__file__).parents[1] / "examples"
HORIZONS = (0.2, 0.5)


@in_float64
def compare(path: Path) -> list[str]:
    """A line for each centre and horizon."""
    project = load_project(path)
    logs, system = project.load_logs(), project.system
    files = list(dict.fromkeys(recording_names(logs)))
    first = files[: (len(files) + 1) // 2]
    known = [log for log in logs if log.source in first]
    others = [log for log in logs if log.source not in first]
    windows, of = cut_logs(project, known)
    robust = project.spec.likelihood.robust
    belief = fit_windows(system, windows, key=jax.random.key(0), robust=robust)
    known = belief.with_measurements(system.parameters)
    likelihood = WindowsLikelihood(system, windows)
    wide = corrected_windows(at_zero(likelihood, known, of)).posterior
    grid = evaluation_windows(others, system, longest=CURVE[-1])
    lines = []
    for name, posterior in (("MAP", belief.posterior), ("corrected mean", wide)):
        found = forecast_grid(system, posterior, grid, HORIZONS[0])
        for horizon in HORIZONS:
            errors = found.at(np.asarray([steps_of(horizon)])).rmse()[0]
            each = zip(channels(system, windows), errors, strict=True)
            words = "  ".join(f"{channel} {error:.4f}" for channel, error in each)
            lines.append(f"{project.name:16} {name:15} {horizon:g} s  {words}")
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    both = [EXAMPLES / "double_pendulum.toml", EXAMPLES / "qube.toml"]
    parser.add_argument("projects", nargs="*", type=Path, default=both)
    for path in parser.parse_args().projects:
        print("\n".join(compare(path)), flush=True)


if __name__ == "__main__":
    main()
