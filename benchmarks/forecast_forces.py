"""Do forecasts get forces where there are none, and those that are there?

    python benchmarks/forecast_forces.py [--sets N] [--out FILE]

Arms of `interval_arms.py`, ten seconds each in windows of .2 s, as `sim2gp identify`
fits them. For each kind of error, how many arms' forecasts have which kinds of force
(`sim2gp.identification.missing_physics.held_out_gain`).
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import jax
import numpy as np

from interval_arms import CONDITIONS, recordings
from sim2gp.data.split_log import cut
from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.identification.fit import fit_windows
from sim2gp.identification.forecasts.forecast_machine import fit_forecast_machine
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.types import in_float64

CHUNK = 20
KINDS = ("white", "ar80", "ar95", "friction20", "sharp20", "cogging10")


@in_float64
def kinds(name: str, sets: int) -> Counter[str]:
    """How many arms have which forces, as words."""
    condition, found = CONDITIONS[name], Counter[str]()
    for s in range(sets):
        data = recordings(condition, CHUNK, s // CHUNK)
        system = condition.system()
        windows, _ = cut([data.log(s % CHUNK)], system, window=0.2)
        fitted = fit_windows(system, windows, key=jax.random.key(s), starts=1)
        one = np.zeros(len(windows), int)
        start = at_zero(WindowsLikelihood(system, windows), fitted, one)
        machine = fit_forecast_machine(start, one)
        found[", ".join(sorted(machine.scales)) or "none"] += 1
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=40)
    parser.add_argument(
        "--out", type=Path, default=Path("results/forecast_forces.json")
    )
    asked = parser.parse_args()
    found = {}
    for name in KINDS:
        found[name] = dict(kinds(name, asked.sets).most_common())
        print(f"{CONDITIONS[name].title:48} {found[name]}", flush=True)
    text = json.dumps({"sets": asked.sets, "forces": found}, indent=1)
    asked.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
