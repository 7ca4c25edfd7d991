"""A model's files with other parameters in them, and the proof that they contain them.

The source's own text is edited (`sim2gp.systems.mujoco.text_edits`), so that a reader
sees in a diff what was learned and nothing else. What was written is compiled again and
compared with what was wanted, number by number, before anybody gets to see it.
"""

import copy
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim2gp.errors import InputError, error
from sim2gp.systems.mujoco.constants import Constant, constants_of, set_constants
from sim2gp.systems.mujoco.inertia import inertia_matrix
from sim2gp.systems.mujoco.load import as_mjcf
from sim2gp.systems.mujoco.text_edits import Document, Edits, Element, read_files
from sim2gp.systems.mujoco.write_back import MJCF
from sim2gp.systems.mujoco.write_urdf import URDF

#: Of a parameter that was written, and of every number that MuJoCo makes of the file.
SAME, DERIVED_SAME = 1e-9, 1e-6
SIX_DIGITS = 1e-4  # of the numbers of a file that MuJoCo has written
#: Numbers of the model that no parameter decides, or that only speed depends on.
_APART = ("bvh_aabb", "oct_aabb", "body_iquat", "body_inertia")


@dataclass(frozen=True, eq=False)
class Edited:
    """A file's changes, the model that they must make, and what it cannot say."""

    edits: Edits
    wanted: Any
    said: frozenset[str]
    unsaid: dict[str, str]


