"""What the reference generator does not read by itself: fields of records.

Classes here are mostly records (`eqx.Module`), whose fields are their constructor, and
whose docstrings explain fields in lines ``name: meaning``. The first becomes a line of
code, the second a list.
"""

import ast
import re

import griffe

FIELD = re.compile(r"^(\w+(?:, \w+)*): ", re.MULTILINE)


class Fields(griffe.Extension):
    """Shows the constructor of every record, and its explained fields as a list."""

    def on_class_members(self, *, cls: griffe.Class, **_: object) -> None:
        """Rewrite the docstring of a class once its members are known."""
        if cls.docstring is None:
            return
        text, fields = listed(cls.docstring.value), constructor(cls)
        if fields:
            call = f"{cls.name}({', '.join(fields)})"
            if len(call) > 80:
                call = f"{cls.name}(\n    " + ",\n    ".join(fields) + ",\n)"
            text += f"\n\n```python\n{call}\n```"
        cls.docstring.value = text

    def on_function_instance(self, *, func: griffe.Function, **_: object) -> None:
        """Arguments that a function explains in lines are a list too."""
        if func.docstring is not None:
            func.docstring.value = listed(func.docstring.value)


def constructor(cls: griffe.Class) -> list[str]:
    """The fields that make a record; none where it has a constructor of its own."""
    bases = {str(base).rpartition(".")[2] for base in cls.bases}
    plain = not any(str(d.value).startswith("dataclass") for d in cls.decorators)
    if "__init__" in cls.members or (plain and not bases):
        return []
    found = []
    for name, member in cls.members.items():
        if not isinstance(member, griffe.Attribute) or member.annotation is None:
            continue
        computed = "property" in member.labels
        if computed or re.search(r"ClassVar|AbstractVar", str(member.annotation)):
            continue
        default = None if member.value is None else stated(str(member.value))
        found.append(name if default is None else f"{name}={default}")
    return found


def stated(value: str) -> str | None:
    """A field's default: ``field(static=True, default=3)`` says 3."""
    node = ast.parse(value, mode="eval").body
    if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("field"):
        given = {k.arg: ast.unparse(k.value) for k in node.keywords}
        return given.get("default")
    return value


def listed(text: str) -> str:
    """Lines ``name: meaning``, and what belongs to them, as a list of Markdown."""
    parts = []
    for part in text.split("\n\n"):
        if FIELD.match(part):
            part = FIELD.sub(r"- `\1`: ", part)
        parts.append(part)
    return "\n\n".join(parts)
