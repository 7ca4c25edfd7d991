"""Message definitions of ROS, read by a strict grammar before any library sees them.

`rosbags` builds Python classes and functions from a definition, with ``exec``. It is
given a text that is written here from what was parsed: names, types, array bounds and
constants. Comments, defaults and everything that does not parse stay out.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

from sim2gp.data.logs.budget import Meter
from sim2gp.errors import InputError, error

NUMBERS = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
#: Of ROS 1, and what `rosbags` makes of them.
_COMMON = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}
_BUILT_IN = {_COMMON["time"]: 8, _COMMON["duration"]: 8}  # bytes

MAX_TEXT = 2**20  # characters of a topic's definition, with all that it needs
MAX_TYPES = 512
MAX_FIELDS = 4096  # of all its types; an array of texts or messages counts each entry
MAX_ENTRIES = 2**28  # of an array of numbers
MAX_DEPTH = 32
MAX_OBJECTS = 2**16  # in one message, without what its bytes list

_PACKAGE = r"[a-z](?:_?[a-z0-9]){0,127}"
_MESSAGE = r"[A-Za-z](?:_?[A-Za-z0-9]){0,127}"
_TYPE = re.compile(rf"({_PACKAGE})/(?:(msg|action)/)?({_MESSAGE})")
_FIELD = re.compile(
    rf"(?P<type>string<=[0-9]{{1,9}}|(?:{_PACKAGE}/(?:msg/|action/)?)?{_MESSAGE})"
    r"(?P<array>\[(?:<=)?[0-9]{0,10}\])?[ \t]+"
    r"(?P<name>[A-Za-z][A-Za-z0-9_]{0,127})(?![A-Za-z0-9_/])"
)
_CONSTANT = re.compile(r"[A-Z](?:_?[A-Z0-9])*")
_NUMBER = re.compile(
    r"[+-]?(?:0[xX][0-9a-fA-F]{1,16}|0b[01]{1,64}|[0-9]{1,40}(?:\.[0-9]{0,40})?"
    r"(?:[eE][+-]?[0-9]{1,4})?|\.[0-9]{1,40}(?:[eE][+-]?[0-9]{1,4})?)"
    r"|[tT]rue|[fF]alse"
)
_QUOTED = re.compile(r"\"[^\"\\]*\"|'[^'\\]*'")
_PRINTED = re.compile(r"[ -!$-&(-\[\]-~]*")  # without quotes, backslash and comment
_SEPARATOR = "=" * 80


@dataclass(frozen=True)
class Field:
    """A field: its type by full name or a number's, and its array, if it is one.

    ``count`` is the length of a fixed array, 0 of a sequence, None of a single value.
    """

    name: str
    type: str
    written: str  # type and array as the file has them
    count: int | None

    @property
    def is_plain(self) -> bool:
        """Whether it is a number, or an array of them."""
        return self.type in NUMBERS


@dataclass
class Definition:
    """The fields of a message type, and its constants as lines."""

    name: str
    fields: list[Field] = field(default_factory=list)
    constants: list[str] = field(default_factory=list)
    names: set[str] = field(default_factory=set)
    whole: bool = True  # all its constants are among them


@dataclass(frozen=True)
class Size:
    """What one value of a type needs: bytes at least, objects at least, and depth."""

    bytes: int
    objects: int
    depth: int


@dataclass(frozen=True)
class Definitions:
    """A topic's definition: its own type first, then those that it needs."""

    types: dict[str, Definition]
    nested: bool  # a message lists texts or other messages, as many as it likes

    @property
    def whole(self) -> bool:
        """Whether every constant was taken over."""
        return all(each.whole for each in self.types.values())

    def written(self) -> str:
        """The text for `rosbags`, without the name of the first type."""
        parts = []
        for each in self.types.values():
            lines = [*each.constants, *(f"{f.written} {f.name}" for f in each.fields)]
            parts.append((each.name, "\n".join([*lines, ""])))
        head, *rest = parts
        return head[1] + "".join(
            f"{_SEPARATOR}\nMSG: {name}\n{text}" for name, text in rest
        )


def parse_definition(text: str, name: str, meter: Meter) -> Definitions:
    """The definition of the type ``name`` (E126 for its size, E136 for its form)."""
    if len(text) > MAX_TEXT:
        raise meter.over(
            "message definition too large",
            f"{len(text)} characters",
            f"at most {MAX_TEXT}",
        )
    types: dict[str, Definition] = {}
    current = _begin(name, types, meter)
    fields, lines = 0, iter(text.split("\n"))
    for line in lines:
        meter.tick()
        line = line.strip(" \t\r")
        if line == _SEPARATOR:
            head = next(lines, "").strip(" \t\r")
            if not head.startswith("MSG: "):
                raise _definition_refused(head, "MSG: and the name of a type", meter)
            current = _begin(head.removeprefix("MSG: ").strip(), types, meter)
        elif line and not line.startswith("#") and not re.fullmatch("@[a-z]+", line):
            fields += _add_line(line, current, meter)
            if fields > MAX_FIELDS or len(types) > MAX_TYPES:
                raise meter.over(
                    "message definition too large",
                    f"{fields} fields in {len(types)} types",
                    f"at most {MAX_FIELDS} in {MAX_TYPES}",
                )
    sizes: dict[str, Size] = {}
    _measure(next(iter(types)), types, sizes, (), meter)
    kept = {key: types[key] for key in [next(iter(types)), *sizes] if key in types}
    nested = any(
        f.count == 0 and not f.is_plain for each in kept.values() for f in each.fields
    )
    return Definitions(kept, nested)


