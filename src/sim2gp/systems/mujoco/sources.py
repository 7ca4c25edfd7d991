"""The files of a model, read and checked: all that MuJoCo's compiler is given.

A model names meshes, textures, parts of its text and other models. Each name is
resolved here in every way in which the compiler may, and must lead below the model's
folder, links followed. The bytes that were read here are what the compiler gets, under
the names that it asks for; it opens no file itself
(`sim2gp.systems.mujoco.compile_child`).

Where the compiler looks: a part in the main file's folder, then in that of the part
that includes it; meshes, heights and skins in the `compiler`'s `meshdir`, textures in
its `texturedir`, then in the folder of the part that names them; by the last part of
the name where `strippath` is true, as it is in a URDF.
"""

import os
import re
import stat
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim2gp.errors import InputError, error
from sim2gp.systems.mujoco.elements import bare, elements, parsed, place

_BYTES = 1 << 30  # of all files of a model
_PARTS = 200  # files of text
_DIRECTORIES = ("meshdir", "texturedir", "assetdir")
_BY_KIND = {
    **dict.fromkeys(("mesh", "skin", "hfield", "flexcomp"), "meshdir"),
    "texture": "texturedir",
}
#: Characters that some system reads as more than a letter of a name.
_ODD = re.compile(r"[:\x00-\x1f\x7f]")


@dataclass
class Sources:
    """A model's own bytes, and by name those of the files that it needs.

    MuJoCo reads ``texts`` (parts, other models, flexible meshes) while it parses, by
    the file's name alone, and ``assets`` when it compiles, by their paths.
    """

    main: bytes
    texts: dict[str, bytes] = field(default_factory=dict)
    assets: dict[str, bytes] = field(default_factory=dict)


def read_sources(path: Path, root: Path | None) -> Sources:
    """A model's file and all that it names, below ``root`` (None: anywhere).

    Raises `InputError` E130 for a file that cannot be read, E170 for what is no plain
    XML, a number that is not finite or a missing part, E171 for one outside ``root``.
    """
    reader = _Reader(path, root)
    main = reader.read(os.path.realpath(path), path, "")
    reader.sources.main = main
    reader.model(_Document(path, main, ""))
    return reader.sources


def is_inside(file: str, root: str) -> bool:
    """Whether a file, links followed, lies below a folder, links followed."""
    return Path(os.path.realpath(file)).is_relative_to(os.path.realpath(root))


@dataclass(eq=False)
class _Document:
    """One file of text: of the model in ``base``, included by a part in ``prefix``."""

    path: Path
    data: bytes
    base: str  # of its model, from the main file's folder
    prefix: str | None = None  # of a part, from its model's folder
    root: Any = None

    def __post_init__(self) -> None:
        self.root = parsed(self.data, str(self.path))

    def where(self, element: Any) -> str:
        return place(element, self.data, str(self.path))


@dataclass(eq=False)
class _Scope:
    """What one model states: its `compiler`, and the files that elements name."""

    urdf: bool
    directories: dict[str, str] = field(default_factory=dict)
    strippath: bool = False
    named: list[tuple[_Document, Any, str, str]] = field(default_factory=list)

    def state(self, compiler: Any) -> None:
        """A later `compiler` overrides; `assetdir` is both folders of those before."""
        stated = {bare(name): value for name, value in compiler.attrib.items()}
        if "assetdir" in stated:
            both = dict.fromkeys(("meshdir", "texturedir"), stated["assetdir"])
            self.directories |= both
        known = {k: stated[k] for k in _DIRECTORIES[:2] if k in stated}
        self.directories |= known
        self.strippath = stated.get("strippath", str(self.strippath)).lower() == "true"


