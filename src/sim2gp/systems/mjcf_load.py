"""A model's file becomes a compiled model: paths checked, parsed in a child process.

A parser that crashes or runs away on somebody's file ends the child and not whoever
asked. Files that a model names must lie in its own folder or below, or in ``root``.
A URDF has no actuators: every hinge and slide gets a motor, ``<joint>.motor``
(`sim2gp.systems.mjcf_child`).
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sim2gp import cleanup
from sim2gp.errors import InputError, missing_extra

SECONDS = 60  # that a model may take to compile
_BYTES = 50_000_000  # of one file of text
_NAMED = re.compile(r'<\s*(\w+)[^>]*?\b(?:file|filename)\s*=\s*["\']([^"\']*)["\']')
#: MuJoCo's words for masses and inertias; not for a mesh that encloses no volume.
_IMPOSSIBLE = re.compile(r"mass and inertia|inertia must|mass, inertia or density")
_FOLDER = re.compile(r'\b(meshdir|texturedir|assetdir)\s*=\s*["\']([^"\']*)["\']')
_UNREAD = "a MuJoCo model cannot be read"
_CHILD = os.path.join(os.path.dirname(__file__), "mjcf_child.py")


def compiled(path: Path, root: Path | None = None) -> Any:
    """The model of an MJCF or URDF file.

    Raises `InputError` E130 where there is no such file, E135 where MuJoCo is not
    installed, E147 or E170 with MuJoCo's words where it is no possible body or no
    model, E171 where it names files outside ``root`` (its own folder) or the parser
    crashed or took more than a minute.
    """
    check_paths(path, path.parent if root is None else root)
    return compiled_all([path])[0]


def compiled_all(paths: Sequence[Path]) -> list[Any]:
    """The models of several files whose paths were checked, in one child process."""
    if find_spec("mujoco") is None:
        missing = ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
        raise missing_extra(_UNREAD, missing, "mujoco")
    with cleanup.temporary_folder() as folder, ThreadPoolExecutor(1) as aside:
        # Half a second, while the child has the other core.
        mujoco = aside.submit(import_module, "mujoco")
        made = _made(paths, folder, "mjb")
        read = mujoco.result().MjModel.from_binary_path
        return [read(str(each)) for each in made]


def as_mjcf(path: Path) -> str:
    """A file whose paths were checked as MJCF, in MuJoCo's words and six digits."""
    with cleanup.temporary_folder() as folder:
        return _made([path], folder, "xml")[0].read_text(encoding="utf-8")


def _made(paths: Sequence[Path], folder: str, form: str) -> list[Path]:
    """What the child makes of each file."""
    seconds = SECONDS * len(paths)
    where = str(paths[0])
    files = [str(path.resolve()) for path in paths]
    # In that folder MuJoCo leaves its log.
    done = in_child(_CHILD, [str(seconds), folder, form, *files], folder, 2 * seconds)
    if done is None:
        raise _died(where, f"no answer in {2 * seconds} s")
    if done.returncode == 3:
        said = " ".join(done.stderr.split("REFUSED ", 1)[-1].split())
        raise _refused(where, said)
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no words"])[-1]
        if last.startswith(("ImportError", "ModuleNotFoundError")):
            raise missing_extra(_UNREAD, ImportError(last, name="mujoco"), "mujoco")
        raise _died(where, f"exit {done.returncode}, {last}")
    return [Path(folder, f"{i}.{form}") for i in range(len(paths))]


def in_child(
    script: str,
    arguments: Sequence[str],
    folder: str,
    seconds: int,
    environment: Mapping[str, str] | None = None,
) -> subprocess.CompletedProcess[str] | None:
    """Run a script of this room apart, in a folder; None where it took too long."""
    with (
        subprocess.Popen(
            [sys.executable, "-I", script, *arguments],
            cwd=folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
        ) as child,
        cleanup.registered(child.kill),
    ):
        try:
            out, err = child.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            return None
        finally:
            child.kill()  # one that has ended is not killed
        return subprocess.CompletedProcess(child.args, child.returncode, out, err)


def _refused(where: str, said: str) -> InputError:
    """E147 for a body that no matter could make, E170 for what is no model."""
    if _IMPOSSIBLE.search(said):
        return InputError(
            "E147",
            "impossible body",
            where=where,
            got=said,
            expected="positive masses, and moments of inertia with A + B >= C",
            fix="correct the mass or the inertia of the body",
        )
    return InputError(
        "E170",
        "no model",
        where=where,
        got=said,
        expected="a model that MuJoCo compiles",
        fix="mend the file where MuJoCo says",
    )


def check_paths(path: Path, root: Path) -> None:
    """Every file that a model includes or names lies below ``root`` (E130, E171)."""
    inside = root.resolve()
    todo, seen = [path], set()
    while todo:
        file = todo.pop()
        if file.resolve() in seen:
            continue
        seen.add(file.resolve())
        for kind, name in _files(_read(file, path)):
            named = name.removeprefix("package://")
            place = (path.parent / named).resolve()
            if not place.is_relative_to(inside):
                raise InputError(
                    "E171",
                    f"{kind} outside the model's folder",
                    where=str(file),
                    got=name,
                    expected=f"a file below {inside}",
                    fix="move it there, or give a folder that holds both as root",
                )
            if kind == "include":
                todo.append(place)


def _files(text: str) -> Iterator[tuple[str, str]]:
    """What each element names, with the folder that its kind is looked for in."""
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    folders: dict[str, str] = dict(_FOLDER.findall(text))
    assets = folders.get("assetdir", "")
    for kind, name in _NAMED.findall(text):
        where = {"mesh": "meshdir", "texture": "texturedir"}.get(kind, "")
        yield kind, os.path.join(folders.get(where, assets) if where else "", name)


def _read(file: Path, model: Path) -> str:
    try:
        with open(file, "rb") as opened:
            return opened.read(_BYTES).decode("utf-8", errors="replace")
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        where = "" if file == model else str(model)
        raise InputError(
            "E130", f"cannot read {file}", where=where, got=reason
        ) from None


def _died(where: str, got: str) -> InputError:
    return InputError(
        "E171",
        "MuJoCo's parser did not come back",
        where=where,
        got=got,
        expected="a model",
        fix="see whether MuJoCo's own viewer opens it",
    )
