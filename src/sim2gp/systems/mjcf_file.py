"""A model's file with other constants in it, in MuJoCo's own words.

MuJoCo writes six digits. A body whose mass or centre changes gets an ``inertial`` of
its own, which its geoms no longer decide; what else the file says stays.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.errors import InputError
from sim2gp.systems.mjcf import Constant, constants_of

#: What decides a body's dynamics, in the file and in the compiled model.
_INERTIAL = {
    "mass": "body_mass",
    "inertia": "body_inertia",
    "ipos": "body_ipos",
    "iquat": "body_iquat",
}


def rewritten(
    source: Path, model: Any, constants: Sequence[Constant], folder: Path
) -> str:
    """The text of ``source`` with the constants of ``model``, for a file in ``folder``.

    Meshes and textures are not copied: the text says where they are. Raises
    `InputError` E170 where the file would make another model than ``model``.
    """
    import mujoco

    spec = mujoco.MjSpec.from_file(str(source))
    spec.compile()  # numbers the elements
    auto = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.inertiafromgeom = auto  # or no inertial would be read
    for constant in constants:
        _say(spec, model, constant)
    made = _compiled(spec, source)
    for path, constant in constants_of(model).items():
        wanted, found = constant.get(model), constant.get(made)
        if not np.isclose(found, wanted, rtol=1e-9, atol=1e-12):
            raise InputError(
                "E170",
                f"{path} cannot be written",
                where=str(source),
                got=f"{found:g}",
                expected=f"{wanted:g}",
                fix="drop inertials that inertiafromgeom overrules",
            )
    if spec.meshes or spec.textures or spec.hfields:
        for where in ("meshdir", "texturedir"):
            kept = source.parent.resolve() / (getattr(spec, where) or "")
            setattr(spec, where, os.path.relpath(kept, folder.resolve()))
    return str(spec.to_xml())


def _compiled(spec: Any, source: Path) -> Any:
    try:
        return spec.compile()
    except ValueError as error:
        what = " ".join(str(error).split())
        raise InputError(
            "E170", "constants that make no model", where=str(source), got=what
        ) from None


def _say(spec: Any, model: Any, constant: Constant) -> None:
    """One constant as the file's element says it."""
    kind, quantity, i = constant.kind, constant.quantity, constant.index
    if kind == "option":
        spec.option.gravity = model.opt.gravity
        return
    elements = {
        "joint": spec.joints,
        "body": spec.bodies,
        "actuator": spec.actuators,
        "geom": spec.geoms,
    }
    element = next(x for x in elements[kind] if x.id == i)
    if kind == "joint":
        said = np.array(getattr(element, quantity), float)
        said[(0,) * said.ndim] = constant.get(model)  # a polynomial's first number
        setattr(element, quantity, said if said.ndim else float(said))
    elif quantity == "length":
        element.pos = model.body_pos[i]
    elif kind == "body":
        for name, field in _INERTIAL.items():
            setattr(element, name, getattr(model, field)[i])
    elif kind == "geom":
        element.friction = model.geom_friction[i]
    else:
        element.gainprm = model.actuator_gainprm[i]
        element.biasprm = model.actuator_biasprm[i]
        element.gear = model.actuator_gear[i]
