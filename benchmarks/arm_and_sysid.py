"""A six-axis arm with position servos: this program and mujoco.sysid side by side.

    python benchmarks/arm_and_sysid.py [--seconds S ...] [--seeds N] [--delay S]
        [--out DIR]

For each seed the arm's dampings, armatures, dry frictions and four masses are drawn
within a factor of about two of its file, a log is recorded by C MuJoCo (200 Hz,
encoders of 1e-3 rad), and both identify these 22 constants from it, each as a whole
command on one core. This program learns one delay of all drives as well, mujoco.sysid
is given it; ``given`` is this program where it is given it, too. Windows are as long as
`init` has them. Needs `mujoco[sysid]`. Cold: without anything compiled before.
"""

import argparse
import contextlib
import json
import shutil
import statistics
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import servo_arm  # noqa: E402
from commands import MAIN, timed  # noqa: E402
from sim2gp.project.draft_text import window_of  # noqa: E402

#: What is open, and how far the truth lies from the file, in log units.
OPEN = (
    *(f"joint/joint{k}/damping" for k in range(1, 7)),
    *(f"joint/joint{k}/armature" for k in range(1, 7)),
    *(f"joint/joint{k}/frictionloss" for k in range(1, 7)),
    *(f"body/link{k}/mass" for k in range(2, 6)),
)
SPREAD, FACTOR = 0.3, 3.0


def truth(seed: int) -> dict[str, float]:
    """Constants of one arm."""
    rng = np.random.default_rng(seed)
    return {
        path: nominal(path) * float(np.exp(SPREAD * np.clip(rng.normal(), -2.0, 2.0)))
        for path in OPEN
    }


def nominal(path: str) -> float:
    """The file's number."""
    _, name, quantity = path.split("/")
    link = servo_arm.LINKS[int(name[-1]) - 1]
    return float(
        link[{"mass": 0, "damping": 5, "armature": 6, "frictionloss": 7}[quantity]]
    )


def by_sysid(folder: Path, delay: float) -> dict[str, tuple[float, float]]:
    """Value and half of the 95 % interval of each constant, by mujoco.sysid."""
    import mujoco
    from mujoco import sysid

    table = np.loadtxt(folder / "log.csv", delimiter=",", skiprows=1)
    spec = mujoco.MjSpec.from_file(str(folder / "arm.xml"))
    model, time_, period = spec.compile(), table[:, 0], servo_arm.PERIOD
    late = round(delay / period)
    u = table[np.maximum(np.arange(len(table)) - late, 0), 7:]
    joints = [(name, sysid.SignalType.MjStateQPos) for name in servo_arm.NAMES]
    measured = sysid.TimeSeries.from_names(time_, table[:, 1:7], model, joints)
    start = sysid.create_initial_state(model, table[0, 1:7], np.zeros(6))
    control = sysid.TimeSeries(time_, u)
    sequences = sysid.ModelSequences("a", spec, "s", start, control, measured, True)
    residual = sysid.build_residual_fn(models_sequences=[sequences])
    constants = sysid.ParameterDict()
    for path in OPEN:
        x = nominal(path)
        constants.add(
            sysid.Parameter(path, x, x / FACTOR, x * FACTOR, modifier=_change(path))
        )
    with contextlib.redirect_stdout(None):
        found, best = sysid.optimize(constants, residual, verbose=False)
    misfit, _, _ = residual(best.x, found)
    _, half = sysid.calculate_intervals(misfit, np.asarray(best.jac))
    return {
        path: (float(x), float(h))
        for path, x, h in zip(OPEN, best.x, half, strict=True)
    }


