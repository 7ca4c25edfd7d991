"""What computes a result: the text of its modules, and the versions under them."""

import ast
import functools
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from sim2gp.runs.plain import to_json, version

PACKAGE = Path(__file__).parents[1]
#: Rooms that draw and word results, and do not compute them.
SHOWN = ("cli", "reports")
PACKAGES = ("jax", "jaxlib", "numpy")
_DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Source:
    """Digests of modules by name, and versions of packages by name."""

    modules: dict[str, str]
    versions: dict[str, str]

    @property
    def content(self) -> str:
        """As JSON."""
        return to_json({"modules": self.modules, "versions": self.versions})

    @property
    def digest(self) -> str:
        """A short name of both."""
        return digest_of(self.content)


def digest_of(text: str) -> str:
    """The first 16 digits of a SHA-256."""
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16]


@functools.cache
def source_of(file: str | Path) -> Source:
    """The source of a module's file, and of all that it imports of ours.

    Ours is sim2gp and, for a script, the files next to it. Imports are read from the
    syntax trees, also inside functions; nothing is imported. Comments, docstrings and
    layout do not count. Read once in a process: what it runs does not change.
    """
    start, names = Path(file).resolve(), {}
    pending = [_name(start)]
    while pending:
        name = pending.pop()
        path = _file(name, start.parent)
        if name in names or path is None:
            continue
        digest, imported = _read(path, name)
        names[name] = digest
        pending += [*imported, name.rpartition(".")[0]]
    versions = {package: version(package) for package in PACKAGES}
    return Source(dict(sorted(names.items())), versions)


def _name(path: Path) -> str:
    """`sim2gp.systems.plants.furuta`; of a script, its stem."""
    if not path.is_relative_to(PACKAGE):
        return path.stem
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _file(name: str, folder: Path) -> Path | None:
    """The file of a module; None where it is not ours, or only shows."""
    parts = name.split(".")
    ours = parts[0] == PACKAGE.name
    if not name or (ours and parts[1:2] and parts[1] in SHOWN):
        return None
    place = (PACKAGE.parent if ours else folder).joinpath(*parts)
    for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def _read(path: Path, name: str) -> tuple[str, tuple[str, ...]]:
    """Digest of what a module says, and the names that it imports."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = name if path.name == "__init__.py" else name.rpartition(".")[0]
    imported = tuple(_imported(tree, package))
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False):
            del node.body[0]
        for field in node._fields:  # which of the empty ones there are, Python decides
            if getattr(node, field, None) in (None, []):
                node.__dict__.pop(field, None)
    return digest_of(ast.dump(tree)), imported


def _imported(tree: ast.AST, package: str) -> Iterator[str]:
    """Modules by their whole names; ``from a import b`` may be ``a`` or ``a.b``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = package.split(".")
                base = ".".join([*above[: len(above) + 1 - node.level], base])
            base = base.strip(".")
            yield base
            for alias in node.names:
                yield from _of_package(f"{base}.{alias.name}")


def _of_package(name: str) -> Iterator[str]:
    """``from sim2gp import X`` loads X from any room: then all of them count."""
    yield name
    parts = name.split(".")
    if parts[0] == PACKAGE.name and len(parts) == 2 and not _file(name, PACKAGE):
        yield from (_name(path) for path in PACKAGE.rglob("*.py"))
