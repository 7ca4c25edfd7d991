"""A project file gets one more piece of physics; all else in it stays as it is.

tomlkit keeps comments, order and layout. The new text is read like any project file
before it replaces the old one, whole or not at all.
"""

import dataclasses
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.items import AbstractTable, InlineTable

from sim2gp.errors import InputError, Sim2GPError, error
from sim2gp.project.project import Project
from sim2gp.project.replace import replace_project
from sim2gp.project.schema import EFFECT_OPTIONS
from sim2gp.systems import Candidate, Delay, Lag
from sim2gp.systems.effects import tables

_NOTE = "added by sim2gp"


def addition(candidate: Candidate) -> tuple[tuple[str, ...], dict[str, Any]]:
    """The table that frees a candidate, and its entries (E160 for a lag)."""
    effect = candidate.effect
    if isinstance(effect, tables.AbstractTable):
        points = tomlkit.array()
        points.extend([list(point) for point in effect.points])
        return ("effects", effect.where, effect.what), {"points": points}
    if not isinstance(effect, Delay | Lag):
        entries: dict[str, Any] = {"mean": 0.0, "sd": effect.magnitude}
        for field in dataclasses.fields(effect):
            value = getattr(effect, field.name)
            if field.name in EFFECT_OPTIONS and value != field.default:
                entries[field.name] = value
        return ("effects", effect.where, effect.what), entries
    if isinstance(effect, Delay):
        bounds = tomlkit.inline_table()
        bounds.update({"low": 0.0, "high": effect.magnitude})
        return ("actuators", effect.where), {"delay": bounds}
    raise error("lag_in_project_file", got=candidate.name, channel=effect.where)


def amend_text(text: str, candidate: Candidate, note: str = _NOTE) -> str:
    """The text with the candidate as a free parameter (E160 where it is stated)."""
    place, entries = addition(candidate)
    document = tomlkit.parse(text)
    table: Any = document
    for depth, name in enumerate(place):
        if name not in table:
            table.append(name, _table_in(table, note * (depth == len(place) - 1)))
        table = table[name]
        if not isinstance(table, AbstractTable):
            raise _already_stated(candidate, ".".join(place[: depth + 1]), table)
    for key, value in entries.items():
        if key in table:
            raise _already_stated(candidate, ".".join([*place, key]), table[key])
        table.append(key, value)
    return tomlkit.dumps(document)


def _table_in(parent: Any, note: str) -> Any:
    """A new table: inline where its parent is, else with a header or parts below."""
    if isinstance(parent, InlineTable):
        return tomlkit.inline_table()
    table = tomlkit.table(is_super_table=not note)
    if note:
        table.add(tomlkit.comment(note))
    return table


def _already_stated(candidate: Candidate, key: str, value: Any) -> InputError:
    got = tomlkit.item(value).as_string()
    return error("stated_already", where=f"key {key}", got=got, name=candidate.name)


def amend(path: Path, candidate: Candidate, note: str = _NOTE) -> None:
    """Add a candidate to a project file (E160 where the result is not one)."""
    text = amend_text(path.read_text(encoding="utf-8"), candidate, note)

    def freed(found: Project) -> None:
        known = found.system.parameters
        fixed = isinstance(candidate.effect, tables.AbstractTable)
        if candidate.name not in (dict(known.fixed) if fixed else known.names):
            raise error("did_not_become_free", name=candidate.name)

    try:
        replace_project(path, text, freed)
    except Sim2GPError as caught:
        place, entries = addition(candidate)
        lines = [f"{key} = {tomlkit.item(v).as_string()}" for key, v in entries.items()]
        raise error(
            "cannot_be_added",
            where=str(path),
            got=f"{caught.code} {caught.what}",
            name=candidate.name,
            lines=", ".join([f"[{'.'.join(place)}]", *lines]),
        ) from caught