class ModelFile:
    """A model's file, read once, to be written with other parameters in it.

    ``model`` is what it compiles to. A URDF may be written ``as MJCF``, with motors;
    MuJoCo then chooses the words, with six digits except for the parameters.
    """

    def __init__(self, source: Path, model: Any, *, mjcf: bool = False) -> None:
        self.source, self.model = source, model
        said = mjcf and source.suffix.lower() == ".urdf"
        self.same, self.all_same = (SIX_DIGITS,) * 2 if said else (SAME, DERIVED_SAME)
        self.suffix = ".xml" if said else source.suffix
        data = as_mjcf(source).encode() if said else None
        self.files = read_files(source, data)
        kind = URDF if self.files.root.tag == "robot" else MJCF
        self.places = kind(self.files.root, model)
        self.constants = constants_of(model)

    def edited(self, values: Mapping[str, float]) -> Edited:
        """The edits that give parameters, by path, these values.

        Raises `InputError` E170 for a parameter that the text does not show.
        """
        changed = {
            path: float(value)
            for path, value in values.items()
            if not np.isclose(
                value, self.constants[path].get(self.model), rtol=1e-12, atol=1e-12
            )
        }
        edits = Edits()
        unsaid = self.places.say(edits, self._model(changed), self._named(changed))
        said = {path: v for path, v in changed.items() if path not in unsaid}
        return Edited(edits, self._model(said), frozenset(said), unsaid)

    def _named(self, values: Mapping[str, float]) -> list[Constant]:
        return [self.constants[path] for path in values]

    def _model(self, values: Mapping[str, float]) -> Any:
        import mujoco

        model = copy.copy(self.model)
        pairs = zip(self._named(values), values.values(), strict=True)
        set_constants(model, pairs)
        mujoco.mj_setConst(model, mujoco.MjData(model))
        return model

    def texts(
        self, edited: Edited, name: str, folder: Path
    ) -> list[tuple[Document, str, bytes]]:
        """The file under a new name in ``folder``, and parts of it that changed too.

        A changed part ``arm.xml`` of ``new.xml`` is ``new.arm.xml``. In another folder
        than the source's the text says where meshes and parts are: none is copied.
        """
        edits = edited.edits.copy()
        moved = folder.resolve() != self.source.parent.resolve()
        if moved:
            self._move_assets(edits, folder)
        names = self._names(edits, name, moved)
        for include, part in self.files.includes:
            if part in names:
                edits.set(include, "file", names[part])
            elif moved:
                edits.set(include, "file", _relative(part.path, folder))
        return [(each, names[each], edits.applied(each)) for each in names]

    def replaced(self, edited: Edited) -> dict[Path, bytes]:
        """Each of the source's own files that changes, as it becomes."""
        every = self.files.documents
        touched = [each for each in every if each in edited.edits.touched]
        return {each.path: edited.edits.applied(each) for each in touched}

    def _names(self, edits: Edits, name: str, moved: bool) -> dict[Document, str]:
        main, *_ = self.files.documents
        needed, count = {main} | edits.touched, 0
        while count != len(needed):
            count = len(needed)
            for include, part in self.files.includes:
                if moved or part in needed:
                    needed.add(include.document)
        stem, names = Path(name).stem, {main: name}
        for part in self.files.documents[1:]:
            if part in needed:
                names[part] = f"{stem}.{part.path.name}"
                if list(names.values()).count(names[part]) > 1:
                    names[part] = f"{stem}.{len(names)}.{part.path.name}"
        return names

    def _move_assets(self, edits: Edits, folder: Path) -> None:
        """Say where meshes and textures are, seen from another folder."""
        root, home = self.files.root, self.source.parent
        if not _assets(root):
            return
        urdf = root.tag == "robot"
        top = next(root.all("mujoco"), None) if urdf else root
        compilers = [] if top is None else list(top.all("compiler"))
        stated: dict[str, str] = {}
        for compiler in compilers:
            found = compiler.attributes
            if "assetdir" in found:
                stated |= dict.fromkeys(("meshdir", "texturedir"), found["assetdir"])
            stated |= {k: found[k] for k in ("meshdir", "texturedir") if k in found}
        places = {
            k: _relative(home / stated.get(k, ""), folder)
            for k in ("meshdir", "texturedir")
        }
        if compilers:
            for name, place in places.items():
                edits.set(compilers[-1], name, place)
            return
        said = "".join(f' {k}="{v}"' for k, v in places.items())
        text = f"<compiler{said}/>"
        if top is None:
            edits.insert(root, text, "mujoco")
        else:
            edits.insert(top, text)

    def check(self, edited: Edited, made: Any) -> None:
        """Every number of a compiled file is what was wanted.

        Raises `InputError` E170 with the first parameter, or array, that is another.
        """
        for name in ("nbody", "njnt", "ngeom", "nu"):
            pair = [int(getattr(m, name)) for m in (made, edited.wanted)]
            if pair[0] != pair[1]:
                raise self._unwritten(name, str(pair[0]), str(pair[1]))
        for path, constant in self.constants.items():
            if constant.block and path not in edited.said:
                continue  # it is the mass and the arrays below
            wanted, got = (constant.get(m) for m in (edited.wanted, made))
            near = self.same if constant.block else 1e-12  # of numbers that are zero
            if not np.isclose(got, wanted, rtol=self.same, atol=near):
                raise self._unwritten(path, f"{got:.9g}", f"{wanted:.9g}")
        self._check_arrays(edited.wanted, made)

    def _check_arrays(self, wanted: Any, made: Any) -> None:
        for name in _arrays(wanted):
            x, y = getattr(wanted, name), getattr(made, name)
            size = float(np.max(np.abs(x), initial=0.0))
            if x.shape != y.shape or not _near(y, x, self.all_same * size):
                raise self._unwritten(name, "other numbers", "those of the model")
        for b in range(wanted.nbody):
            x, y = inertia_matrix(wanted, b), inertia_matrix(made, b)
            if not _near(y, x, self.all_same * float(np.abs(x).max())):
                name = f"inertia of {wanted.body(b).name}"
                raise self._unwritten(name, "another", "the model's")

    def _unwritten(self, path: str, got: str, expected: str) -> InputError:
        where = str(self.source)
        return error(
            "constant_not_written", where=where, got=got, expected=expected, path=path
        )


def _near(got: np.ndarray, wanted: np.ndarray, tolerance: float) -> bool:
    return bool(np.all(np.abs(got - wanted) <= tolerance + 1e-15))


def _assets(root: Element) -> bool:
    """Whether any element names a file of a mesh, a texture or heights."""
    todo = [root]
    while todo:
        element = todo.pop()
        if {"file", "filename"} & set(element.attributes) and element.tag != "include":
            return True
        todo += element.children
    return False


def _arrays(model: Any) -> list[str]:
    """Names of the model's arrays of numbers."""
    names = [name for name in dir(model) if name[0] != "_" and name not in _APART]
    values = ((name, getattr(model, name, None)) for name in names)
    return [n for n, v in values if isinstance(v, np.ndarray) and v.dtype.kind == "f"]


def _relative(place: Path, folder: Path) -> str:
    return Path(os.path.relpath(place.resolve(), folder.resolve())).as_posix()