class _Reader:
    def __init__(self, path: Path, root: Path | None) -> None:
        self.main, self.root = path, root
        self.home = os.path.dirname(os.path.realpath(path))
        self.sources = Sources(b"")
        self._known: dict[str, bytes] = {}
        self._names: dict[str, bytes] = {}  # in lower case: MuJoCo may compare so
        self._size = self._parts = 0

    def model(self, document: _Document) -> None:
        """All that a model's text names, and the text that it includes."""
        urdf = bare(document.root.tag) == "robot"
        scope = _Scope(urdf, strippath=urdf)
        self._walk(document, scope, {os.path.realpath(document.path)})
        for each in scope.named:
            self._named(scope, *each)

    def _walk(self, document: _Document, scope: _Scope, seen: set[str]) -> None:
        """Parts in the order in which they are included, each once."""
        for element in elements(document.root):
            kind = bare(element.tag)
            if kind == "compiler":
                scope.state(element)
            for name, value in element.attrib.items():
                if bare(name) in _DIRECTORIES:
                    self._check(document, element, bare(name), value)
                elif kind == "include" and bare(name) == "file":
                    self._include(document, element, value, scope, seen)
                elif _is_path(kind, bare(name), value):
                    scope.named.append((document, element, kind, value))

    def _include(
        self,
        document: _Document,
        element: Any,
        name: str,
        scope: _Scope,
        seen: set[str],
    ) -> None:
        names = [_joined(prefix or "", name) for prefix in ("", document.prefix)]
        found = self._found(document, element, "include", names)
        if found is None:
            raise self._missing(document, element, name)
        part, data = found
        self._keep_text(document, element, part, data)
        file = os.path.realpath(self._place(document.base, part))
        if file not in seen:
            seen.add(file)
            prefix = os.path.dirname(part)
            self._walk(self._text(file, data, document.base, prefix), scope, seen)

    def _text(
        self, file: str, data: bytes, base: str, prefix: str | None = None
    ) -> _Document:
        self._parts += 1
        if self._parts > _PARTS:
            raise self._too_much(f"more than {_PARTS} files of text")
        return _Document(Path(file), data, base, prefix)

    def _named(
        self, scope: _Scope, document: _Document, element: Any, kind: str, name: str
    ) -> None:
        """A file that an element names: checked, read and kept."""
        base, folder = document.base, scope.directories.get(_BY_KIND.get(kind, ""), "")
        if scope.urdf:
            name = name.removeprefix("package://")
        strip = scope.strippath and kind in _BY_KIND
        asked = _last(name) if strip else name
        if not name:
            return
        ways = _ways(folder, document.prefix, asked)
        found = self._found(document, element, kind, ways[:2])
        if found is None:
            if (scope.urdf and _unread(element)) or (kind == "config" and _plain(name)):
                return
            raise self._missing(document, element, name)
        first, data = found
        if kind in ("flexcomp", "model"):
            self._keep_text(document, element, first, data)
        if kind != "model":
            self._keep_asset(document, element, base, ways, data)
        else:
            file = os.path.realpath(self._place(base, first))
            self.model(self._text(file, data, _joined(base, os.path.dirname(first))))

    def _found(
        self, document: _Document, element: Any, kind: str, names: list[str]
    ) -> tuple[str, bytes] | None:
        """The first name that is a file's, and its bytes; none before it is outside."""
        for name in names:
            self._check(document, element, kind, name)
            file = os.path.realpath(self._place(document.base, name))
            if os.path.isfile(file):
                return name, self.read(file, Path(file), str(self.main))
        return None

    def _place(self, base: str, name: str) -> str:
        # As MuJoCo does, `..` takes away a name before links are followed.
        return os.path.normpath(os.path.join(self.home, _joined(base, name)))

    def _check(self, document: _Document, element: Any, kind: str, name: str) -> None:
        """A name leads below the root, links followed before `..` or after (E171)."""
        path = _joined(document.base, name)
        odd = _ODD.search(path) is not None
        ways = [os.path.join(self.home, path), self._place(document.base, name)]
        root = self.home if self.root is None else str(self.root)
        anywhere = self.root is None and not odd
        if anywhere or (not odd and all(is_inside(way, root) for way in ways)):
            return
        file = next(
            (x for x in map(os.path.realpath, ways) if not is_inside(x, root)), ""
        )
        got = _shown(name) if file in ("", name) else f"{_shown(name)}, {_shown(file)}"
        raise error(
            "file_outside_model_folder",
            where=document.where(element),
            got=got,
            part=kind,
            folder=os.path.realpath(root),
        )

    def _keep_text(
        self, document: _Document, element: Any, name: str, data: bytes
    ) -> None:
        key = _last(name)
        self._keep(document, element, f"text/{key}", data)
        self.sources.texts[key] = data

    def _keep_asset(
        self,
        document: _Document,
        element: Any,
        base: str,
        ways: list[str],
        data: bytes,
    ) -> None:
        """Under every name that MuJoCo may ask for: without one it takes another."""
        for name in ways:
            path = _joined(base, name)
            if "//" in path:  # which versions of MuJoCo read differently
                got = f"an empty part in {_shown(path)}"
                where = document.where(element)
                raise error("empty_part_in_path", where=where, got=got)
            key = os.path.normpath(path)
            self._keep(document, element, f"asset/{key}", data)
            self.sources.assets[key] = data

    def _keep(self, document: _Document, element: Any, name: str, data: bytes) -> None:
        """One name is one file: MuJoCo would take either (E172)."""
        if self._names.setdefault(name.lower(), data) != data:
            where, got = document.where(element), name.split("/", 1)[1]
            raise error("two_files_of_one_name", where=where, got=got)

    def read(self, file: str, shown: Path, where: str) -> bytes:
        """A regular file's bytes, once (E130)."""
        if file in self._known:
            return self._known[file]
        try:
            with open(file, "rb", opener=_without_waiting) as opened:
                if not stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
                    raise OSError(None, "no regular file")
                data = opened.read(_BYTES - self._size + 1)
        except (OSError, ValueError) as caught:
            got = getattr(caught, "strerror", None) or str(caught)
            raise error("unreadable_file", where=where, got=got, file=shown) from None
        self._size += len(data)
        if self._size > _BYTES:
            raise self._too_much(f"more than {_BYTES >> 20} MiB")
        self._known[file] = data
        return data

    def _missing(self, document: _Document, element: Any, name: str) -> InputError:
        got = f"{_shown(name)}, which is no file"
        return error("missing_model_part", where=document.where(element), got=got)

    def _too_much(self, got: str) -> InputError:
        return error("large_model", where=str(self.main), got=got)


