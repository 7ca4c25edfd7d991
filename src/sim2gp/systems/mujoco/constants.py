"""Parameters of a MuJoCo model by path: what can be learned, and how it is set.

| path                      | unit         | what is set                              |
|---------------------------|--------------|------------------------------------------|
| `joint/NAME/damping`      | N m s/rad    | viscous friction (of a slide, N s/m)     |
| `joint/NAME/armature`     | kg m^2, kg   | inertia of the rotor                     |
| `joint/NAME/frictionloss` | N m, N       | dry friction                             |
| `joint/NAME/stiffness`    | N m/rad, N/m | spring                                   |
| `body/NAME/mass`          | kg           | mass, and the inertia in proportion      |
| `body/NAME/com_x` (y, z)  | m            | centre of mass in the body's frame       |
| `body/NAME/inertia`       | 1, m         | all of it: ten numbers, zero in the file |
| `body/NAME/length`        | m            | distance from the parent's frame         |
| `actuator/NAME/gain`      | its own      | force for an input of one, of a motor    |
| `actuator/NAME/kp`, `kv`  | its own      | gains of a servo, `kv` of a damper       |
| `actuator/NAME/gear`      | 1            | gear ratio                               |
| `geom/NAME/friction`      | 1            | sliding friction of a contact            |
| `pair/NAME/friction`      | 1            | the same, of a contact pair with a name  |
| `pair/NAME/timeconst`     | s            | `solref` of the pair, and `dampratio`    |
| `pair/NAME/stiffness`     | 1/s^2        | where `solref` is negative: its two      |
| `pair/NAME/damping`       | 1/s          | numbers, positive                        |
| `option/gravity`          | m/s^2        | strength, in the model's direction       |

`NAME` may be a pattern (`joint/*/damping`). The ten numbers of `body/NAME/inertia`,
`body/NAME/inertia/alpha` and so on, are those of `sim2gp.systems.mujoco.inertia`.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any

import numpy as np

from sim2gp.errors import error, nearest
from sim2gp.systems.mujoco.inertia import NAMES as INERTIA
from sim2gp.systems.mujoco.inertia import BodyInertia, mirror_sign, unframe

#: Quantities that MuJoCo derives others from when it compiles a model.
DERIVED = frozenset({"mass", "com_x", "com_y", "com_z", "length", "armature", "gear"})
DERIVED |= frozenset(INERTIA)
_HINGE = {
    "damping": "N m s/rad",
    "armature": "kg m^2",
    "frictionloss": "N m",
    "stiffness": "N m/rad",
}
_SLIDE = {
    "damping": "N s/m",
    "armature": "kg",
    "frictionloss": "N",
    "stiffness": "N/m",
}
_MEANING = {
    "damping": "viscous friction of {}",
    "armature": "rotor inertia of {}",
    "frictionloss": "dry friction of {}",
    "stiffness": "spring of {}",
    "mass": "mass of {}, its inertia in proportion",
    "com_x": "centre of mass of {}, x",
    "com_y": "centre of mass of {}, y",
    "com_z": "centre of mass of {}, z",
    "length": "distance of {} from its parent",
    "gain": "gain of {}",
    "kp": "position gain of {}",
    "kv": "velocity gain of {}",
    "gear": "gear ratio of {}",
    "friction": "sliding friction of {}",
    "timeconst": "time constant of contact {}",
    "dampratio": "damping ratio of contact {}",
}
#: Quantities that may be negative.
SIGNED = frozenset({"com_x", "com_y", "com_z"})
#: Other names of what the ten numbers of an inertia are.
OF_INERTIA = SIGNED | {"mass"}
#: Those that move a body's centre of mass, or turn its principal axes.
CENTRED = SIGNED | frozenset(INERTIA)


@dataclass(frozen=True)
class Constant:
    """One number of a model: its path, unit and meaning, how it is read and set."""

    path: str
    index: int  # of the object in the model
    unit: str
    meaning: str
    get: Callable[[Any], float]
    put: Callable[[Any, float], None]
    block: BodyInertia | None = None  # sets several of them at once
    sign: float = 1.0  # of the number that tied parameters share

    @property
    def kind(self) -> str:
        return self.path.split("/", 1)[0]

    @property
    def quantity(self) -> str:
        return self.path.rsplit("/", 1)[-1]


def constants_of(model: Any) -> dict[str, Constant]:
    """Every parameter of a compiled model that can be learned, by path.

    What is set in proportion is so to the numbers of this model, however often it is.
    """
    found = [
        *_joints(model),
        *_bodies(model),
        *_actuators(model),
        *_geoms(model),
        *_pairs(model),
        *([_gravity(model)] if np.any(model.opt.gravity) else []),
    ]
    return {c.path: c for c in found}


def matching(known: dict[str, Constant], pattern: str) -> list[Constant]:
    """The parameters that a path or pattern names; E170 where there is none."""
    found = [
        c
        for path, c in known.items()
        if fnmatchcase(path, pattern)
        or (c.block is not None and fnmatchcase(path.rsplit("/", 1)[0], pattern))
    ]
    if not found:
        close = nearest(pattern, known)
        fix = f"did you mean {close}?" if close else ""
        expected = _kinds(known)
        raise error("unknown_model_constant", got=pattern, expected=expected, fix=fix)
    return found


def tied(constants: Sequence[Constant], model: Any) -> list[list[Constant]]:
    """Parameters that are one number for each quantity.

    Where two bodies are mirror images in the model they stay so: what a mirror turns
    round has the other sign.
    """
    groups: dict[tuple[str, str], list[Constant]] = {}
    for c in constants:
        groups.setdefault((c.kind, c.quantity), []).append(c)
    return [
        [replace(c, sign=_sign(group[0], c, model)) for c in group]
        for group in groups.values()
    ]


def _sign(first: Constant, other: Constant, model: Any) -> float:
    if first.block is not None and other.block is not None:
        return mirror_sign(first.block.own, other.block.own, other.quantity)
    opposite = first.get(model) * other.get(model) < 0.0
    return -1.0 if opposite and first.quantity in SIGNED else 1.0


def set_constants(model: Any, pairs: Iterable[tuple[Constant, float]]) -> None:
    """Set parameters to values and nothing else; `mujoco.mj_setConst` derives the rest.

    Of tied parameters it is the value that they share.
    """
    blocks: dict[BodyInertia, dict[str, float]] = {}
    for constant, value in pairs:
        if constant.block is None:
            constant.put(model, constant.sign * value)
        else:
            signed = constant.sign * value
            blocks.setdefault(constant.block, {})[constant.quantity] = signed
    for block, values in blocks.items():
        block.put(model, values)


def name_of(model: Any, kind: str, index: int) -> str:
    """An object's name; `joint2` and so on where it has none."""
    return str(getattr(model, kind)(index).name) or f"{kind}{index}"


