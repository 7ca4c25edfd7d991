"""The child process that compiles models: run as a script, in isolation.

    python -I compile_child.py SECONDS FOLDER mjb|xml COUNT

Model 0 is FOLDER/0.json, which says its kind and the files that it needs, and so on.
Each model is compiled and kept in FOLDER, as ``0.mjb`` and so on, or in MuJoCo's own
words as ``0.xml``. Exit 3 where MuJoCo refuses one; its words are on stderr then, and
its warnings in any case. All files are open before MuJoCo sees a model: from then on
the process opens none. This file imports nothing of sim2gp: a child starts in a third
of a second.
"""

import json
import os
import sys
import warnings
from typing import Any

#: Bytes of memory.
MEMORY = 8 << 30


def read_model(folder: str, i: int) -> dict[str, Any]:
    """A model's kind (``suffix``), its text, and files by the names it has for them."""
    with open(os.path.join(folder, f"{i}.json"), encoding="utf-8") as file:
        found: dict[str, Any] = json.load(file)
    with open(os.path.join(folder, found["main"]), "rb") as opened:
        found["main"] = opened.read().decode("utf-8-sig")
    for kind in ("texts", "assets"):
        for name, stored in found[kind].items():
            with open(os.path.join(folder, stored), "rb") as opened:
                found[kind][name] = opened.read()
    return found


def spec_of(model: dict[str, Any]) -> Any:
    """What a file says; a URDF, which has no actuators, gets a motor at every joint."""
    import mujoco

    files = {"include": model["texts"], "assets": model["assets"]}
    spec = mujoco.MjSpec.from_string(model["main"], **files)
    if model["suffix"] == ".urdf":
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


def limit(name: str, most: int) -> None:
    """Lower a limit of this process, never raise it, where the system has it.

    macOS has no limit of memory that could be set; Windows has none at all.
    """
    try:
        import resource

        kind = getattr(resource, name)
        now = [x for x in resource.getrlimit(kind) if x != resource.RLIM_INFINITY]
        lowest = min(most, *now) if now else most
        resource.setrlimit(kind, (lowest, lowest))
    except (ImportError, AttributeError, ValueError, OSError):
        return


def forbid_files() -> None:
    """Open no further file, where the system has such a limit."""
    limit("RLIMIT_NOFILE", 0)


def compile_model(model: dict[str, Any], form: str) -> bytes:
    """The model, as MuJoCo keeps it or as MuJoCo writes it."""
    import mujoco
    import numpy as np

    spec = spec_of(model)
    if form == "xml":
        spec.compile()
        return bytes(spec.to_xml(), "utf-8")
    made = general(spec)
    buffer = np.zeros(mujoco.mj_sizeModel(made), np.uint8)
    mujoco.mj_saveModel(made, None, buffer)
    return buffer.tobytes()


def say(kind: str, text: object) -> None:
    """One line on stderr."""
    sys.stderr.write(f"{kind} {' '.join(str(text).split())}\n")
    sys.stderr.flush()


def compile_models(seconds: str, folder: str, form: str, count: str) -> int:
    """Compile every model; returns the exit code."""
    limit("RLIMIT_AS", MEMORY)
    limit("RLIMIT_CPU", int(seconds))
    import mujoco

    # Without a handler MuJoCo would write a file somewhere.
    mujoco.set_mju_user_warning(lambda text: say("WARNING:", text))
    warnings.simplefilter("always")
    warnings.showwarning = lambda message, *_: say("WARNING:", message)
    models = [read_model(folder, i) for i in range(int(count))]
    outs = [os.path.join(folder, f"{i}.{form}") for i in range(int(count))]
    files = [open(out, "wb") for out in outs]  # noqa: SIM115 (closed at the end)
    forbid_files()
    for i, (model, file) in enumerate(zip(models, files, strict=True)):
        say("MODEL", i)
        try:
            file.write(compile_model(model, form))
            file.close()
        except (ValueError, mujoco.FatalError) as error:
            say("REFUSED", error)
            return 3
    return 0


if __name__ == "__main__":
    raise SystemExit(compile_models(*sys.argv[1:]))
