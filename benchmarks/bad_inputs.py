"""How long a bad input takes to be refused: each in a process of its own, from start.

    python benchmarks/bad_inputs.py [NUMBER ...]

Prints the slowest ones; the bar is 2 s on an idle machine. What takes longer is timed
twice more and its least time counts: a machine that others use adds seconds, and takes
none away. Inputs whose door is Python, and those that need a patched child process, are
left out.
"""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import pytest  # noqa: E402

from sim2gp.errors import Sim2GPError  # noqa: E402
from tests.catalogue.bad_files import THIRD  # noqa: E402
from tests.catalogue.bad_inputs import Input  # noqa: E402
from tests.catalogue.bad_logs import FIRST  # noqa: E402
from tests.catalogue.bad_projects import SECOND  # noqa: E402
from tests.catalogue.bad_tables import TABLES  # noqa: E402

CALL = "import sys; from sim2gp.cli import main; sys.exit(main(sys.argv[1:]))"
BAR = 2.0  # s
AGAIN = 2


def seconds(given: Input) -> float | None:
    """Of the command, start of the interpreter included; None where it is not one."""
    with (
        tempfile.TemporaryDirectory() as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.chdir(folder)
        try:
            words = given.make(Path(folder), patch)
        except Sim2GPError:
            return None
        if words is None:
            return None
        started = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", CALL, *words], capture_output=True, text=True
        )
        took = time.perf_counter() - started
        return took if done.stderr.startswith(given.code) else None


def main() -> int:
    """Times every input, or those of some numbers."""
    asked = [int(word) for word in sys.argv[1:]]
    found = []
    for bad in (*FIRST, *TABLES, *SECOND, *THIRD):
        if asked and bad.number not in asked:
            continue
        for i, given in enumerate(bad.inputs):
            took = seconds(given) if given.code[:1] == "E" else None
            if took is not None:
                found.append((took, f"{bad.number} {bad.title} [{i}]", given))
    at_first = sum(took > BAR for took, *_ in found)
    for k, (took, name, given) in enumerate(found):
        if took > BAR:
            again = (seconds(given) for _ in range(AGAIN))
            found[k] = min([took, *(x for x in again if x)]), name, given
    found.sort(reverse=True, key=lambda each: each[0])
    for took, name, _ in found[:15]:
        print(f"{took:5.2f} s  {name}")
    late = sum(took > BAR for took, *_ in found)
    print(f"{len(found)} inputs, {at_first} over {BAR:g} s at first, {late} in the end")
    return 1 if late else 0


if __name__ == "__main__":
    raise SystemExit(main())