def _change(path: str) -> Any:
    kind, name, quantity = path.split("/")

    def modifier(spec: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        if kind == "body":
            body, link = spec.body(name), servo_arm.LINKS[int(name[-1]) - 1]
            body.mass, body.inertia = value, np.asarray(link[2]) * value / link[0]
        elif quantity == "damping":
            spec.joint(name).damping = [value, 0.0, 0.0]
        else:
            setattr(spec.joint(name), quantity, value)

    return modifier


def write(
    folder: Path, seconds: float, seed: int, delay: float, window: float | None = None
) -> None:
    """The arm, its log and its project; ``window`` in s as `init` chooses it."""
    (folder / "arm.xml").write_text(servo_arm.model_text())
    servo_arm.record(
        folder / "log.csv",
        seconds=seconds,
        seed=seed,
        delay=delay,
        values=truth(seed),
    )
    window = window or window_of(seconds)
    project = servo_arm.project_text(["log.csv"], constants=OPEN, window=window)
    (folder / "arm.toml").write_text(project)
    given = project.replace("{low = 0.0, high = 0.03}\ntie = true", f"{delay}")
    (folder / "given.toml").write_text(given)


def cell(seconds: float, seed: int, delay: float, *, cold: bool) -> dict[str, Any]:
    """Both on one log: seconds, errors, and how many intervals hold the truth."""
    with tempfile.TemporaryDirectory() as name:
        folder, cache = Path(name), None if cold else _cache()
        write(folder, seconds, seed, delay)
        out: dict[str, Any] = {"seconds": seconds, "seed": seed, "cold": cold}
        if not cold and seed == 0:  # what is compiled is kept from here on
            _ours(folder, "arm", seed, cache)
            _ours(folder, "given", seed, cache)
        out["ours"] = _ours(folder, "arm", seed, cache)
        if not cold:
            out["given"] = _ours(folder, "given", seed, cache)
        sysid = [str(Path(__file__)), "--sysid", str(folder), "--delay", str(delay)]
        out["sysid"] = timed(folder, sysid, one_core=True)
        theirs = json.loads((folder / "sysid.json").read_text())
        out["sysid"] |= _judged(
            seed, {path: (x, x - h, x + h) for path, (x, h) in theirs.items()}
        )
        return out


def _ours(folder: Path, name: str, seed: int, cache: str | None) -> dict[str, Any]:
    run = [*MAIN, "identify", f"{name}.toml", "--quick", "--out", name]
    first = folder / f"{name}-first" / "summary.json"
    shutil.rmtree(folder / name, ignore_errors=True)
    out: dict[str, Any] = dict(
        timed(folder, run, cache=cache, one_core=True, watched=first)
    )
    summary = json.loads((folder / name / "summary.json").read_text())
    steps = summary["convergence"]["steps"]
    return out | judged(seed, summary) | {"steps": steps}


def judged(seed: int, summary: dict[str, Any]) -> dict[str, Any]:
    """A run's median relative error, and how many intervals hold the truth."""
    found = {
        path: (entry["mean"], entry["q025"], entry["q975"])
        for path, entry in summary["parameters"].items()
        if path in OPEN
    }
    return _judged(seed, found)


def _judged(seed: int, found: dict[str, tuple[float, float, float]]) -> dict[str, Any]:
    true = truth(seed)
    errors = [abs(found[p][0] / true[p] - 1.0) for p in OPEN]
    inside = [found[p][1] <= true[p] <= found[p][2] for p in OPEN]
    return {"median_error": statistics.median(errors), "inside": sum(inside)}


def _cache() -> str:
    folder = Path(tempfile.gettempdir()) / "arm_and_sysid_cache"
    folder.mkdir(exist_ok=True)
    return str(folder)


def table(rows: list[dict[str, Any]]) -> str:
    """Medians over seeds, as Markdown."""
    lines = [
        "| log | program | first answer | posterior | memory | median error | inside |",
        "|---|---|---|---|---|---|---|",
    ]
    who = {
        "ours": "sim2gp, delay learned",
        "given": "sim2gp, delay given",
        "sysid": "mujoco.sysid, delay given",
    }
    for seconds in dict.fromkeys(row["seconds"] for row in rows):
        warm = [r for r in rows if r["seconds"] == seconds and not r["cold"]]
        for name, words in who.items():
            cells = [row[name] for row in warm]
            firsts = [cell["first"] for cell in cells if "first" in cell]
            first = f"{statistics.median(firsts):.1f} s" if firsts else "-"
            walls = [cell["wall"] for cell in cells]
            error = statistics.median(cell["median_error"] for cell in cells)
            inside = sum(cell["inside"] for cell in cells)
            middle, most = statistics.median(walls), max(c["memory"] for c in cells)
            lines.append(
                f"| {seconds:.0f} s | {words} | {first} | {middle:.1f} s "
                f"({min(walls):.1f} to {max(walls):.1f}) | {most / 1024:.1f} GiB "
                f"| {error:.3f} | {inside} of {len(OPEN) * len(cells)} |"
            )
    return "\n".join(lines)


def main() -> None:
    """Run the cells, and write one table of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, nargs="*", default=[5.0, 30.0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--delay", type=float, default=0.01)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    parser.add_argument("--sysid", type=Path, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.sysid:
        found = by_sysid(given.sysid, given.delay)
        (given.sysid / "sysid.json").write_text(json.dumps(found))
        return
    rows = []
    for seconds in given.seconds:
        for seed in range(given.seeds):
            for cold in (True, False) if seed == 0 else (False,):
                rows.append(cell(seconds, seed, given.delay, cold=cold))
                print(json.dumps(rows[-1]), flush=True)
    given.out.mkdir(exist_ok=True)
    (given.out / "arm_and_sysid.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
