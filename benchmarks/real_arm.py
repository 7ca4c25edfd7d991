"""The real arm, one log left out at a time: sim2gp and what else one could use.

    python benchmarks/real_arm.py [DATA] [--horizon S] [--run DIR]

DATA is the folder with ``double_pendulum/excitation``. Prints, per log and joint, the
error of `sim2gp evaluate examples/double_pendulum.toml`, of a plain nine-number
least-squares fit and of the published models, the ratios, and whether the project's
own goals hold. That fit and its protocol are the tests' oracles, which share no
code with the package; the package's errors are pooled by the package.
"""

import argparse
import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from oracles import log_protocol as protocol  # noqa: E402
from oracles import plain_least_squares as plain  # noqa: E402

JOINTS = ("q1", "q2")
RATIO, BETTER, BELOW, COVERED = 0.90, 5, (0.25, 0.45), (0.85, 0.97)


def published(path: Path) -> list[float]:
    """The ten numbers of the plain model from a published parameter file."""
    text = path.read_text()
    v = {k: float(x) for k, x in re.findall(r"^(\w+): ([-\d.e]+)", text, re.MULTILINE)}
    first, second = v["m1"] * v["r1"], v["m2"] * v["r2"]
    rest = [v[k] for k in ("b1", "b2", "cf1", "cf2", "Ir")]
    return [first, v["I1"], v["m2"], second, v["I2"], *rest]


def errors_of(models: list[np.ndarray], logs: list[Any], horizon: float) -> list[Any]:
    """Errors of each log under its own model, by the tests' protocol."""
    return [
        protocol.errors(plain.bound(plain.arm_acceleration, p), log, horizon)
        for p, log in zip(models, logs, strict=True)
    ]


def ours(horizon: float, folder: Path) -> dict[str, Any]:
    """Leave one log out by the package's own command."""
    from sim2gp.commands.evaluate import evaluate
    from sim2gp.project import load_project
    from sim2gp.runs import Progress

    project = load_project(ROOT / "examples" / "double_pendulum.toml")
    found = evaluate(project, horizon=horizon, progress=Progress())
    found.save(folder)
    return found.summary


def table(summary: dict[str, Any], title: str) -> dict[str, Any]:
    """A table of a summary by the beginning of its title."""
    return next(t for t in summary["tables"] if t["title"].startswith(title))


def column(found: dict[str, Any], name: str) -> dict[str, float]:
    """One column of a table as numbers, by the row's first cell."""
    i = found["columns"].index(name)
    return {row[0]: float(row[i]) for row in found["rows"]}


def say(*lines: str) -> None:
    """Lines on stdout."""
    sys.stdout.write("\n".join(lines) + "\n")


def verdict(what: str, figure: str, holds: bool) -> None:
    """One goal, its figure, and whether it holds."""
    say(f"{'holds' if holds else 'FAILS':6s} {what}: {figure}")


def main() -> None:
    """Print the tables and the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT / "../shared/data")
    parser.add_argument("--horizon", type=float, default=0.2)
    parser.add_argument("--run", type=Path, default=Path("runs/real-arm"))
    options = parser.parse_args()
    arm, horizon = options.data / "double_pendulum", options.horizon
    files = sorted((arm / "excitation").glob("*.csv"))
    logs = [protocol.on_grid(protocol.read_arm(f)) for f in files]
    fits = [plain.fit_arm(logs[:k] + logs[k + 1 :]) for k in range(len(logs))]
    errors = {"least squares": errors_of(fits, logs, horizon)}
    for file in sorted((arm / "published_parameters").glob("*.yml")):
        same = [np.asarray(published(file))] * len(logs)
        errors[file.stem.removeprefix("c1_")] = errors_of(same, logs, horizon)
    summary = ours(horizon, options.run)
    by_log = table(summary, "Error at")
    mine = {j: column(by_log, j) for j in JOINTS}
    say("", f"error at {horizon:g} s, rad (joint 1 / joint 2); ratio to least squares")
    ratios: list[list[float]] = []
    for k, file in enumerate([*files, None]):
        row = "pooled" if file is None else file.stem
        own = [mine[j][row] for j in JOINTS]
        cells = [f"sim2gp {own[0]:.4f}/{own[1]:.4f}"]
        for name, each in errors.items():
            e = protocol.pooled_rms(each) if file is None else protocol.rms(each[k])
            cells.append(f"{name} {e[0]:.4f}/{e[1]:.4f}")
            if name == "least squares":
                ratio = [own[i] / float(e[i]) for i in range(2)]
                cells.append(f"ratio {ratio[0]:.3f}/{ratio[1]:.3f}")
                ratios += [ratio] if file is not None else []
        say(f"{row:10s} " + "  ".join(cells))
    say("", summary["tables"][0]["title"])
    for line in (by_horizon := table(summary, "Error and coverage"))["rows"]:
        say("  ".join(f"{cell:>8s}" for cell in line))
    say("columns: " + ", ".join(by_horizon["columns"]), "")
    each = [math.sqrt(a * b) for a, b in ratios]
    mean = math.exp(float(np.mean(np.log(ratios))))
    verdict("geometric mean of the ratios at most .90", f"{mean:.3f}", mean <= RATIO)
    better = sum(r < 1.0 for r in each)
    both = sum(max(r) < 1.0 for r in ratios)
    verdict(
        "better in at least 5 of 6 logs",
        f"{better} by the mean of both joints, {both} in both joints",
        better >= BETTER,
    )
    pooled = {n: protocol.pooled_rms(e) for n, e in errors.items() if "model" in n}
    for i, joint in enumerate(JOINTS):
        best = min(float(e[i]) for e in pooled.values())
        gain = 1.0 - mine[joint]["pooled"] / best
        wanted = f"{100 * BELOW[i]:.0f} % below the best published model, {joint}"
        verdict(wanted, f"{100 * gain:.1f} %", gain >= BELOW[i])
    for joint in JOINTS:
        share = column(by_horizon, f"{joint} in 90 %")
        low, high = min(share.values()), max(share.values())
        inside = COVERED[0] <= low and high <= COVERED[1]
        what = f"coverage of nominal 90 %, {joint}, all horizons"
        verdict(what, f"{low:.3f} to {high:.3f}", inside)


if __name__ == "__main__":
    main()
