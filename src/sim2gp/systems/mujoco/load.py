"""A model's file becomes a compiled model: files checked, compiled in a child process.

A compiler that crashes or never ends on somebody's file ends the child and not the
caller. Files that a model names must lie in its own folder or below, or in ``root``:
they are read here (`sim2gp.systems.mujoco.sources`), and the child opens no others.
A URDF has no actuators: every hinge and slide gets a motor, ``<joint>.motor``
(`sim2gp.systems.mujoco.compile_child`).
"""

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from sim2gp import cleanup
from sim2gp.errors import InputError, error, missing_extra, warn
from sim2gp.systems.mujoco.elements import UNREAD
from sim2gp.systems.mujoco.sources import Sources, read_sources

SECONDS = 60  # that a model may take to compile
#: MuJoCo's words for masses and inertias; not for a mesh that encloses no volume.
_IMPOSSIBLE = re.compile(r"mass and inertia|inertia must|mass, inertia or density")
_LINE = re.compile(r"\bline (\d+)\b")
_CHILD = os.path.join(os.path.dirname(__file__), "compile_child.py")


def compiled(path: Path, root: Path | None = None) -> Any:
    """The model of an MJCF or URDF file; what MuJoCo warns of is W170.

    Raises `InputError` E130 where there is no such file, E135 where MuJoCo or lxml is
    not installed, E147 or E170 with MuJoCo's words where it is no possible body or no
    model, E170 for a number that is not finite, E171 where it names files outside
    ``root`` (its own folder) or the compiler crashed or took more than a minute, E172
    for two files that MuJoCo would take for one.
    """
    home = Path(os.path.realpath(path)).parent
    sources = read_sources(path, home if root is None else root)
    (model,), warned = _models([path], [sources])
    for text in dict.fromkeys(warned):
        line = None if sources.texts else _LINE.search(text)
        place = f"{path}:line {line.group(1)}" if line else f"{path}"
        warn("W170", f"{place}: {text}")
    return model


def compiled_all(paths: Sequence[Path]) -> list[Any]:
    """The models of several files that were written here, in one child process.

    They name the files of a model that was checked, from wherever they lie; what MuJoCo
    warns of was said when that one was compiled.
    """
    return _models(paths, [read_sources(path, None) for path in paths])[0]


def as_mjcf(path: Path) -> str:
    """A file whose paths were checked as MJCF, in MuJoCo's words and six digits."""
    with cleanup.temporary_folder() as folder:
        (made,), _ = _made([path], [read_sources(path, None)], folder, "xml")
        return made.read_text(encoding="utf-8")


def _models(
    paths: Sequence[Path], sources: Sequence[Sources]
) -> tuple[list[Any], list[str]]:
    if find_spec("mujoco") is None:
        missing = ModuleNotFoundError("No module named 'mujoco'", name="mujoco")
        raise missing_extra(UNREAD, missing, "mujoco")
    with cleanup.temporary_folder() as folder, ThreadPoolExecutor(1) as aside:
        # Half a second, while the child has the other core.
        mujoco = aside.submit(import_module, "mujoco")
        made, warned = _made(paths, sources, folder, "mjb")
        read = mujoco.result().MjModel.from_binary_path
        return [read(str(each)) for each in made], warned


def _made(
    paths: Sequence[Path], sources: Sequence[Sources], folder: str, form: str
) -> tuple[list[Path], list[str]]:
    """What the child makes of each file, and what MuJoCo warns of."""
    seconds, count = SECONDS * len(paths), str(len(paths))
    for i, (path, each) in enumerate(zip(paths, sources, strict=True)):
        _hand_over(Path(folder), i, path.suffix.lower(), each)
    # In that folder MuJoCo leaves its log.
    arguments = [str(seconds), folder, form, count]
    blind = dict(os.environ) | {"MUJOCO_GL": "disable"}  # MuJoCo seeks no window system
    done = in_child(_CHILD, arguments, folder, 2 * seconds, blind)
    where = str(paths[0])
    if done is None:
        raise _died(where, f"no answer in {2 * seconds} s")
    lines = done.stderr.splitlines()
    if done.returncode == 3:
        said = [x.removeprefix("REFUSED ") for x in lines if x.startswith("REFUSED ")]
        reached = sum(x.startswith("MODEL ") for x in lines)
        raise _refused(str(paths[reached - 1]), said[-1])
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no words"])[-1]
        if last.startswith(("ImportError", "ModuleNotFoundError")):
            raise missing_extra(UNREAD, ImportError(last, name="mujoco"), "mujoco")
        raise _died(where, f"exit {done.returncode}, {last}")
    warned = [x.removeprefix("WARNING:").strip() for x in lines if "WARNING:" in x]
    return [Path(folder, f"{i}.{form}") for i in range(len(paths))], warned


def _hand_over(folder: Path, i: int, suffix: str, sources: Sources) -> None:
    """Write a model's bytes where the child reads them."""
    stored: dict[str, bytes] = {f"{i}.main": sources.main}
    index: dict[str, Any] = {"suffix": suffix, "main": f"{i}.main"}
    for kind, files in (("texts", sources.texts), ("assets", sources.assets)):
        index[kind] = {}
        for name, data in files.items():
            index[kind][name] = f"{i}.{len(stored)}"
            stored[index[kind][name]] = data
    for name, data in stored.items():
        (folder / name).write_bytes(data)
    (folder / f"{i}.json").write_text(json.dumps(index), encoding="utf-8")


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
        return error("impossible_body", where=where, got=said)
    return error("model_not_compiled", where=where, got=said)


def _died(where: str, got: str) -> InputError:
    return error("parser_died", where=where, got=got)
