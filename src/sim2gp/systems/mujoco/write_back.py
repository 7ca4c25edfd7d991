"""Which attribute of an MJCF file has a parameter, and what it must say instead.

An attribute that a class of defaults states is put on the element itself, so that no
other element changes. A mass goes onto geoms that state theirs, else the body gets an
``inertial`` of its own, as it does for another centre of mass.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sim2gp.errors import error
from sim2gp.systems.mujoco.constants import Constant
from sim2gp.systems.mujoco.inertia import NAMES as INERTIA
from sim2gp.systems.mujoco.inertia import inertia_matrix
from sim2gp.systems.mujoco.text_edits import Edits, Element, number

_AXES = ("com_x", "com_y", "com_z")
_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
#: Attribute of a shortcut that states a servo's parameter.
_SERVO = {("position", "kp"), ("position", "kv"), ("velocity", "kv")}
_SERVO |= {("intvelocity", "kp"), ("intvelocity", "kv"), ("damper", "kv")}


@dataclass(eq=False)
class Body:
    """One body of the file: its elements, without those of its children."""

    elements: list[Element]
    joints: list[Element] = field(default_factory=list)
    geoms: list[Element] = field(default_factory=list)


class MJCF:
    """Elements of an MJCF file in the order in which MuJoCo compiles them."""

    def __init__(self, root: Element, model: Any) -> None:
        self.root, self.model = root, model
        self.bodies = [Body(list(root.all("worldbody")))]
        for world in self.bodies[0].elements:
            self._walk(world, self.bodies[0])
        sections = root.all("actuator")
        self.actuators = [child for part in sections for child in part.children]
        contacts = [child for part in root.all("contact") for child in part.children]
        self.pairs = [child for child in contacts if child.tag == "pair"]

    def _walk(self, element: Element, owner: Body) -> None:
        for child in element.children:
            if child.tag == "body":
                self.bodies.append(Body([child]))
                self._walk(child, self.bodies[-1])
            elif child.tag == "frame":
                self._walk(child, owner)
            elif child.tag in ("joint", "freejoint"):
                owner.joints.append(child)
            elif child.tag == "geom":
                owner.geoms.append(child)

    def body(self, index: int) -> Body:
        """A body by its number in the model (E170 where the file does not show it)."""
        bodies = [b for b in self.bodies if b.elements]
        named = [b.elements[0] for b in bodies]
        found = _located(named, "body", index, self.model, self.model.nbody)
        return next(b for b in bodies if b.elements[0] is found)

    def element(self, kind: str, index: int) -> Element:
        """A joint, geom, pair or actuator by its number in the model (E170)."""
        every = {
            "joint": [j for b in self.bodies for j in b.joints],
            "geom": [g for b in self.bodies for g in b.geoms],
            "actuator": self.actuators,
            "pair": self.pairs,
        }[kind]
        counts = {"joint": "njnt", "geom": "ngeom", "actuator": "nu", "pair": "npair"}
        count = counts[kind]
        total = int(getattr(self.model, count))
        return _located(every, kind, index, self.model, total)

    def say(
        self, edits: Edits, wanted: Any, constants: Sequence[Constant]
    ) -> dict[str, str]:
        """Edits that make these parameters those of ``wanted``; all can be written."""
        masses: dict[int, set[str]] = {}
        for constant in constants:
            kind, quantity, i = constant.kind, constant.quantity, constant.index
            if kind == "option":
                say_gravity(edits, self.root, wanted)
            elif kind == "body" and quantity == "length":
                ratio = _ratio(wanted.body_pos[i], self.model.body_pos[i])
                scale(edits, self.body(i).elements[0], "pos", ratio)
            elif kind == "body":
                masses.setdefault(i, set()).add(quantity)
            elif kind == "actuator":
                self._actuator(edits, wanted, constant)
            elif kind == "pair":
                self._pair(edits, wanted, constant)
            else:
                element = self.element(kind, i)
                edits.set_numbers(element, quantity, {0: constant.get(wanted)})
        for i, quantities in masses.items():
            self._mass(edits, wanted, i, quantities)
        return {}

    def _actuator(self, edits: Edits, wanted: Any, constant: Constant) -> None:
        i, quantity, value = constant.index, constant.quantity, constant.get(wanted)
        element = self.element("actuator", i)
        if quantity == "gear":
            edits.set_numbers(element, "gear", {0: value})
        elif (element.tag, quantity) in _SERVO:
            edits.set_numbers(element, quantity, {0: value})
        elif element.tag == "adhesion" and quantity == "gain":
            edits.set_numbers(element, "gain", {0: value})
        elif element.tag in ("general", "motor"):
            if element.tag == "motor":  # whose gain is one
                edits.rename(element, "general")
                for name, kind in (
                    ("dyn", "none"),
                    ("gain", "fixed"),
                    ("bias", "none"),
                ):
                    edits.set(element, f"{name}type", kind)
            for name, now in (
                ("gainprm", wanted.actuator_gainprm[i]),
                ("biasprm", wanted.actuator_biasprm[i]),
            ):
                before = getattr(self.model, f"actuator_{name}")[i]
                changed = {int(k): float(now[k]) for k in np.flatnonzero(now != before)}
                if changed:
                    rest = dict(enumerate(now.tolist()))
                    edits.set_numbers(element, name, changed, rest)
        else:
            where, got = element.line, f"a {element.tag}"
            raise error("unsayable_constant", where=where, got=got, path=constant.path)

    def _pair(self, edits: Edits, wanted: Any, constant: Constant) -> None:
        """Sliding friction along both tangents, or both numbers of `solref`."""
        name = "friction" if constant.quantity == "friction" else "solref"
        numbers = getattr(wanted, f"pair_{name}")[constant.index, :2].tolist()
        element = self.element("pair", constant.index)
        edits.set_numbers(element, name, dict(enumerate(numbers)))

    def _mass(self, edits: Edits, wanted: Any, b: int, quantities: set[str]) -> None:
        """Mass, centre and inertia of a body, in the file's own words where it can."""
        body, model = self.body(b), self.model
        element = body.elements[0]
        own = next(element.all("inertial"), None)
        ratio = float(wanted.body_mass[b] / model.body_mass[b])
        if quantities & set(INERTIA):
            if own is None:
                edits.insert(element, _inertial(full(wanted, b)))
                return
            for name in (*_ORIENTATIONS, "diaginertia"):
                edits.set(own, name, None)
            for name, value in full(wanted, b).items():
                edits.set(own, name, value)
        elif own is not None:
            if "mass" in quantities:
                edits.set_numbers(own, "mass", {0: float(wanted.body_mass[b])})
                for name in ("diaginertia", "fullinertia"):
                    scale(edits, own, name, ratio)
            for axis in range(3):
                if _AXES[axis] in quantities:
                    place = float(wanted.body_ipos[b, axis])
                    edits.set_numbers(own, "pos", {axis: place})
        elif quantities == {"mass"} and _weighed(body.geoms):
            for geom in body.geoms:
                scale(edits, geom, "mass", ratio)
        elif quantities == {"mass"} and len(body.geoms) == 1:
            mass = float(wanted.body_mass[b])
            edits.set_numbers(body.geoms[0], "mass", {0: mass})
        else:
            edits.insert(element, _inertial(diagonal(wanted, b)))


