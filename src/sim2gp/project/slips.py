"""What to write instead: the slips that users of a project file make.

TOML is strict, and so are the types here; what was meant is nearly always plain. Each
function returns a fix in a few words, or nothing where it knows none.
"""

import difflib
import json
import re
from collections.abc import Collection
from typing import Any

from sim2gp.errors import nearest
from sim2gp.project.schema import TABLES, LogSpec, ProjectSpec
from sim2gp.project.source import Path_
from sim2gp.project.syntax import LISTS, PARTS

#: Words of other tools for keys of ours.
SYNONYMS = {
    "min": "low",
    "minimum": "low",
    "lower": "low",
    "max": "high",
    "maximum": "high",
    "upper": "high",
    "std": "sd",
    "stdev": "sd",
    "stddev": "sd",
    "sigma": "sd",
    "mu": "mean",
    "fix": "value",
    "fixed": "value",
    "nominal": "value",
    "path": "files",
    "paths": "files",
    "dt": "period",
    "robot": "system",
    "machine": "system",
    "latency": "delay",
}
_ALIKE = 0.8  # how like a known key a misspelt one is that can be nothing else
_NUMBER = r"[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?"


def toml(value: Any) -> str:
    """A short text, number or list as TOML writes it; a date as text."""
    return json.dumps(value, ensure_ascii=False, default=str)


def suggest_table(key: str) -> str:
    """Where a key of another table belongs."""
    if key in ProjectSpec.model_fields:
        kind = ProjectSpec.model_fields[key].annotation
        return f"write {key} at the top" if kind is str else f"write [{key}] by itself"
    headers = [header for header, _, model in TABLES if key in model.model_fields]
    return f"{key} is a key of {headers[0]}" if headers else ""


def fix_for_key(path: Path_, known: Collection[str]) -> str:
    """For a key that its table does not have."""
    key = str(path[-1])
    if key in PARTS and len(path) > 1:
        return f'write the name in quotes: "{path[-2]}.{key}"'
    meant = SYNONYMS.get(key)
    if meant in known:
        return f"did you mean {meant}"
    if difflib.get_close_matches(key.lower(), known, n=1, cutoff=_ALIKE):
        return f"did you mean {nearest(key, known)}"
    close = nearest(key, known)
    return suggest_table(key) or (f"did you mean {close}" if close else "")


def fix_for_choice(value: Any, expected: str) -> str:
    """For a word that is none of pydantic's list of choices."""
    choices = expected.replace("'", "").replace(" or ", ", ").split(", ")
    close = nearest(value, choices) if isinstance(value, str) else None
    return f"did you mean {close!r}" if close else ""


def fix_for_value(path: Path_, value: Any, expected: str) -> str:
    """For a value of another kind than its key has."""
    key = str(path[-1])
    if isinstance(value, str):
        return _of_text(key, value, expected)
    if isinstance(value, dict):
        return _of_table(path, value)
    if isinstance(value, list):
        return _of_list(path, value, expected)
    if isinstance(value, bool | int | float) and expected == "true or false":
        return "write true" if value else "write false"
    if key == "time":
        return f"write period = {toml(value)}"
    if path[0] == "effects" and len(path) < 3:
        return f"write [effects.CHANNEL.{key}]"
    if path[0] == "actuators" and len(path) == 2:
        return f"write [actuators.INPUT] and below it {key} = {toml(value)}"
    if "exclude" in path:
        return "write each interval in brackets: exclude = [[12.0, 13.5]]"
    if path[0] == "limits" or key == "saturation":
        return f"write {_quoted_key(key)} = [{-abs(value)}, {abs(value)}]"
    return ""


def _of_text(key: str, value: str, expected: str) -> str:
    if "list" in expected:
        return f"write {_quoted_key(key)} = [{toml(value)}]"
    if expected == "true or false":
        return {"yes": "write true", "no": "write false"}.get(value.lower(), "")
    found = re.fullmatch(rf"({_NUMBER})(.*)", value.strip())
    if found is None or "number" not in expected:
        return ""
    if not found[2]:
        return "write the value without quotes"
    return f"write {found[1]}, in the unit of its channel or parameter"


def _of_table(path: Path_, value: dict[str, Any]) -> str:
    key, inner = str(path[-1]), next(iter(value), "")
    if len(path) == 1 and key in LISTS:
        return f"write [[{key}]]"
    if inner in PARTS:
        return f'write the name in quotes: "{key}.{inner}"'
    return ""


def _of_list(path: Path_, value: list[Any], expected: str) -> str:
    key = str(path[-1])
    if value and all(isinstance(each, dict) for each in value):
        names = ".".join(_quoted_key(str(p)) for p in path if isinstance(p, str))
        return f"write [{names}], once and in single brackets"
    if key in LogSpec.model_fields and "columns" in path[:-1]:
        return f"write {key} above [logs.columns]"
    pair = len(value) == 2 and all(isinstance(x, int | float) for x in value)
    if pair and path[0] in ("parameters", "effects", "actuators"):
        return f"write {{low = {toml(value[0])}, high = {toml(value[1])}}}"
    return ""


def _quoted_key(name: str) -> str:
    return name if re.fullmatch(r"[\w-]+", name) else f'"{name}"'
