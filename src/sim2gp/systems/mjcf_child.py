"""The child process that parses models: run as a script, in isolation.

    python -I mjcf_child.py SECONDS FOLDER mjb|xml MODEL...

Each model is compiled and kept in FOLDER, as ``0.mjb`` and so on, or in MuJoCo's own
words as ``0.xml``. Exit 3 where MuJoCo refuses one; its words are on stderr then.
This file imports nothing of sim2gp: a child starts in a third of a second.
"""

import os
import sys
from typing import Any


def spec_of(path: str) -> Any:
    """What a file says; a URDF, which has no actuators, gets a motor at every joint."""
    import mujoco

    spec = mujoco.MjSpec.from_file(path)
    if path.lower().endswith(".urdf"):
        for joint in spec.joints:
            if joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE):
                motor = spec.add_actuator(name=joint.name + ".motor")
                motor.trntype, motor.target = mujoco.mjtTrn.mjTRN_JOINT, joint.name
    return spec


def general(spec: Any) -> Any:
    """The model, no body that turns simplified: a centre of mass could not move.

    Those that only slide stay: MuJoCo gives their contacts another softness.
    """
    model = spec.compile()
    turning = [body for body in spec.bodies if model.body_simple[body.id] == 1]
    changed = [body for body in turning if body.id and hasattr(body, "simple")]
    for body in changed:  # MuJoCo 4 or newer
        body.simple = 0
    return spec.compile() if changed else model


def limit(seconds: int) -> None:
    """Of memory and processor time, where the system has such limits."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))


def main(seconds: str, folder: str, form: str, *paths: str) -> int:
    """Compile every model; returns the exit code."""
    limit(int(seconds))
    import mujoco

    mujoco.set_mju_user_warning(lambda _: None)  # or it would leave a file somewhere
    for i, path in enumerate(paths):
        out = os.path.join(folder, f"{i}.{form}")
        try:
            spec = spec_of(path)
            if form == "mjb":
                mujoco.mj_saveModel(general(spec), out)
            else:
                spec.compile()
                with open(out, "w", encoding="utf-8") as file:
                    file.write(spec.to_xml())
        except (ValueError, mujoco.FatalError) as error:
            sys.stderr.write("REFUSED " + str(error))
            return 3
    return 0


if __name__ == "__main__":
    raise SystemExit(main(*sys.argv[1:]))
