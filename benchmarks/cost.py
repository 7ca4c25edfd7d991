"""How does the time grow with rows, constants, plans, horizons and features?

    taskset -c 0 python benchmarks/cost.py [--only NAME ...] [--rows N] [--out DIR]

Medians of calls whose programs are compiled already. *Rows*: a fit of a two-link arm in
windows of half a second. *Constants*: a fit of two six-axis arms in one MuJoCo model,
five seconds of log at 200 Hz, with the first so many of 96 constants open. *Sequences*
and *steps* of one plan of MPPI on the cart-pole. *Features* of the last layer of a
neural linear model of the Furuta, fitted again to an episode. Times of `identify` are
those of `many_rows.py`. An exponent is the slope of time against size, both as
logarithms, over the last three sizes.
"""

import argparse
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import servo_arm  # noqa: E402
from many_rows import EACH, logs_of  # noqa: E402
from sim2gp.commands.bench_jobs import plan, random_rows  # noqa: E402
from sim2gp.data.split_log import cut  # noqa: E402
from sim2gp.identification.fit import fit_windows  # noqa: E402
from sim2gp.models import NLM  # noqa: E402
from sim2gp.planning.episode import oracle_world  # noqa: E402
from sim2gp.planning.tasks import cartpole_swingup, furuta_swingup  # noqa: E402
from sim2gp.project import load_project  # noqa: E402
from sim2gp.project.training_windows import cut_logs  # noqa: E402
from sim2gp.systems import Furuta, UniformRodArm  # noqa: E402

Job = tuple[int, Callable[[], object]]
TURNS, LAST = 3, 3  # calls of a size; sizes that an exponent rests on
WINDOW = 0.5  # s, of the two-link arm
SECONDS, JOINTS = 5.0, 12
QUANTITIES = (
    *(f"joint/joint{{}}/{x}" for x in ("damping", "armature", "frictionloss")),
    *(f"body/link{{}}/{x}" for x in ("mass", "com_z", "com_x", "com_y")),
    "actuator/servo{}/kp",
)


def rows(most: int) -> Iterator[Job]:
    """Fits of so many rows, in logs of 2,000."""
    for count in (EACH * 10**k for k in range(5)):
        if count <= most:
            windows, _ = cut(logs_of(count)[1], UniformRodArm(), window=WINDOW)
            yield count, lambda w=windows: _fit(UniformRodArm(), w)


def constants() -> Iterator[Job]:
    """Fits of a log of twelve joints with so many constants open."""
    import mujoco

    paths = [q.format(k) for q in QUANTITIES for k in range(1, JOINTS + 1)]
    with tempfile.TemporaryDirectory() as name:
        folder, model = Path(name), servo_arm.model_text(arms=2)
        (folder / "arm.xml").write_text(model)
        compiled = mujoco.MjModel.from_xml_string(model)
        servo_arm.record(folder / "log.csv", compiled, seconds=SECONDS)
        for count in (5, 10, 20, 40, 80, 96):
            (folder / "arm.toml").write_text(_project(compiled, paths[:count]))
            project = load_project(folder / "arm.toml")
            windows, _ = cut_logs(project, project.load_logs())
            yield count, lambda s=project.system, w=windows: _fit(s, w)


def _project(model: Any, paths: list[str]) -> str:
    """Centres of mass are known to 2 cm; the others have the priors of a draft."""
    each, opened = range(1, JOINTS + 1), ""
    for path in paths:
        _, name, quantity = path.split("/")
        opened += f'[parameters."{path}"]\n'
        if quantity.startswith("com_"):
            mean = model.body(name).ipos["xyz".index(quantity[-1])]
            opened += f"mean = {mean}\nsd = 0.02\n"
    columns = "".join(f'joint{k} = "joint{k}"\nservo{k} = "u{k}"\n' for k in each)
    return (
        f'system = "arm.xml"\n{opened}[likelihood]\nwindow = 1.0\n[[logs]]\n'
        f'files = ["log.csv"]\ntime = "time"\n[logs.columns]\n{columns}'
    )


