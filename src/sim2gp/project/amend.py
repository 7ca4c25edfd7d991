"""A project file gets one more line of physics: text in, checked text out.

The file stays the user's: comments and order are kept, a table is appended or one line
is put under the header of a table that is there. The new text is read like any project
file before it replaces the old one, whole or not at all.
"""

import dataclasses
from pathlib import Path

from sim2gp.errors import InputError, Sim2GPError
from sim2gp.project.project import Project
from sim2gp.project.replace import key, replace_project
from sim2gp.project.schema import EFFECT_OPTIONS
from sim2gp.systems import Candidate, Delay, Lag


def lines_for(candidate: Candidate) -> tuple[str, list[str]]:
    """Header and lines of the table that frees a candidate (E160 for a lag)."""
    effect = candidate.effect
    where = key(effect.where)
    if not isinstance(effect, Delay | Lag):
        lines = ["mean = 0.0", f"sd = {effect.magnitude!r}"]
        for field in dataclasses.fields(effect):
            value = getattr(effect, field.name)
            if field.name in EFFECT_OPTIONS and value != field.default:
                lines.append(f"{field.name} = {value!r}")
        return f"[effects.{where}.{effect.what}]", lines
    if isinstance(effect, Delay):
        box = f"{{low = 0.0, high = {effect.magnitude!r}}}"
        return f"[actuators.{where}]", [f"delay = {box}"]
    raise InputError(
        "E160",
        "a lag in a project file",
        got=candidate.name,
        expected="an effect or a delay",
        fix=f'use delay = "free" under [actuators.{where}]',
    )


def amended(text: str, candidate: Candidate, note: str = "") -> str:
    """The text with the candidate as a free constant (E160 where it is stated)."""
    header, lines = lines_for(candidate)
    rows = text.split("\n")
    bare = header.replace(" ", "")
    plain = [row.split("#")[0].replace(" ", "").strip() for row in rows]
    at = [i for i, row in enumerate(plain) if row == bare]
    if not at:
        remark = [f"# {note}"] if note else []
        return "\n".join([text.rstrip("\n"), "", *remark, header, *lines, ""])
    key = lines[0].split("=")[0].strip()
    for i, row in enumerate(rows[at[0] + 1 :], at[0] + 1):
        if row.lstrip().startswith("["):
            break
        if row.split("=")[0].strip() == key:
            raise InputError(
                "E160",
                f"{candidate.name} is stated already",
                where=f"line {i + 1}",
                got=row.strip(),
                expected=lines[0],
                fix="replace the line by hand",
            )
    return "\n".join([*rows[: at[0] + 1], *lines, *rows[at[0] + 1 :]])


def amend(path: Path, candidate: Candidate, note: str = "") -> None:
    """Add a candidate to a project file (E160 where the result is not one)."""
    text = amended(path.read_text(encoding="utf-8"), candidate, note)

    def freed(found: Project) -> None:
        if candidate.name not in found.system.parameters.names:
            raise InputError("E160", f"{candidate.name} did not become free")

    try:
        replace_project(path, text, freed)
    except Sim2GPError as error:
        header, lines = lines_for(candidate)
        raise InputError(
            "E160",
            f"{candidate.name} cannot be added",
            where=str(path),
            got=f"{error.code} {error.what}",
            expected="a file that can end with a table more",
            fix="add by hand: " + ", ".join([header, *lines]),
        ) from error
