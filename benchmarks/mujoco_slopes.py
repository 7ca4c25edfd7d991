"""One linearisation of a log: seconds for arms and robots of others, and its memory.

    python benchmarks/mujoco_slopes.py [--models FOLDER] [--out DIR]

A linearisation is a simulation of 10 s at 200 Hz in windows of 1 s and its derivative
in every constant and start: one step of a fit. The models: acrobot and cart-pole of
dm_control, a six-axis arm, and Unitree's Go1 and G1 with their bases fixed (package
`mjlab`, looked for where it is installed, or in FOLDER). What mjlab adds in its own
code is in its place here: servos, armatures, friction, and no contacts of the legs with
the trunk. Next to it what central differences of the steps would take, estimated from a
twentieth of them.
"""

import argparse
import json
import resource
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.systems import MuJoCo
from sim2gp.systems.mujoco.engine import Engine
from sim2gp.systems.plants.external import AbstractSimulator, Arguments

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import servo_arm  # noqa: E402

WINDOWS, ROWS, SPAN = 10, 200, 0.005
SERVO = "joint/*/damping", "joint/*/armature", "joint/*/frictionloss", "body/*/mass"


#: Model files of other packages, by name.
OF_OTHERS = {
    "Go1, base fixed": "mjlab/asset_zoo/robots/unitree_go1/xmls/go1.xml",
    "G1, base fixed": "mjlab/asset_zoo/robots/unitree_g1/xmls/g1.xml",
    "acrobot": "dm_control/suite/acrobot.xml",
    "cart-pole": "dm_control/suite/cartpole.xml",
}


def models(folder: Path | None) -> dict[str, Any]:
    """Compiled models by name; those whose package is missing are left out."""
    import mujoco

    found = {"six axes": mujoco.MjModel.from_xml_string(servo_arm.model_text())}
    for name, path in OF_OTHERS.items():
        model = model_of_others(name, folder)
        if model is None:
            print(f"{name}: {path.split('/')[0]} is not installed")
        else:
            found[name] = model
    return found


def model_of_others(name: str, folder: Path | None = None) -> Any | None:
    """One of `OF_OTHERS`, compiled with its base fixed; None where it is missing."""
    path = OF_OTHERS[name]
    package, rest = path.split("/", 1)
    spec = find_spec(package) if folder is None else None
    root = Path(spec.origin).parent if spec and spec.origin else None
    file = root / rest if root else (folder or Path()) / path
    return fixed(file).compile() if file.is_file() else None


def fixed(file: Path) -> Any:
    """A model to be compiled, without its free joint; servos and friction where the
    file has no actuators.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(file))
    for joint in list(spec.joints):
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            spec.delete(joint)
    if not list(spec.actuators):
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        for joint in spec.joints:
            joint.armature, joint.frictionloss = 0.01, 0.1
            joint.damping = [0.1, 0.0, 0.0]
            servo = spec.add_actuator(name=f"{joint.name}.servo", target=joint.name)
            servo.trntype = mujoco.mjtTrn.mjTRN_JOINT
            servo.set_to_position(kp=100.0, kv=3.0)
    for key in list(spec.keys):
        spec.delete(key)
    return spec


def opened(model: Any) -> Engine:
    """Constants of joints and bodies that are not zero in the file."""
    from sim2gp.systems.mujoco.constants import constants_of, matching

    known = constants_of(model)
    paths = [
        c.path
        for pattern in SERVO
        for c in matching(known, pattern)
        if c.get(model) > 0.0
    ]
    return MuJoCo(model, paths).engine


def measured(engine: Engine) -> dict[str, Any]:
    """Seconds of one linearisation, in closed form and by differences."""
    model, rng = engine.model, np.random.default_rng(0)
    n, m, p = model.nq + model.nv, model.nu, len(engine.constants)
    theta = np.asarray([group[0].get(model) for group in engine.constants])
    k = n + p
    x0 = np.zeros((WINDOWS, n))
    x0[:, : model.nq] = rest = inside(model)
    t = SPAN * np.arange(WINDOWS * ROWS).reshape(WINDOWS, ROWS, 1)
    u = 0.2 * np.sin(2.0 * np.pi * rng.uniform(0.2, 1.0, m) * t)
    if m == model.nq:
        u = u + rest  # servos
    span = np.full((WINDOWS, ROWS), SPAN)
    at = Arguments(np.tile(theta, (WINDOWS, 1)), x0, u, span)
    eye = np.broadcast_to(np.eye(k), (WINDOWS, k, k))
    along = Arguments(eye[:, n:], eye[:, :n], np.zeros((*u.shape, k)), span)
    started = time.perf_counter()
    states, slopes = engine.linearised_rollout(at, along)
    seconds = time.perf_counter() - started
    started = time.perf_counter()
    few = slice(0, ROWS // 20)
    args = (np.repeat(at.theta[:, None], ROWS // 20, 1), states[:, few], u[:, few])
    flat = [x.reshape(-1, x.shape[-1]) for x in args]
    AbstractSimulator.slopes(engine, *flat, np.full(len(flat[0]), SPAN))
    differences = 20.0 * (time.perf_counter() - started)
    return {
        "joints": model.nv,
        "constants": p,
        "finite": bool(np.isfinite(slopes).all()),
        "seconds": round(seconds, 3),
        "differences": round(differences, 2),
        "memory": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
    }


def inside(model: Any) -> np.ndarray:
    """The file's position, off the stops of the joints."""
    low, high = model.jnt_range.T
    margin = 0.2 * (high - low)
    free = ~model.jnt_limited.astype(bool)
    return np.where(
        free, model.qpos0, np.clip(model.qpos0, low + margin, high - margin)
    )


def main() -> None:
    """Measure every model that is there, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--out", type=Path, default=ROOT / "results")
    given = parser.parse_args()
    table = {}
    for name, model in models(given.models).items():
        table[name] = measured(opened(model))
        print(f"{name}: {json.dumps(table[name])}", flush=True)
    given.out.mkdir(exist_ok=True)
    (given.out / "mujoco_slopes.json").write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
