"""The Qube: fit four recordings, predict the fifth, all five ways round.

    python benchmarks/qube.py [DATA] [--horizon S] [--run DIR]

DATA is the folder with ``qube``. Prints the error of `sim2gp evaluate
examples/qube.toml` and a plain seven-number least-squares fit (the tests' oracle,
which shares no code with the package), the held state and a linear regression.
"""

import argparse
import math
from pathlib import Path

import numpy as np

from real_arm import ROOT, column, plain, protocol, say, table, verdict

ANGLES = ("theta", "alpha")
RATIO = 1.02


def main() -> None:
    """Print the table and the verdict."""
    from sim2gp.commands.evaluate import evaluate
    from sim2gp.project import load_project
    from sim2gp.runs import Progress

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT / "../shared/data")
    parser.add_argument("--horizon", type=float, default=0.1)
    parser.add_argument("--run", type=Path, default=Path("runs/qube"))
    options = parser.parse_args()
    files, horizon = sorted((options.data / "qube").glob("*.csv")), options.horizon
    logs = [protocol.on_grid(protocol.read_qube(f)) for f in files]
    rest = [logs[:k] + logs[k + 1 :] for k in range(len(logs))]
    errors: dict[str, list[np.ndarray]] = {
        "least squares": [
            protocol.errors(
                plain.bound(plain.qube_acceleration, plain.fit_qube(train)),
                log,
                horizon,
            )
            for train, log in zip(rest, logs, strict=True)
        ],
        "held": [plain.hold_errors(log, horizon) for log in logs],
        "regression": [
            plain.regression_errors(train, log, horizon)
            for train, log in zip(rest, logs, strict=True)
        ],
    }
    project = load_project(ROOT / "examples" / "qube.toml")
    found = evaluate(project, horizon=horizon, progress=Progress())
    found.save(options.run)
    summary = found.summary
    by_log = table(summary, "Error at")
    mine = {name: column(by_log, name) for name in ANGLES}
    say("", f"error at {horizon:g} s, rad (theta / alpha)")
    for k, file in enumerate([*files, None]):
        row = "pooled" if file is None else file.stem
        cells = ["sim2gp " + "/".join(f"{mine[a][row]:.4f}" for a in ANGLES)]
        for name, each in errors.items():
            e = protocol.pooled_rms(each) if file is None else protocol.rms(each[k])
            cells.append(f"{name} {e[0]:.4f}/{e[1]:.4f}")
        say(f"{row[:20]:20s} " + "  ".join(cells))
    say("")
    other = protocol.pooled_rms(errors["least squares"])
    ratio = [mine[a]["pooled"] / float(other[i]) for i, a in enumerate(ANGLES)]
    holds = math.isfinite(sum(ratio)) and max(ratio) <= RATIO
    figure = f"{ratio[0]:.3f} and {ratio[1]:.3f}"
    verdict("at most 1.02 times plain least squares, pooled", figure, holds)


if __name__ == "__main__":
    main()