def _located(
    elements: Sequence[Element], kind: str, index: int, model: Any, count: int
) -> Element:
    """By name, or by number where the file shows every object of the model."""
    name = str(getattr(model, kind)(index).name)
    found = [e for e in elements if name and e.attributes.get("name") == name]
    if len(found) == 1:
        return found[0]
    unnamed = not name and len(elements) == count
    if unnamed and "name" not in elements[index].attributes:
        return elements[index]
    got = f"{len(elements)} of {count} elements of its kind"
    raise error("element_not_found", got=got, element=kind, name=name or index)


def say_gravity(edits: Edits, root: Element, wanted: Any) -> None:
    """In the option that states it; a new one where there is none."""
    options = list(root.all("option"))
    stated = [o for o in options if "gravity" in o.attributes]
    pull = wanted.opt.gravity.tolist()
    if stated or options:
        last = (stated or options)[-1]
        edits.set_numbers(last, "gravity", dict(enumerate(pull)))
    else:
        edits.insert(root, f'<option gravity="{words(pull)}"/>')


def scale(edits: Edits, element: Element, name: str, ratio: float) -> None:
    """Multiply the numbers of an attribute, where it is there."""
    stated = edits.get(element, name)
    if stated is not None:
        numbers = [ratio * float(x) for x in stated.split()]
        edits.set_numbers(element, name, dict(enumerate(numbers)))


def words(numbers: Iterable[float]) -> str:
    """Numbers as the text of an attribute."""
    return " ".join(number(x) for x in numbers)


def _weighed(geoms: Sequence[Element]) -> bool:
    return bool(geoms) and all("mass" in geom.attributes for geom in geoms)


def _ratio(now: np.ndarray, before: np.ndarray) -> float:
    return float(np.linalg.norm(now) / np.linalg.norm(before))


def diagonal(model: Any, b: int) -> dict[str, str]:
    """A body's inertial by its principal axes."""
    return {
        "pos": words(model.body_ipos[b]),
        "quat": words(model.body_iquat[b]),
        "mass": words(model.body_mass[b : b + 1]),
        "diaginertia": words(model.body_inertia[b]),
    }


def full(model: Any, b: int) -> dict[str, str]:
    """A body's inertial in the body's own axes."""
    values = inertia_matrix(model, b)
    upper = [values[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    said = diagonal(model, b)
    return {"pos": said["pos"], "mass": said["mass"], "fullinertia": words(upper)}


def _inertial(said: dict[str, str]) -> str:
    return "<inertial " + " ".join(f'{k}="{v}"' for k, v in said.items()) + "/>"