def full_name(name: str) -> str | None:
    """``package/msg/Type``, as ROS 2 writes it; None for what is no name."""
    found = _TYPE.fullmatch(name)
    return found and f"{found[1]}/{found[2] or 'msg'}/{found[3]}"


def _begin(name: str, types: dict[str, Definition], meter: Meter) -> Definition:
    full = full_name(name)
    if full is None:
        raise _definition_refused(name, "package/Type", meter)
    if full in types:
        raise _definition_refused(name, "each type once", meter)
    types[full] = Definition(full)
    return types[full]


def _add_line(line: str, into: Definition, meter: Meter) -> int:
    """Take over a field or a constant; how many fields it counts as."""
    found = _FIELD.match(line)
    if not found:
        raise _definition_refused(line, "TYPE NAME, or TYPE NAME=NUMBER", meter)
    kind, array, name = found["type"], found["array"], found["name"]
    rest = line[found.end() :].strip(" \t")
    if name in into.names:
        raise _definition_refused(line, "each name once", meter)
    into.names.add(name)
    is_text = kind.startswith("string")
    if rest.startswith("="):
        value = rest[1:].strip(" \t")
        if array or not (is_text or kind in NUMBERS):
            raise _definition_refused(line, "a constant of a number or a text", meter)
        if not is_text:
            value = value.split("#")[0].strip(" \t")
            if not _NUMBER.fullmatch(value):
                raise _definition_refused(line, "a constant with a number", meter)
        known = kind == "string" or not is_text
        if known and _CONSTANT.fullmatch(name) and _PRINTED.fullmatch(value or "#"):
            into.constants.append(f"{kind} {name}={value}")
        else:
            into.whole = False  # numbers alone are read: such a constant has no use
        return 1
    if rest and not rest.startswith("#") and not _is_default(rest, is_text):
        raise _definition_refused(line, "a default that is a literal", meter)
    count, full = _array_length(array), _resolved(kind, into.name)
    if full is None:
        raise _definition_refused(line, "a type of ROS", meter)
    plain = full in NUMBERS
    if count is not None and count > (MAX_ENTRIES if plain else MAX_FIELDS):
        raise meter.over(
            "array of a message definition too large",
            f"{line[:60]!r}",
            f"at most {MAX_ENTRIES} numbers or {MAX_FIELDS} others",
        )
    into.fields.append(Field(name, full, kind + (array or ""), count))
    return 1 if plain else max(1, count or 0)


def _array_length(array: str | None) -> int | None:
    if array is None:
        return None
    digits = array.strip("[]")
    return 0 if digits.startswith("<=") or not digits else int(digits)


def _resolved(kind: str, owner: str) -> str | None:
    """The full name of a field's type; "string" for texts of any length."""
    if kind.startswith("string"):
        return "string"
    if kind in NUMBERS:
        return kind
    if kind in _COMMON:
        return _COMMON[kind]
    return full_name(kind if "/" in kind else f"{owner.rpartition('/')[0]}/{kind}")


def _is_default(text: str, is_text: bool) -> bool:
    """A literal, or literals in brackets; a comment may follow."""
    if text.startswith("["):
        inside, closed, after = text[1:].rpartition("]")
        after = after.strip(" \t")
        items = [item.strip(" \t") for item in inside.split(",")]
        is_literal = all(
            _NUMBER.fullmatch(i) or _QUOTED.fullmatch(i) for i in items if i
        )
        return bool(closed) and is_literal and (not after or after.startswith("#"))
    quoted = _QUOTED.match(text)
    if quoted:
        after = text[quoted.end() :].strip(" \t")
        return not after or after.startswith("#")
    bare = text.split("#")[0].strip(" \t")
    return bool((_PRINTED if is_text else _NUMBER).fullmatch(bare))


def _measure(
    name: str,
    types: dict[str, Definition],
    sizes: dict[str, Size],
    above: tuple[str, ...],
    meter: Meter,
) -> Size:
    """A type's size; none contains itself, and what it lists has bytes of its own."""
    if name in sizes:
        return sizes[name]
    if name in _BUILT_IN and name not in types:
        return Size(_BUILT_IN[name], 1, 1)
    if name not in types:
        raise _definition_refused(name, "a type that the definition holds", meter)
    if name in above or len(above) >= MAX_DEPTH:
        raise _definition_refused(
            name, f"types in types, at most {MAX_DEPTH} deep", meter
        )
    size, objects, depth = 0, 1, 1
    for each, part in _field_sizes(name, types, sizes, above, meter):
        if each.count == 0:
            size += 4
            if part.objects > part.bytes + 8:
                raise _definition_refused(
                    f"{each.written} {each.name}", "entries of bytes", meter
                )
        else:
            size += part.bytes * (1 if each.count is None else each.count)
            objects += part.objects * (1 if each.count is None else each.count)
        depth = max(depth, part.depth + 1)
    if objects > MAX_OBJECTS:
        raise meter.over(
            "message definition too large",
            f"{objects} values in {name}",
            f"at most {MAX_OBJECTS}",
        )
    sizes[name] = Size(size, objects, depth)
    return sizes[name]


def _field_sizes(
    name: str,
    types: dict[str, Definition],
    sizes: dict[str, Size],
    above: tuple[str, ...],
    meter: Meter,
) -> Iterator[tuple[Field, Size]]:
    for each in types[name].fields:
        if each.is_plain:  # an array of numbers is one object
            yield each, Size(NUMBERS[each.type], 0, 0)
        elif each.type == "string":
            yield each, Size(4, 1, 0)
        else:
            yield each, _measure(each.type, types, sizes, (*above, name), meter)


def _definition_refused(got: str, expected: str, meter: Meter) -> InputError:
    return error(
        "message_definition_refused",
        where=meter.at,
        got=repr(got[:60]),
        expected=expected,
    )
