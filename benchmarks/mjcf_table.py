"""From an MJCF file and a log to a posterior: how long it takes, by number of joints.

    python benchmarks/mjcf_table.py [NAME ...] [--models FOLDER] [--out DIR]

Arms of 2, 3, 6, 7 and 12 joints with position servos (12: two arms side by side), and
the G1 humanoid of `mjlab` with its base fixed, where that is installed. C MuJoCo
records 10 s at 200 Hz, with encoders of 1e-3 rad. Then `sim2gp init` and `sim2gp
identify --quick` run as whole commands, with what they open by themselves: seconds,
seconds until the first answer is written, the largest memory, and how many of the open
constants have the true value inside their 95 % intervals: the machine that is recorded
has other masses, dampings, armatures and dry frictions than the file. Each model
compiles what the models before it have not. Writes `mjcf_table.json`, prints a table.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "benchmarks")]
from mujoco_slopes import OF_OTHERS, fixed  # noqa: E402

import servo_arm  # noqa: E402
from commands import MAIN, timed  # noqa: E402

ARMS: dict[str, dict[str, Any]] = {
    "2 joints": {"links": servo_arm.LINKS[1:3]},
    "3 joints": {"links": servo_arm.LINKS[:3]},
    "6 joints": {},
    "7 joints": {"links": (*servo_arm.LINKS[:2], servo_arm.ROLL, *servo_arm.LINKS[2:])},
    "12 joints": {"arms": 2},
}
HUMANOID = "29 joints (G1)"


def text_of(name: str, folder: Path) -> str | None:
    """The model as MJCF; None where its package is missing."""
    if name != HUMANOID:
        return servo_arm.model_text(**ARMS[name])
    file = folder / OF_OTHERS["G1, base fixed"]
    if not file.is_file():
        return None
    spec = fixed(file)
    for thing in (*spec.geoms, *spec.meshes, *spec.sensors):
        spec.delete(thing)  # its meshes are not in the folder, its inertias are
    spec.compile()
    text: str = spec.to_xml()
    return text


def drawn(model: Any) -> dict[str, float]:
    """True constants, by path: within a factor of about two of the file's."""
    from sim2gp.systems.mujoco.constants import constants_of

    rng, out = np.random.default_rng(0), {}
    for path, constant in constants_of(model).items():
        if constant.quantity in ("mass", "damping", "armature", "frictionloss"):
            factor = float(np.exp(0.3 * np.clip(rng.normal(), -2.0, 2.0)))
            out[path] = factor * float(constant.get(model))
    return {path: value for path, value in out.items() if value > 0.0}


def write(folder: Path, text: str) -> dict[str, float]:
    """Model and log, whose columns are named as joints and actuators; the truth."""
    import mujoco

    (folder / "robot.xml").write_text(text)
    model = mujoco.MjModel.from_xml_string(text)
    log, true = folder / "log.csv", drawn(model)
    servo_arm.record(log, model, seconds=10.0, values=true)
    head, rest = log.read_text().split("\n", 1)
    names = [model.actuator(k).name for k in range(model.nu)]
    columns = [*head.split(",")[: -model.nu], *names]
    log.write_text(",".join(columns) + "\n" + rest)
    return true


def row(name: str, text: str, cache: str) -> dict[str, Any]:
    """One model, through both commands."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        known = write(folder, text)
        out: dict[str, Any] = {"model": name}
        init = [*MAIN, "init", "robot.xml", "log.csv"]
        out["init"] = timed(folder, init, cache=cache)
        first = folder / "run-first" / "summary.json"
        identify = [*MAIN, "identify", "robot.toml", "--quick", "--out", "run"]
        out["identify"] = timed(folder, identify, cache=cache, watched=first)
        summary = json.loads((folder / "run" / "summary.json").read_text())
        found = {k: v for k, v in summary["parameters"].items() if k in known}
        inside = [v["q025"] <= known[k] <= v["q975"] for k, v in found.items()]
        out |= {"parameters": len(summary["parameters"]), "constants": len(found)}
        return out | {"inside": int(np.sum(inside))}


def table(rows: list[dict[str, Any]]) -> str:
    """As Markdown."""
    lines = [
        "| model | parameters | `init` | first answer | posterior | memory | inside |",
        "|---|---|---|---|---|---|---|",
    ]
    for x in rows:
        fit = x["identify"]
        first = f"{fit['first']:.0f} s" if "first" in fit else "-"
        lines.append(
            f"| {x['model']} | {x['parameters']} | {x['init']['wall']:.0f} s "
            f"| {first} | {fit['wall']:.0f} s | {fit['memory'] / 1024:.1f} GiB "
            f"| {x['inside']} of {x['constants']} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Measure the models asked for, and write them down."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=[*ARMS, HUMANOID])
    parser.add_argument("--models", type=Path, default=Path())
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as cache:
        rows = []
        for name in given.names:
            if (text := text_of(name, given.models)) is None:
                print(f"{name}: mjlab is not installed")
                continue
            rows.append(row(name, text, cache))
            print(json.dumps(rows[-1]), flush=True)
    given.out.mkdir(exist_ok=True)
    (given.out / "mjcf_table.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