def _kinds(known: dict[str, Constant]) -> str:
    kinds = sorted({f"{p.split('/')[0]}/.../{p.split('/')[-1]}" for p in known})
    return ", ".join(kinds)


def _constant(
    model: Any, kind: str, i: int, quantity: str, unit: str, how: Any
) -> Constant:
    name = name_of(model, kind, i)
    meaning = _MEANING[quantity].format(name)
    return Constant(f"{kind}/{name}/{quantity}", i, unit, meaning, **how)


def _cell(field: str, *index: int, sign: float = 1.0) -> dict[str, Callable[..., Any]]:
    """Reading and setting of one number in an array of the model."""

    def get(model: Any) -> float:
        return sign * float(getattr(model, field)[index])

    def put(model: Any, value: float) -> None:
        getattr(model, field)[index] = sign * value

    return {"get": get, "put": put}


def _joints(model: Any) -> list[Constant]:
    found = []
    for j in range(model.njnt):
        kind, dof = int(model.jnt_type[j]), int(model.jnt_dofadr[j])
        if kind not in (2, 3):  # slide and hinge have one degree of freedom
            continue
        for quantity, unit in (_SLIDE, _HINGE)[kind - 2].items():
            spring = quantity == "stiffness"
            how = _cell("jnt_stiffness", j) if spring else _cell(f"dof_{quantity}", dof)
            found.append(_constant(model, "joint", j, quantity, unit, how))
    return found


def _bodies(model: Any) -> list[Constant]:
    found = []
    for b in range(1, model.nbody):
        if model.body_mass[b] > 0.0:
            found.append(_constant(model, "body", b, "mass", "kg", _mass(model, b)))
            for axis, quantity in enumerate(("com_x", "com_y", "com_z")):
                how = _centre(b, axis)
                found.append(_constant(model, "body", b, quantity, "m", how))
            found += _inertia(model, b)
        if np.any(model.body_pos[b]):
            found.append(_constant(model, "body", b, "length", "m", _length(model, b)))
    return found


def _actuators(model: Any) -> list[Constant]:
    """Of what is fixed or affine; a muscle's numbers have other meanings."""
    found = []
    for i in range(model.nu):
        how = []
        columns = [
            column
            for column in (1, 2)
            if model.actuator_biastype[i] == 1 and model.actuator_biasprm[i, column]
        ]
        # The gain of a servo is that of its first term.
        gain = model.actuator_gainprm[i, 0]
        follows = [c for c in columns[:1] if gain == -model.actuator_biasprm[i, c]]
        if model.actuator_gaintype[i] == 0 and not follows:
            how.append(("gain", _cell("actuator_gainprm", i, 0)))
        if model.actuator_gaintype[i] == 1 and model.actuator_gainprm[i, 2]:
            how.append(("kv", _cell("actuator_gainprm", i, 2, sign=-1.0)))
        for column in columns:
            how.append((("kp", "kv")[column - 1], _servo(i, column, column in follows)))
        how.append(("gear", _cell("actuator_gear", i, 0)))
        found += [_constant(model, "actuator", i, q, "1", access) for q, access in how]
    return found


