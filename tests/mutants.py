"""Errors that the tests must find: each is put into a copy of the package.

    python tests/mutants.py            all of them, a table, exit code 1 if one survives
    python tests/mutants.py prior      those whose name contains "prior"

They are listed in mutants.toml. What they guard is mathematics, security and data.
"""

import ast
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "sim2gp"
TABLE = Path(__file__).with_name("mutants.toml")


def file_of(tests: str) -> Path:
    """The one file of tests with that name, in whatever folder it is."""
    (found,) = (ROOT / "tests").rglob(tests)
    return found


@dataclass(frozen=True)
class Mutant:
    """``old`` becomes ``new`` in ``file``; ``only`` of the ``tests`` must then fail."""

    name: str
    file: str
    old: str
    new: str
    tests: str
    only: str = ""

    def apply(self, package: Path) -> None:
        """Patch a copy of the package; it must still be Python."""
        path = package / self.file
        source = path.read_text()
        if source.count(self.old) != 1:
            raise LookupError(f"{self.name}: found {source.count(self.old)} times")
        changed = source.replace(self.old, self.new)
        ast.parse(changed)
        path.write_text(changed)

    def fails(self, package: Path) -> tuple[bool, str]:
        """Whether the tests fail on this copy of the package, and which one first."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
        command += [str(file_of(self.tests)), "--durations=0", "--durations-min=1000"]
        command += ["--tb=no", *(["-k", self.only] if self.only else [])]
        path = os.pathsep.join([str(package.parent), os.environ.get("PYTHONPATH", "")])
        env = os.environ | {"PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"}
        done = subprocess.run(
            command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=900
        )
        if done.returncode not in (0, 1):  # nothing collected, or pytest itself failed
            raise RuntimeError(f"{self.tests}: pytest {done.returncode}\n{done.stdout}")
        lines = done.stdout.splitlines()
        failed = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
        what = failed[0].split("::")[1].split(" - ")[0] if failed else ""
        return done.returncode == 1, what


MUTANTS = tuple(Mutant(**row) for row in tomllib.loads(TABLE.read_text())["mutant"])


def copy_of_the_package(folder: str) -> Path:
    skip = shutil.ignore_patterns("__pycache__")
    return Path(shutil.copytree(PACKAGE, Path(folder) / "sim2gp", ignore=skip))


def survivors(mutants: Iterable[Mutant]) -> list[str]:
    """Test each mutant, print a line for each, and name those that survive."""
    mutants, alive = list(mutants), []
    with tempfile.TemporaryDirectory() as folder:
        package = copy_of_the_package(folder)
        for each in {(m.tests, m.only): m for m in mutants}.values():
            if each.fails(package)[0]:
                raise RuntimeError(f"{each.tests} fails without any mutant")
    print(f"{'mutant':46} {'verdict':9} {'s':>4}  by")
    for mutant in mutants:
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            package = copy_of_the_package(folder)
            mutant.apply(package)
            killed, by = mutant.fails(package)
        seconds = time.monotonic() - start
        verdict = "killed" if killed else "SURVIVED"
        print(f"{mutant.name:46} {verdict:9} {seconds:4.0f}  {by}", flush=True)
        alive += [] if killed else [mutant.name]
    print(f"{len(mutants) - len(alive)} of {len(mutants)} killed")
    return alive


def main(words: list[str]) -> int:
    """Exit code 1 if a mutant survives."""
    chosen = [m for m in MUTANTS if not words or any(w in m.name for w in words)]
    return 1 if survivors(chosen) else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