def _fit(system: Any, windows: Any) -> object:
    return fit_windows(system, windows, key=jax.random.key(0))


def sequences() -> Iterator[Job]:
    """Plans of so many sequences, 50 steps ahead."""
    task = cartpole_swingup()
    for count in (64, 256, 1024, 4096, 16384):
        yield count, plan(oracle_world(task), task, samples=count)


def steps() -> Iterator[Job]:
    """Plans of 1,024 sequences, so many steps ahead."""
    task = cartpole_swingup()
    for count in (12, 25, 50, 100, 200):
        yield count, plan(oracle_world(task), task, horizon=count)


def features() -> Iterator[Job]:
    """Fits of so many features, again, to 250 transitions."""
    data, key = random_rows(furuta_swingup()), jax.random.key(0)
    for count in (16, 32, 64, 128, 256, 512):
        model = NLM(Furuta(), hidden=(128, count - 1))
        belief = model.fit(model.init(key), data, key=key)
        yield count, lambda m=model, b=belief: m.fit(b, data, key=key)


def seconds(work: Callable[[], object]) -> float:
    """The median, after a call that compiles."""
    each = []
    for _ in range(TURNS + 1):
        started = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(work()))
        each.append(time.perf_counter() - started)
    return statistics.median(each[1:])


def exponent(sizes: list[int], times: list[float]) -> float:
    """The slope of the last sizes."""
    x, y = (np.log(np.asarray(z[-LAST:], float)) for z in (sizes, times))
    return float(np.polyfit(x, y, 1)[0])


def of_identify() -> dict[str, Any]:
    """The whole command, by `many_rows.py`: programs are compiled, too."""
    found = json.loads((ROOT / "results" / "many_rows.json").read_text())
    sizes = sorted(int(name) for name in found if name.isdigit())
    times = [found[str(size)]["seconds"] for size in sizes]
    power = exponent(sizes, times)
    return {"sizes": sizes, "seconds": times, "exponent": power}


def draw(curves: dict[str, Any], out: Path) -> None:
    """A panel for each curve, both axes logarithmic."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    figure, axes = plt.subplots(2, 3, figsize=(8.0, 5.0), layout="constrained")
    for axis, (name, curve) in zip(axes.flat, curves.items(), strict=True):
        sizes = curve["sizes"]
        axis.loglog(sizes, curve["seconds"], "o-", color="#1f77b4")
        axis.set_title(f"{name}: exponent {curve['exponent']:.2f}", fontsize=9)
        axis.set_xticks(sizes, [f"{n:,}" for n in sizes], fontsize=7, rotation=30)
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.yaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.yaxis.set_minor_formatter(NullFormatter())
        axis.tick_params(axis="y", labelsize=7)
        axis.set_ylabel("s")
        axis.grid(alpha=0.3)
    figure.savefig(out, dpi=150)


def main() -> None:
    """Time what is asked for; what was timed before stays."""
    parser = argparse.ArgumentParser(description=__doc__)
    made = {f.__name__: f for f in (rows, constants, sequences, steps, features)}
    parser.add_argument("--only", nargs="*", choices=[*made], default=[*made])
    parser.add_argument("--rows", type=int, default=200_000, help="at most")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "cost")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    target = given.out / "summary.json"
    curves = json.loads(target.read_text()) if target.exists() else {}
    for name in given.only:
        jobs = rows(given.rows) if name == "rows" else made[name]()
        found = []
        for size, work in jobs:
            found.append((size, seconds(work)))
            print(f"{name} {size}: {found[-1][1]:.3g} s", flush=True)
        sizes, times = (list(x) for x in zip(*found, strict=True))
        power = exponent(sizes, times)
        curves[name] = {"sizes": sizes, "seconds": times, "exponent": power}
        target.write_text(json.dumps(curves, indent=1) + "\n")
    curves["rows of identify"] = of_identify()
    target.write_text(json.dumps(curves, indent=1) + "\n")
    draw(curves, given.out / "cost.png")


if __name__ == "__main__":
    main()