def _geoms(model: Any) -> list[Constant]:
    touching = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    return [
        _constant(model, "geom", g, "friction", "1", _cell("geom_friction", g, 0))
        for g in touching.tolist()
    ]


def _pairs(model: Any) -> list[Constant]:
    """Contact pairs that have a name: of the others nobody says which is which."""
    found = []
    for i in range(model.npair):
        if not model.pair(i).name:
            continue
        direct = bool(model.pair_solref[i, 0] < 0.0)
        names = (("timeconst", "s"), ("dampratio", "1"))
        if direct:  # minus stiffness and damping
            names = (("stiffness", "1/s^2"), ("damping", "1/s"))
        found.append(_constant(model, "pair", i, "friction", "1", _sliding(model, i)))
        for place, (quantity, unit) in enumerate(names):
            how = _cell("pair_solref", i, place, sign=-1.0 if direct else 1.0)
            found.append(_constant(model, "pair", i, quantity, unit, how))
    return found


def _gravity(model: Any) -> Constant:
    pull = model.opt.gravity.copy()
    strength = float(np.linalg.norm(pull))

    def get(model: Any) -> float:
        return float(np.linalg.norm(model.opt.gravity))

    def put(model: Any, value: float) -> None:
        model.opt.gravity[:] = pull * (value / strength)

    return Constant("option/gravity", 0, "m/s^2", "gravity", get, put)


def _mass(model: Any, b: int) -> dict[str, Callable[..., Any]]:
    """A body of another density: its inertia is in proportion to its mass."""
    mass, inertia = float(model.body_mass[b]), model.body_inertia[b].copy()

    def get(model: Any) -> float:
        return float(model.body_mass[b])

    def put(model: Any, value: float) -> None:
        model.body_mass[b] = value
        model.body_inertia[b] = inertia * (value / mass)

    return {"get": get, "put": put}


def _centre(b: int, axis: int) -> dict[str, Callable[..., Any]]:
    cell = _cell("body_ipos", b, axis)

    def put(model: Any, value: float) -> None:
        cell["put"](model, value)
        unframe(model, b)

    return {"get": cell["get"], "put": put}


def _inertia(model: Any, b: int) -> list[Constant]:
    """The ten numbers, of a body whose inertia is that of matter."""
    block, name = BodyInertia(model, b), name_of(model, "body", b)
    if np.linalg.eigvalsh(block.own)[0] <= 0.0:
        return []
    found = []
    for place, quantity in enumerate(INERTIA):

        def get(model: Any, place: int = place) -> float:
            return float(block.get(model)[place])

        def put(model: Any, value: float, place: int = place) -> None:
            values = block.get(model)
            values[place] = value
            block.put(model, dict(zip(INERTIA, values.tolist(), strict=True)))

        path, unit = f"body/{name}/inertia/{quantity}", "m" if place > 6 else "1"
        meaning = f"inertia of {name}, {quantity}"
        found.append(Constant(path, b, unit, meaning, get, put, block))
    return found


def _length(model: Any, b: int) -> dict[str, Callable[..., Any]]:
    place = model.body_pos[b].copy()
    length = float(np.linalg.norm(place))

    def get(model: Any) -> float:
        return float(np.linalg.norm(model.body_pos[b]))

    def put(model: Any, value: float) -> None:
        model.body_pos[b] = place * (value / length)

    return {"get": get, "put": put}


def _sliding(model: Any, i: int) -> dict[str, Callable[..., Any]]:
    """Friction of a pair along both tangents, in proportion."""
    own = model.pair_friction[i, :2].copy()

    def get(model: Any) -> float:
        return float(model.pair_friction[i, 0])

    def put(model: Any, value: float) -> None:
        model.pair_friction[i, :2] = own * (value / own[0])

    return {"get": get, "put": put}


def _servo(i: int, column: int, follows: bool) -> dict[str, Callable[..., Any]]:
    """``force = gain u + bias . (1, length, velocity)``; the gain may be ``-bias``."""
    cell = _cell("actuator_biasprm", i, column, sign=-1.0)

    def put(model: Any, value: float) -> None:
        cell["put"](model, value)
        if follows:
            model.actuator_gainprm[i, 0] = value

    return {"get": cell["get"], "put": put}
