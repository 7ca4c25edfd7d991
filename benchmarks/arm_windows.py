"""How long windows of an arm with servos should be.

    python benchmarks/arm_windows.py [--seeds N] [--out DIR]

The arm and logs of `arm_and_sysid.py`, the delay learned: the median relative error of
its 22 constants, and how many of their intervals hold the truth, by windows' length.
"""

import argparse
import json
import statistics
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from arm_and_sysid import OPEN, ROOT, judged, write

from commands import MAIN, timed

DELAY = 0.01  # s
#: Seconds of log, and of windows.
LENGTHS = {5.0: (0.5, 1.0, 2.5, 5.0), 30.0: (0.2, 0.5, 1.0, 2.5, 5.0, 7.5)}


def cell(seconds: float, window: float, seed: int) -> dict[str, Any]:
    """One machine, its log in windows of one length."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder, seconds, seed, DELAY, window)
        took = timed(folder, [*MAIN, "identify", "arm.toml", "--quick", "--out", "run"])
        summary = json.loads((folder / "run" / "summary.json").read_text())
    said = {"seconds": seconds, "window": window, "seed": seed, "cpu": took["cpu"]}
    return said | judged(seed, summary)


def table(rows: list[dict[str, Any]]) -> str:
    """Medians over seeds, as Markdown."""
    lines = ["| log | windows | median error | inside |", "|---|---|---|---|"]
    for seconds, window in dict.fromkeys((r["seconds"], r["window"]) for r in rows):
        mine = [r for r in rows if (r["seconds"], r["window"]) == (seconds, window)]
        error = statistics.median(r["median_error"] for r in mine)
        inside = sum(r["inside"] for r in mine)
        lines.append(
            f"| {seconds:.0f} s | {window:g} s | {error:.3f} "
            f"| {inside} of {len(OPEN) * len(mine)} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Run the cells, two at a time, and write one table of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    given = parser.parse_args()
    cells = [
        (seconds, window, seed)
        for seconds, windows in LENGTHS.items()
        for window in windows
        for seed in range(given.seeds)
    ]
    with ThreadPoolExecutor(2) as pool:
        rows = list(pool.map(lambda x: cell(*x), cells))
    given.out.mkdir(exist_ok=True)
    (given.out / "arm_windows.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
