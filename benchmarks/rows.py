"""What twice the rows cost: `identify` of the arm's six logs, and of twelve.

    python benchmarks/rows.py [DATA]

DATA is the folder with ``double_pendulum``. The six recordings are copied under other
names for the twelve. Both are fitted warm (compiled before) in turn, and each counts by
its fastest of three; the ratio of the fit alone is the goal, that of the whole command
is given with it.
"""

import argparse
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax

from real_arm import ROOT, say, verdict

RATIO = 2.2
TURNS = 3


def main() -> None:
    """Print rows and warm seconds of both, and the verdict."""
    from sim2gp.commands.identify import identify
    from sim2gp.identification.fit import fit_windows
    from sim2gp.project import load_project
    from sim2gp.project.training_windows import cut_logs
    from sim2gp.runs import Progress

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", nargs="?", type=Path, default=ROOT / "../shared/data")
    files = sorted(
        (parser.parse_args().data / "double_pendulum/excitation").glob("*.csv")
    )
    key = jax.random.key(0)
    works: dict[str, Callable[[], object]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for times in (1, 2):
            path = project_of(folder / f"{times}", files, times)
            project = load_project(path)
            logs = project.load_logs()
            windows, _ = cut_logs(project, logs)
            rows = sum(len(log) for log in logs)
            say(f"{6 * times} logs: {rows} rows, {len(windows)} windows")
            works[f"fit, {6 * times} logs"] = lambda p=project, w=windows: (
                jax.block_until_ready(fit_windows(p.system, w, key=key).posterior)
            )
            works[f"identify, {6 * times} logs"] = lambda p=project, n=times: identify(
                p, progress=Progress(quiet=True)
            ).save(folder / f"run{n}")
        seconds = warm(works)
    for name, fastest in seconds.items():
        say(f"{name:20} {fastest:6.2f} s, warm")
    for what in ("identify", "fit"):
        ratio = seconds[f"{what}, 12 logs"] / seconds[f"{what}, 6 logs"]
        goal = f"{what}: twice the rows cost at most {RATIO} times"
        verdict(goal, f"{ratio:.2f}", ratio <= RATIO)


def project_of(folder: Path, files: list[Path], times: int) -> Path:
    """The arm's project over ``times`` copies of each file."""
    folder.mkdir()
    for file in files:
        for copy in range(times):
            shutil.copy(file, folder / f"{file.stem}_{copy}{file.suffix}")
    text = (ROOT / "examples/double_pendulum.toml").read_text()
    where = "../../shared/data/double_pendulum/excitation"
    path = folder / "project.toml"
    path.write_text(text.replace(where, folder.as_posix()))
    return path


def warm(works: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Seconds of each, the fastest turn after one that compiles."""
    for work in works.values():
        work()
    taken: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(TURNS):
        for name, work in works.items():
            start = time.perf_counter()
            work()
            taken[name].append(time.perf_counter() - start)
    return {name: min(times) for name, times in taken.items()}


if __name__ == "__main__":
    main()
