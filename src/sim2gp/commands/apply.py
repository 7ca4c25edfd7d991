"""Apply: what a run identified, written back into the model's own file.

The file's text is edited where it says what was learned, and nowhere else; the edited
text is compiled and compared before anything is kept. Values are the modes of the
corrected posterior, the centres of the report's intervals, or where it is asked those
of the plain one.
"""

import difflib
from pathlib import Path
from typing import Any

from sim2gp.cleanup import replace_file, temporary_folder
from sim2gp.commands.identification import (
    Width,
    check_identified,
    modes,
    project_of,
    used,
)
from sim2gp.errors import InputError
from sim2gp.project import Project
from sim2gp.project.project import is_model
from sim2gp.runs import Progress, load_run
from sim2gp.runs.store import Run, check_absent
from sim2gp.systems import MuJoCo
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mujoco.constants import matching
from sim2gp.systems.mujoco.load import compiled_all
from sim2gp.systems.mujoco.model_file import Edited, ModelFile
from sim2gp.systems.variants import own_table

Written = list[tuple[str, bytes]]


def run(
    run: Path,
    *,
    out: Path | None,
    model: Path | None,
    in_place: bool,
    progress: Progress,
    configuration: str | None = None,
    posterior: Width = "corrected",
) -> dict[str, Any]:
    """Write the constants of a run into ``out``, or the source ``in_place``, or show.

    ``model`` is another copy of the file than the one that was fitted; the machine is
    that of one ``configuration``, where it has several (E152). ``posterior`` says whose
    modes are written. Raises `InputError` E130
    for a run without a model's constants, E132 where ``out`` exists, E170 where the
    file cannot say them: then nothing is written.
    """
    if out is not None and in_place:
        got, fix = "--out and --in-place", "leave one of the two out"
        raise InputError("E132", "output file", where=str(out), got=got, fix=fix)
    if out is not None:
        check_absent(out)
    stored = load_run(run)
    project = _project(run, stored, model)
    system = plant_of(project.system)
    assert isinstance(system, MuJoCo)
    values, apart = _values(stored, project, system, configuration, posterior)
    progress.say(f"editing {system.source}")
    file = system.file()
    edited = file.edited(system.by_path(values))
    with temporary_folder() as folder:
        _written(file, edited, Path(folder, f"model{file.suffix}"))
    written = _keep(file, edited, out, in_place)
    return {
        "command": "apply",
        "title": f"{run.name}: its constants in {file.source.name}",
        "model": str(file.source),
        **used(stored.summary, posterior),
        "written": written,
        "constants": _table(file, edited),
        "not_written": apart | edited.unsaid,
        "diff": _diff(file, edited, out),
    }


def _project(run: Path, stored: Run, model: Path | None) -> Project:
    """The run's project with the model's file where it stands now."""
    check_identified(run, stored)
    project = project_of(run, stored, model)
    if not is_model(project.spec.system):
        raise InputError(
            "E130",
            "no model's file",
            where=str(run),
            got=f"the bundled machine {project.spec.system}",
            expected="a project whose system is an MJCF or URDF file",
            fix="copy its constants from summary.json",
        )
    return project


def _values(
    stored: Run,
    project: Project,
    system: MuJoCo,
    configuration: str | None,
    posterior: Width,
) -> tuple[dict[str, float], dict[str, str]]:
    """The model's constants by name, and why the run's other ones are none."""
    joint = project.system.parameters
    table, places = own_table(joint, project.system.variants, configuration)
    own = modes(stored, joint, posterior)[list(places)]
    found = dict(zip(table.names, own.tolist(), strict=True))
    values = dict(table.fixed) | found
    for name in values:
        if "/" in name and name not in system.names:
            matching(system.file().constants, name)  # raises with the nearest name
            raise InputError("E170", "a constant that is not open", got=name)
    apart = {
        name: "no constant of the model's file"
        for name, value in values.items()
        if name not in system.names and (name in found or value != _neutral(name))
    }
    return {k: v for k, v in values.items() if k in system.names}, apart


def _neutral(name: str) -> float:
    """Of an input that arrives as it was sent."""
    return 1.0 if name.endswith(".gain") else 0.0


def _keep(
    file: ModelFile, edited: Edited, out: Path | None, in_place: bool
) -> list[str]:
    """Write what was asked for; names of the files."""
    if out is not None:
        return [str(path) for path in _written(file, edited, out)]
    if not in_place:
        return []
    changed = file.replaced(edited)
    for path, data in changed.items():
        replace_file(path, data)
    return [str(path) for path in changed]


def _written(file: ModelFile, edited: Edited, out: Path) -> list[Path]:
    """New files, compiled and compared; none of them is left where that fails."""
    made: list[Path] = []
    try:
        for _, name, data in file.texts(edited, out.name, out.parent):
            with open(out.parent / name, "xb") as opened:
                made.append(out.parent / name)
                opened.write(data)
        file.check(edited, compiled_all([out])[0])
    except BaseException:
        for path in made:
            path.unlink()
        raise
    return made


def _table(file: ModelFile, edited: Edited) -> dict[str, dict[str, Any]]:
    """What each changed constant was and is."""
    table = {}
    for path, constant in file.constants.items():
        was, now = (constant.get(m) for m in (file.model, edited.wanted))
        if path in edited.said:
            table[path] = {"was": was, "is": now, "unit": constant.unit}
    return table


def _diff(file: ModelFile, edited: Edited, out: Path | None) -> str:
    """The changes of every file as a unified diff."""
    if out is None:
        changed = file.replaced(edited).items()
        pairs = [
            (d, str(d.path), x)
            for d in file.files.documents
            for p, x in changed
            if p == d.path
        ]
    else:
        texts = file.texts(edited, out.name, out.parent)
        pairs = [(d, str(out.parent / name), x) for d, name, x in texts]
    lines: list[str] = []
    for document, name, data in pairs:
        before, after = (x.decode().splitlines(True) for x in (document.data, data))
        lines += difflib.unified_diff(before, after, str(document.path), name)
    ended = (line if line.endswith("\n") else f"{line}\n" for line in lines)
    return "".join(ended)