def _ways(folder: str, prefix: str | None, name: str) -> list[str]:
    """Where MuJoCo looks for an asset, in this order; the last if it has no disk."""
    if prefix is None:
        return [_joined(folder, name)]
    local = _joined(prefix, name)
    return [_joined(folder, name), local, _joined(folder, local)]


def _is_path(kind: str, name: str, value: str) -> bool:
    """Whether an attribute names a file; a plugin's setting may."""
    if kind == "config":
        return name == "value"
    named = name.startswith("file") or name.endswith(("file", "filename"))
    return named or name in ("uri", "url", "href", "src")


def _unread(element: Any) -> bool:
    """Of a URDF: what MuJoCo leaves out, visual shapes and settings of other tools."""
    around = [bare(each.tag) for each in element.iterancestors()]
    return bare(element.tag) != "mesh" or "visual" in around


def _plain(setting: str) -> bool:
    """Whether a plugin's setting is words and numbers, as those of most plugins."""
    return all(
        re.fullmatch(r"[\w-][\w.-]*|[+-]?[\d.]+(e[+-]?\d+)?", word, re.IGNORECASE)
        for word in setting.split()
    )


def _posix(name: str) -> str:
    return name.replace("\\", "/")  # a separator for MuJoCo on every system


def _last(name: str) -> str:
    return _posix(name).rsplit("/", 1)[-1]


def _joined(folder: str, name: str) -> str:
    return os.path.join(_posix(folder), _posix(name))


def _shown(name: str) -> str:
    return name if name.isprintable() else ascii(name)


def _without_waiting(file: str, flags: int) -> int:
    """Open a file; a pipe that nobody writes to does not block."""
    return os.open(file, flags | getattr(os, "O_NONBLOCK", 0))
