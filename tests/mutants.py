"""Faults that the tests must see: each is put into a copy of the package and hunted.

    python tests/mutants.py            all of them, a table, exit code 1 if one survives
    python tests/mutants.py prior      those whose name contains "prior"

The lists are in the files `mutant_*.py` beside this one.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from mutant_configurations import CONFIGURATIONS
from mutant_descent import DESCENTS
from mutant_design import DESIGN
from mutant_draft import FIRST_DRAFT
from mutant_effects import EFFECTS
from mutant_exploring import EXPLORING
from mutant_inputs import INPUTS
from mutant_interop import INTEROP
from mutant_intervals import INTERVALS
from mutant_list import MUTANTS as PHYSICS
from mutant_list import Hunt, Mutant
from mutant_logs import LOGS
from mutant_misfit import MISFIT
from mutant_mujoco import ON_THE_HOST
from mutant_networks import NETWORKS
from mutant_sac import OFF_POLICY
from mutant_slopes import SLOPES_OF_STEPS
from mutant_studies import STUDIES

MUTANTS = (
    *PHYSICS,
    *DESCENTS,
    *NETWORKS,
    *MISFIT,
    *STUDIES,
    *EXPLORING,
    *DESIGN,
    *FIRST_DRAFT,
    *EFFECTS,
    *OFF_POLICY,
    *ON_THE_HOST,
    *SLOPES_OF_STEPS,
    *LOGS,
    *INPUTS,
    *INTEROP,
    *INTERVALS,
    *CONFIGURATIONS,
)

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "sim2gp"


def hunt(package: Path, hunt: Hunt) -> tuple[bool, str]:
    """Whether the tests fail on this copy of the package, and the first that does."""
    name, only = hunt
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
    command += [f"tests/{name}", "--durations=0", "--durations-min=1000", "--tb=no"]
    command += ["-k", only] if only else []
    path = os.pathsep.join([str(package.parent), os.environ.get("PYTHONPATH", "")])
    env = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900
    )
    if done.returncode not in (0, 1):  # nothing collected, or pytest itself failed
        raise RuntimeError(
            f"{name}: pytest ended with {done.returncode}\n{done.stdout}"
        )
    failed = [line for line in done.stdout.splitlines() if line.startswith("FAILED")]
    failed += [line for line in done.stdout.splitlines() if line.startswith("ERROR")]
    what = failed[0].split("::")[1].split(" - ")[0] if failed else ""
    return done.returncode == 1, what


def copy_of_the_package(folder: str) -> Path:
    skip = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(PACKAGE, Path(folder) / "sim2gp", ignore=skip))


def survivors(mutants: Iterable[Mutant]) -> list[str]:
    """Hunt each mutant, print a line for each, and name those that live."""
    mutants, alive = list(mutants), []
    with tempfile.TemporaryDirectory() as folder:
        package = copy_of_the_package(folder)
        for healthy in sorted({m.hunt for m in mutants}):
            if hunt(package, healthy)[0]:
                raise RuntimeError(f"{healthy} fails without any mutant")
    print(f"{'mutant':38} {'verdict':9} {'s':>4}  by")
    for mutant in mutants:
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            package = copy_of_the_package(folder)
            mutant.apply(package)
            killed, by = hunt(package, mutant.hunt)
        seconds = time.monotonic() - start
        verdict = "killed" if killed else "SURVIVED"
        print(f"{mutant.name:38} {verdict:9} {seconds:4.0f}  {by}", flush=True)
        alive += [] if killed else [mutant.name]
    print(f"{len(mutants) - len(alive)} of {len(mutants)} killed")
    return alive


def main(words: list[str]) -> int:
    """Exit code 1 if a mutant survives."""
    chosen = [m for m in MUTANTS if not words or any(w in m.name for w in words)]
    return 1 if survivors(chosen) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
