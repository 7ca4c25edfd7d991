"""Apply: what a run identified, written back into the model's own file.

The file's text is edited where it says what was learned, and nowhere else; the edited
text is compiled and compared before anything is kept. Values are the modes of the
corrected posterior, the centres of the report's intervals, or where it is asked those
of the plain one.
"""

import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sim2gp.cleanup import replace_file, temporary_folder
from sim2gp.commands.identification import (
    Identification,
    Width,
    check_identified,
    modes,
    posterior_entries,
    project_of,
)
from sim2gp.commands.result import AbstractResult
from sim2gp.errors import error
from sim2gp.project import Project
from sim2gp.project.project import is_model
from sim2gp.runs import Progress, load_run
from sim2gp.runs.store import check_absent
from sim2gp.systems import MuJoCo
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mujoco.constants import matching
from sim2gp.systems.mujoco.load import compiled_all
from sim2gp.systems.mujoco.model_file import Edited, ModelFile
from sim2gp.systems.variants import own_table

Written = list[tuple[str, bytes]]


@dataclass(frozen=True, repr=False)
class AppliedModel(AbstractResult):
    """A model's file with identified parameters, which is written on request."""

    file: ModelFile | None = field(default=None)
    edited: Edited | None = field(default=None)

    @property
    def diff(self) -> str:
        """The changes of the model's files, as a unified diff."""
        return str(self.summary["diff"])

    @property
    def constants(self) -> dict[str, dict[str, Any]]:
        """The old and new value of each changed parameter, in its unit."""
        return dict(self.summary["constants"])

    def save_model(self, out: Path | str) -> "AppliedModel":
        """Write a new file, and copies of those that it includes (E132, E170)."""
        assert self.file is not None
        assert self.edited is not None
        out = Path(out)
        check_absent(out)
        written = [str(path) for path in _write_models(self.file, self.edited, out)]
        diff = _diff(self.file, self.edited, out)
        return self.with_entries(written=written, diff=diff)

    def replace_model(self) -> "AppliedModel":
        """Change the model's own files."""
        assert self.file is not None
        assert self.edited is not None
        changed = self.file.replaced(self.edited)
        for path, data in changed.items():
            replace_file(path, data)
        return self.with_entries(written=[str(path) for path in changed])


def apply(
    found: Identification,
    *,
    configuration: str | None = None,
    posterior: Width = "corrected",
    progress: Progress | None = None,
) -> AppliedModel:
    """Write the parameters of an identification into its MuJoCo model's own file.

    The machine is that of one ``configuration``, where it has several (E152);
    ``posterior`` says whose modes are written. Raises `InputError` E130 for a run
    without a model's parameters, E170 where the file cannot express them.
    """
    project = _with_model(found)
    system = plant_of(project.system)
    assert isinstance(system, MuJoCo)
    values, apart = _model_values(found, project, system, configuration, posterior)
    (progress or Progress()).say(f"editing {system.source}")
    file = system.file()
    edited = file.edited(system.by_path(values))
    with temporary_folder() as folder:
        _write_models(file, edited, Path(folder, f"model{file.suffix}"))
    summary = {
        "command": "apply",
        "title": f"{found.name}: its parameters in {file.source.name}",
        "model": str(file.source),
        **posterior_entries(found.summary, posterior),
        "written": [],
        "constants": _changes_by_path(file, edited),
        "not_written": apart | edited.unsaid,
        "diff": _diff(file, edited, None),
    }
    return AppliedModel(summary, file=file, edited=edited)


def for_model(run: Path, model: Path | None = None) -> Identification:
    """A run to be applied; its model's file may have changed since, or be another."""
    stored = load_run(run)
    check_identified(run, stored)
    project = project_of(run, stored, model=model)
    return Identification(stored.summary, stored.arrays, {}, project, run)


def _with_model(found: Identification) -> Project:
    """The project, whose machine is a model's file."""
    project = found.project
    assert project is not None
    if not is_model(project.spec.system):
        where, got = str(found.path or found.name), "the bundled machine "
        raise error("no_model_file", where=where, got=got + project.spec.system)
    return project


def _model_values(
    found: Identification,
    project: Project,
    system: MuJoCo,
    configuration: str | None,
    posterior: Width,
) -> tuple[dict[str, float], dict[str, str]]:
    """The model's parameters by name, and why the run's other ones are none of them."""
    joint = project.system.parameters
    table, places = own_table(joint, project.system.variants, configuration)
    own = modes(found.arrays, joint, posterior)[list(places)]
    learned = dict(zip(table.names, own.tolist(), strict=True))
    values = dict(table.fixed) | learned
    for name in values:
        if "/" in name and name not in system.names:
            matching(system.file().constants, name)  # raises with the nearest name
            raise error("constant_not_open", got=name)
    apart = {
        name: "no parameter of the model's file"
        for name, value in values.items()
        if name not in system.names and (name in learned or value != _neutral(name))
    }
    return {k: v for k, v in values.items() if k in system.names}, apart


def _neutral(name: str) -> float:
    """Of an input that arrives as it was sent."""
    return 1.0 if name.endswith(".gain") else 0.0


def _write_models(file: ModelFile, edited: Edited, out: Path) -> list[Path]:
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


def _changes_by_path(file: ModelFile, edited: Edited) -> dict[str, dict[str, Any]]:
    """The old and new value of each changed parameter."""
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
