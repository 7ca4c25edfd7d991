"""The values of a project file against its shape; the first error in one line.

An unknown key, a missing one and a value of the wrong kind each name the line, what
was expected there, and what to write (`sim2gp.project.slips`).
"""

from collections.abc import Collection, Mapping
from typing import Any

from pydantic import ValidationError

from sim2gp.errors import InputError, error, nearest
from sim2gp.project import slips
from sim2gp.project.schema import RESERVED, ProjectSpec, keys_at
from sim2gp.project.source import Path_, ProjectSource

Fault = tuple[Path_, dict[str, Any]]

#: Pydantic's kinds of errors in the words of a project file.
_WORDS = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "string_type": "text in quotes",
    "string_pattern_mismatch": "a word without spaces and @",
    "bool_type": "true or false",
    "list_type": "a list in brackets",
    "tuple_type": "a list in brackets",
    "dict_type": "a table",
    "model_type": "a table",
}


def validate_project(source: ProjectSource) -> ProjectSpec:
    """The file's values as a `ProjectSpec`, or its first error (E141, E144, E160)."""
    try:
        return ProjectSpec.model_validate(source.values)
    except ValidationError as failure:
        errors: list[dict[str, Any]] = [{**error} for error in failure.errors()]
    faults = [(_present(error["loc"], source.values), error) for error in errors]
    above = {path[:end] for path, _ in faults for end in range(len(path))}
    deep = [(path, error) for path, error in faults if path not in above]
    path, error = min(deep, key=lambda fault: _order(source, fault[0]))
    if error["type"] == "missing":
        raise _missing_key(source, path, error)
    if error["type"] == "extra_forbidden":
        raise _unknown_key(source, path, error["input"])
    raise _wrong(source, path, error, [e for p, e in deep if p == path])


def _present(loc: Path_, values: Any) -> Path_:
    """The part of pydantic's location that the file spells; the rest names types."""
    path: Path_ = ()
    for part in loc:
        try:
            values = values[part]
        except (KeyError, IndexError, TypeError):
            continue
        path = (*path, part)
    return path


def _order(source: ProjectSource, path: Path_) -> int:
    return int(source.where(*path).split(":line ")[1].split(",")[0])


def _missing_key(
    source: ProjectSource, path: Path_, failure: dict[str, Any]
) -> InputError:
    name, value = str(failure["loc"][-1]), failure["input"]
    got = ", ".join(value)[:60] or "an empty table"
    return error("missing_key", where=source.where(*path), got=got, name=name)


def _unknown_key(source: ProjectSource, path: Path_, value: Any) -> InputError:
    where, key = source.where(*path), str(path[-1])
    if len(path) == 1 and key in RESERVED:
        named = key == "model" and isinstance(value, str)
        fix = f"write system = {slips.toml(value)}" if named else "remove it"
        return error("reserved_section", where=where, got=key, section=key, fix=fix)
    known = keys_at(path[:-1])
    fix = slips.fix_for_key(path, known) or "remove it"
    return error("unknown_key", where=where, got=key, known=", ".join(known), fix=fix)


def _wrong(
    source: ProjectSource,
    path: Path_,
    error: dict[str, Any],
    same: list[dict[str, Any]],
) -> InputError:
    """A value of another kind or size; ``same`` are all errors of its alternatives."""
    kind, value = error["type"], error["input"]
    expected = " or ".join(dict.fromkeys(describe_violation(e) for e in same))
    code = "E160"
    if kind == "finite_number" and path[-1] in ("low", "high"):
        code = "E141"
    elif {"sd", "relative_sd", "start_sd", "noise_floor"} & set(path):
        code = "E144" if kind in ("greater_than", "finite_number") else "E160"
    fix = slips.fix_for_value(path, value, expected)
    choices = [e["ctx"]["expected"] for e in same if e["type"] == "literal_error"]
    if choices and not fix:
        fix = slips.fix_for_choice(value, choices[0])
    return wrong_value(code, source.where(*path), value, expected, fix)


def wrong_value(
    code: str, where: str, value: Any, expected: str, fix: str
) -> InputError:
    """A value of another kind or size, and what to write where no slip is known."""
    plain = expected.startswith(("a ", "one ", "text", "true", "two "))
    return InputError(
        code,
        "wrong value",
        where=where,
        got=repr(value)[:40],
        expected=expected,
        fix=fix or (f"write {expected}" if plain else "correct the value"),
    )


def unknown(kind: str, name: str, known: Collection[str], where: str) -> InputError:
    """E160 with the name that was probably meant."""
    close = nearest(name, known)
    fix = f"did you mean {close}" if close else slips.suggest_table(name)
    fix = fix or ("use a known name" if known else "remove it")
    expected = "one of " + ", ".join(known) if known else f"no {kind}"
    return error(
        "unknown_name", where=where, got=name, expected=expected, fix=fix, what=kind
    )


def describe_violation(error: Mapping[str, Any]) -> str:
    """Pydantic's sentence in the words of a project file."""
    kind = error["type"]
    if kind in _WORDS:
        return _WORDS[kind]
    if kind == "literal_error":
        return f"one of {error['ctx']['expected']}"
    if kind in ("too_short", "too_long"):
        pair = error["ctx"].get("max_length", error["ctx"].get("min_length")) == 2
        return "two numbers, [low, high]" if pair else "a list that is not empty"
    message = str(error["msg"])
    return message.removeprefix("Input should be ").lower()
