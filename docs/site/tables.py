"""The tables of docs/ that repeat what the code says, written from it.

    python docs/site/tables.py

Keys of project files come from their specification (`sim2gp.project.schema`), codes
from the catalogue of errors. The rest of these pages is left alone.
"""

import ast
import inspect
import re
import tomllib
from pathlib import Path
from typing import Any

from sim2gp.errors import CODES
from sim2gp.project import schema

DOCS = Path(__file__).resolve().parents[1]
SPEC = schema.ProjectSpec.model_json_schema()
#: The section whose keys each heading lists. `TABLES` has some twice: the last one
#: put in wins, so that is the first.
SECTIONS: dict[str, type[schema.Section]] = {
    "The whole file" if not path else header: model
    for header, path, model in reversed(schema.TABLES)
    if model is not schema.PriorSpec and path != ("logs", "time")
}


def pages() -> dict[str, str]:
    """Each page as it should be."""
    codes = tomllib.loads(CODES.read_text(encoding="utf-8"))
    tables = {
        "project_file.md": {head: keys(model) for head, model in SECTIONS.items()},
        "codes.md": {
            chapter: table(["code", "what"], [[f"`{c}`", t] for c, t in meant.items()])
            for chapter, meant in codes.items()
        },
    }
    return {
        name: written((DOCS / name).read_text(encoding="utf-8"), below)
        for name, below in tables.items()
    }


def written(page: str, tables: dict[str, str]) -> str:
    """The page with the first table below each heading replaced."""
    for heading, new in tables.items():
        head = rf"(^## {re.escape(heading)}\n(?:(?!## |\|).*\n)*)"
        found = re.compile(head + r"(?:\|.*\n)+", re.MULTILINE)
        page, count = found.subn(lambda m, new=new: m[1] + new, page, count=1)
        if count == 0:
            raise LookupError(f"no table below {heading}")
    return page


def table(columns: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [columns, ["---"] * len(columns), *rows]
    ruled = "|".join(lines[1])
    texts = [f"| {' | '.join(line)} |" for line in lines]
    return "\n".join([texts[0], f"|{ruled}|", *texts[2:]]) + "\n"


def keys(model: type[schema.Section]) -> str:
    """Key, value, default and meaning of every key of a section."""
    about = SPEC if model is schema.ProjectSpec else SPEC["$defs"][model.__name__]
    meant = meanings(model)
    if model is schema.ParameterSpec:
        meant = meanings(schema.PriorSpec) | meant
    required = about.get("required", [])
    shown = about["properties"]
    if model is schema.EffectSpec:
        shown = {key: shown[key] for key in schema.EFFECT_OPTIONS}
    rows = [
        [f"`{key}`", words(value), stated(value, key in required), meant[key]]
        for key, value in shown.items()
    ]
    return table(["key", "value", "default", "meaning"], rows)


def meanings(model: type[schema.Section]) -> dict[str, str]:
    """The text below each key of a section's own."""
    (body,) = ast.parse(inspect.getsource(model)).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for key, text in zip(body.body, body.body[1:], strict=False):
        match key, text:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(said))),
            ):
                found[name] = " ".join(said.split())
    return found


def words(about: dict[str, Any]) -> str:
    """What a key may hold, from its JSON schema."""
    if "$ref" in about:
        prior = about["$ref"].endswith(("PriorSpec", "ParameterSpec"))
        return "prior" if prior else "table"
    if "anyOf" in about:
        kinds = [words(each) for each in about["anyOf"] if each.get("type") != "null"]
        if kinds[-1] == "prior":  # a number is the shortest prior
            kinds = ["prior", *kinds[1:-1]]
        return " or ".join(dict.fromkeys(kinds))
    if "enum" in about:
        return "one of " + ", ".join(str(each) for each in about["enum"])
    if "const" in about:
        return f'"{about["const"]}"'
    if about.get("maxItems") == 2:
        return "[low, high]"
    inner = about.get("items", about.get("additionalProperties"))
    many = words(inner) if isinstance(inner, dict) else ""
    many = "tables" if many.startswith("table") else many
    many = "priors" if many == "prior" else many
    of = f" of {many}" if many else ""
    names = {"number": "number", "integer": "whole number", "string": "text"}
    names |= {"boolean": "true or false", "array": f"list{of}", "object": f"table{of}"}
    least = {"exclusiveMinimum": " > 0", "minimum": " >= 0"}
    bound = next((text for key, text in least.items() if key in about), "")
    return names[about["type"]] + bound


def stated(about: dict[str, Any], required: bool) -> str:
    """A key's default."""
    value = about.get("default")
    if required:
        return "required"
    if value is None or isinstance(value, dict):
        return "-"
    return str(value).lower() if isinstance(value, bool) else str(value)


if __name__ == "__main__":
    for name, text in pages().items():
        (DOCS / name).write_text(text, encoding="utf-8")
