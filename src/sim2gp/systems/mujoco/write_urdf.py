"""Which element of a URDF has a parameter; what a URDF cannot express is named.

Links that fixed joints weld together are one body of the model: their masses and
inertias change in the same proportion.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sim2gp.errors import error
from sim2gp.systems.mujoco.constants import Constant
from sim2gp.systems.mujoco.inertia import NAMES as INERTIA
from sim2gp.systems.mujoco.inertia import inertia_matrix
from sim2gp.systems.mujoco.text_edits import Edits, Element, number
from sim2gp.systems.mujoco.write_back import say_gravity, scale, words

_DYNAMICS = {"damping": "damping", "frictionloss": "friction"}
_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
_AXES = ("com_x", "com_y", "com_z")


class URDF:
    """Elements of a URDF by the names of the model's objects."""

    def __init__(self, root: Element, model: Any) -> None:
        self.root, self.model = root, model

    def say(
        self, edits: Edits, wanted: Any, constants: Sequence[Constant]
    ) -> dict[str, str]:
        """Edits that give parameters the values of ``wanted``; why others cannot."""
        unsaid = {}
        inertias: set[int] = set()
        for constant in constants:
            kind, quantity, i = constant.kind, constant.quantity, constant.index
            if kind == "joint" and quantity in _DYNAMICS:
                value = constant.get(wanted)
                self._dynamics(edits, i, _DYNAMICS[quantity], value)
            elif kind == "body" and quantity == "mass":
                ratio = float(wanted.body_mass[i] / self.model.body_mass[i])
                for link in self._welded(self._named("link", self._name("body", i))):
                    _scale_link(edits, link, ratio)
            elif kind == "body" and quantity in _AXES:
                axis = _AXES.index(quantity)
                value = float(wanted.body_ipos[i, axis])
                _place(edits, self._inertial(i), {axis: value})
            elif kind == "body" and quantity in INERTIA:
                inertias.add(i)
            elif kind == "body":
                self._length(edits, wanted, i)
            elif kind == "option":
                self._gravity(edits, wanted)
            else:
                unsaid[constant.path] = f"a URDF has no word for the {quantity}"
        for i in inertias:
            _full(edits, self._inertial(i), wanted, i)
        return unsaid

    def _name(self, kind: str, index: int) -> str:
        return str(getattr(self.model, kind)(index).name)

    def _named(self, tag: str, name: str) -> Element:
        found = [e for e in self.root.all(tag) if e.attributes.get("name") == name]
        if len(found) != 1:
            got = f"{len(found)} of that name"
            raise error("urdf_element_not_found", got=got, tag=tag, name=name)
        return found[0]

    def _dynamics(self, edits: Edits, j: int, word: str, value: float) -> None:
        joint = self._named("joint", self._name("joint", j))
        dynamics = next(joint.all("dynamics"), None)
        if dynamics is None:
            edits.insert(joint, f'<dynamics {word}="{number(value)}"/>')
        else:
            edits.set_numbers(dynamics, word, {0: value})

    def _welded(self, link: Element) -> Iterator[Element]:
        """A link and those that fixed joints weld to it."""
        yield link
        for joint in self.root.all("joint"):
            parent = next(joint.all("parent")).attributes.get("link")
            fixed = joint.attributes.get("type") == "fixed"
            if fixed and parent == link.attributes["name"]:
                child = next(joint.all("child")).attributes["link"]
                yield from self._welded(self._named("link", child))

    def _inertial(self, b: int) -> Element:
        link = self._named("link", self._name("body", b))
        found = next(link.all("inertial"), None)
        if found is None:
            name = link.attributes["name"]
            raise error("link_without_inertial", where=link.line, name=name)
        return found

    def _length(self, edits: Edits, wanted: Any, b: int) -> None:
        name = self._name("body", b)
        for joint in self.root.all("joint"):
            if next(joint.all("child")).attributes["link"] == name:
                now, before = wanted.body_pos[b], self.model.body_pos[b]
                ratio = float(np.linalg.norm(now) / np.linalg.norm(before))
                for origin in joint.all("origin"):
                    scale(edits, origin, "xyz", ratio)

    def _gravity(self, edits: Edits, wanted: Any) -> None:
        part = next(self.root.all("mujoco"), None)
        if part is not None:
            say_gravity(edits, part, wanted)
            return
        option = f'<option gravity="{words(wanted.opt.gravity)}"/>'
        edits.insert(self.root, option, "mujoco")


def _scale_link(edits: Edits, link: Element, ratio: float) -> None:
    for inertial in link.all("inertial"):
        for mass in inertial.all("mass"):
            scale(edits, mass, "value", ratio)
        for inertia in inertial.all("inertia"):
            for moment in _MOMENTS:
                scale(edits, inertia, moment, ratio)


def _place(edits: Edits, inertial: Element, place: dict[int, float]) -> None:
    origin = next(inertial.all("origin"), None)
    if origin is None:
        xyz = words(place.get(axis, 0.0) for axis in range(3))
        edits.insert(inertial, f'<origin xyz="{xyz}"/>')
    else:
        edits.set_numbers(origin, "xyz", place, dict.fromkeys(range(3), 0.0))


def _full(edits: Edits, inertial: Element, wanted: Any, b: int) -> None:
    _place(edits, inertial, dict(enumerate(wanted.body_ipos[b].tolist())))
    for origin in inertial.all("origin"):
        if "rpy" in origin.attributes:
            edits.set(origin, "rpy", "0 0 0")
    for mass in inertial.all("mass"):
        edits.set_numbers(mass, "value", {0: float(wanted.body_mass[b])})
    values = inertia_matrix(wanted, b)
    for inertia in inertial.all("inertia"):
        for name in _MOMENTS:
            i, j = ("xyz".index(letter) for letter in name[1:])
            edits.set_numbers(inertia, name, {0: float(values[i, j])})
