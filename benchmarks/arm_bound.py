"""How well the arm of `arm_and_sysid.py` can be known, its delay known or not.

    python benchmarks/arm_bound.py [--seeds N] [--out DIR]

The information of the same logs at the true constants (the Cramer-Rao bound), with
encoders of 1e-3 rad, unknown starts and this program's priors. A constant whose error
is normal with that sd is off by .67 of it in half of all cases; the table has the
median of that over the 22 constants, then over seeds, next to the errors that
`arm_and_sysid.py` has measured. Windows of 1 s have a start each, the whole log has
one. Writes `arm_bound.json` and prints a table.
"""

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]
import servo_arm  # noqa: E402
from arm_and_sysid import truth, write  # noqa: E402
from sim2gp.data.split_log import cut  # noqa: E402
from sim2gp.data.windows_likelihood import WindowsLikelihood, information_at  # noqa: E402
from sim2gp.inference.arrowhead import Noise  # noqa: E402
from sim2gp.project import load_project  # noqa: E402
from sim2gp.project.draft_text import window_of  # noqa: E402
from sim2gp.types import in_float64  # noqa: E402

HALF = 0.6744897501960817  # of an sd: what half of all normal errors exceed
DELAY = 0.01  # s


@in_float64
def errors(seconds: float, seed: int, window: float) -> dict[str, float]:
    """The median error to be expected, where the delay is learned and where given."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, seconds, seed, DELAY)
        project = load_project(folder / "arm.toml")
        logs = project.load_logs()
    system, table = project.system, project.system.parameters
    windows, _ = cut(logs, system, window=window)
    true = truth(seed)
    (late,) = (k for k, name in enumerate(table.names) if name not in true)
    theta = np.asarray([true.get(name, DELAY) for name in table.names])
    tt = np.asarray(table.unconstrain(jnp.asarray(theta)))
    likelihood = WindowsLikelihood(system, windows)
    prior = table.prior()
    ones, e = jnp.ones(len(windows)), jnp.zeros(windows.start.shape)
    noise = Noise(jnp.full(len(windows.outputs), servo_arm.ENCODER), ones)
    A = np.asarray(information_at(likelihood, _Known(e, noise, prior))(tt))
    rows = np.concatenate([A, np.eye(len(theta))])  # the data's and the prior's
    scale = np.asarray(prior.scale).diagonal() * table.slopes(tt)[0] / theta
    others = [k for k in range(len(theta)) if k != late]

    def median(kept: list[int]) -> float:
        R = np.linalg.qr(rows[:, kept], mode="r")
        root = np.linalg.solve(R, np.eye(len(kept)))
        sd = np.linalg.norm(root, axis=1) * scale[kept]
        return HALF * float(np.median(sd[[kept.index(k) for k in others]]))

    return {"learned": median(list(range(len(theta)))), "given": median(others)}


class _Known:
    """What `information_at` reads of a fit: starts, noise and prior."""

    def __init__(self, nuisances: Any, noise: Noise, prior: Any) -> None:
        self.nuisances, self.noise, self.prior = nuisances, noise, prior


def table(rows: list[dict[str, Any]]) -> str:
    """Medians over seeds, as Markdown."""
    lines = ["| log | windows | delay learned | delay given |", "|---|---|---|---|"]
    for seconds, window in dict.fromkeys((r["seconds"], r["window"]) for r in rows):
        mine = [r for r in rows if (r["seconds"], r["window"]) == (seconds, window)]
        cut_ = "the whole log" if window == seconds else f"{window:g} s"
        middle = (
            statistics.median(r[name] for r in mine) for name in ("learned", "given")
        )
        cells = " | ".join(f"{x:.3f}" for x in middle)
        lines.append(f"| {seconds:.0f} s | {cut_} | {cells} |")
    return "\n".join(lines)


def main() -> None:
    """The bounds of all logs, written down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    given = parser.parse_args()
    rows = [
        {"seconds": seconds, "window": window, "seed": seed}
        | errors(seconds, seed, window)
        for seconds in (5.0, 30.0)
        for window in (window_of(seconds), seconds)
        for seed in range(given.seeds)
    ]
    given.out.mkdir(exist_ok=True)
    (given.out / "arm_bound.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
