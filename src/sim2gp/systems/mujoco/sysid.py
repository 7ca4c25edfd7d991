"""Parameter files of `mujoco.sysid`: its boxes become priors, posteriors its values.

A file of its ``ParameterDict`` holds for each name ``value``, ``nominal``,
``min_value``, ``max_value`` (arrays) and ``frozen``. What a name does to a model is a
function that the file does not hold: the names that are ours, such as
``joint/hinge/damping``, or a table of theirs and ours, say what each number is. Read is
what its writer writes: block YAML of mappings, lists and numbers, and nothing else.
"""

import ast
import json
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist

from sim2gp.errors import InputError, error, nearest
from sim2gp.inference.parameters import Parameter, Parameters

ARRAYS = ("value", "nominal", "min_value", "max_value")
LARGEST = 1_000_000  # bytes
#: Of a parameter without bounds: as many prior sd to each side of its median.
WIDE = 3.0
_KEY = re.compile(r"""^('(?:[^']|'')*'|"(?:[^"\\]|\\.)*"|[^\s'"?#&*-].*):$""")
_FIELD = re.compile(r"^  (\w+):(?: (.+))?$")
_ITEM = re.compile(r"^ {2,}((?:- ){1,2})(\S+)$")
_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?([eE][-+]?\d+)?|\.inf)|\.nan")


@dataclass
class Entry:
    """One parameter of a file; ``rows`` of its numbers, 0 for a plain list."""

    frozen: bool | None = None
    rows: int = 0
    numbers: dict[str, list[float]] = field(default_factory=dict)


def read_sysid(
    path: Path | str, names: Mapping[str, str] | None = None
) -> dict[str, Parameter | float]:
    """Priors out of a file of `mujoco.sysid.ParameterDict`, as `MuJoCo` takes them.

    A free number is a box between its bounds, with its nominal value; a frozen one is
    fixed at its value. ``names`` are theirs and ours: with it those alone are read,
    elements of an array as ``name[0]`` or ``name[0,1]``. Without it all are, under
    their own names.

    Raises `InputError` E130 for a file that cannot be read, E160 with the line of what
    is not understood, E145 for a name that is not there or is given twice, E141 for a
    box that is none, E142 for a nominal value outside of it, E101 for a fixed value
    that is not finite.
    """
    found = {
        name: (entry, i)
        for base, entry in _parsed(_read(Path(path)), Path(path)).items()
        for i, name in enumerate(_elements(base, entry))
    }
    pairs = {name: name for name in found} if names is None else dict(names)
    made: dict[str, Parameter | float] = {}
    for theirs, ours in pairs.items():
        if theirs not in found:
            close = nearest(theirs, found)
            fix = f"did you mean {close}?" if close else ""
            raise error("unknown_parameter", where=str(path), got=theirs, fix=fix)
        if ours in made:
            raise error("constant_read_twice", got=ours)
        made[ours] = _prior(ours, *found[theirs])
    return made


def write_sysid(
    path: Path | str,
    table: Parameters,
    values: Mapping[str, float] | None = None,
    names: Mapping[str, str] | None = None,
) -> None:
    """A table of parameters as a file for `mujoco.sysid.ParameterDict.load_from_disk`.

    ``values`` are those to begin from, such as a posterior's; nominal ones where it is
    silent. ``names`` are theirs and ours, as in `read_sysid`. Bounds are those of the
    prior; a parameter without them gets `WIDE` prior sd, and its value. Fixed
    parameters are frozen.

    Raises `InputError` E145 for a name that the table does not have, E101 for a value
    that is not finite, E130 where the file cannot be written.
    """
    nominal = table.nominal()
    given = dict(values or {})
    theirs = {ours: name for name, ours in (names or {}).items()}
    for name in (*given, *theirs):
        if name not in nominal:
            close = nearest(name, nominal)
            fix = f"did you mean {close}?" if close else ""
            raise error("unknown_parameter", got=name, fix=fix)
    free = {p.name: p for p in table.free}
    lines = []
    for name, usual in nominal.items():
        value = float(given.get(name, usual))
        if not math.isfinite(value):
            raise error("parameter_value_not_finite", got=value, name=name)
        low, high = _bounds(free[name], value) if name in free else (value, value)
        called = json.dumps(theirs.get(name, name), ensure_ascii=False)
        lines += [f"{called}:", f"  frozen: {str(name not in free).lower()}"]
        lines += [f"  max_value:\n  - {_number(high)}"]
        lines += [f"  min_value:\n  - {_number(low)}"]
        lines += [f"  name: {called}", f"  nominal:\n  - {_number(float(usual))}"]
        lines += [f"  value:\n  - {_number(value)}"]
    try:
        Path(path).write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    except OSError as caught:
        raise _refused(Path(path), caught) from caught


def _prior(name: str, entry: Entry, i: int) -> Parameter | float:
    value, nominal, low, high = (entry.numbers[each][i] for each in ARRAYS)
    if entry.frozen:
        if not math.isfinite(value):
            raise error("parameter_value_not_finite", got=value, name=name)
        return value
    parameter = Parameter(name, "", "", "bounded", low, high, nominal=nominal)
    if not low <= nominal <= high:
        raise error(
            "nominal_outside_box",
            got=f"{nominal:g}",
            name=name,
            low=f"{low:g}",
            high=f"{high:g}",
        )
    return parameter


def _bounds(p: Parameter, value: float) -> tuple[float, float]:
    """Of the prior; where it has none, so wide that the value is inside."""
    tail = NormalDist().cdf(-WIDE)
    low = p.low if math.isfinite(p.low) else min(p.quantile(tail), value)
    high = p.high if math.isfinite(p.high) else max(p.quantile(1.0 - tail), value)
    return low, high


def _number(x: float) -> str:
    """As YAML reads it: its floats have a point, ``1e-05`` would be a word."""
    mantissa, _, exponent = repr(x).partition("e")
    if not exponent:
        return mantissa
    return f"{mantissa}{'' if '.' in mantissa else '.0'}e{exponent}"


def _elements(base: str, entry: Entry) -> list[str]:
    """The names that `mujoco.sysid` gives to the numbers of one parameter."""
    count, rows = len(entry.numbers["value"]), entry.rows
    if count == 1:
        return [base]
    if rows == 0:
        return [f"{base}[{i}]" for i in range(count)]
    return [f"{base}[{i},{j}]" for i in range(rows) for j in range(count // rows)]


def _read(path: Path) -> str:
    try:
        if os.path.getsize(path) > LARGEST:
            raise error("large_parameter_file", where=str(path), limit=LARGEST)
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as caught:
        raise _refused(path, caught) from caught


def _refused(path: Path, caught: OSError | UnicodeDecodeError) -> InputError:
    reason = getattr(caught, "strerror", None) or str(caught)
    return error("unreadable_parameter_file", where=str(path), got=reason)


def _parsed(text: str, path: Path) -> dict[str, Entry]:
    """The entries of a file, line by line."""
    found: dict[str, Entry] = {}
    entry, array = Entry(), ""
    for number, line in enumerate(text.splitlines(), 1):
        where = f"{path}, line {number}"
        if not line.strip():
            continue
        if key := _KEY.match(line):
            name, entry, array = _name(key[1], where), Entry(), ""
            if name in found:
                raise error("parameter_twice_in_file", where=where, got=name)
            found[name] = entry
        elif found and (each := _FIELD.match(line)):
            array = each[1] if each[1] in ARRAYS and each[2] is None else ""
            if each[1] == "frozen" and each[2] in ("true", "false"):
                entry.frozen = each[2] == "true"
            elif array:
                entry.numbers[array], entry.rows = [], 0
            elif each[1] != "name":
                raise _odd(line, where)
        elif array and (item := _ITEM.match(line)) and _NUMBER.fullmatch(item[2]):
            entry.rows += len(item[1]) == 4  # "- - " begins a row
            word = item[2].replace(".inf", "inf").replace(".nan", "nan")
            entry.numbers[array].append(float(word))
        else:
            raise _odd(line, where)
    for name, read in found.items():
        sizes = {len(read.numbers.get(array, ())) for array in ARRAYS}
        if read.frozen is None or len(sizes) != 1 or 0 in sizes:
            arrays = ", ".join(ARRAYS)
            raise error("incomplete_entry", where=str(path), name=name, arrays=arrays)
    return found


def _name(word: str, where: str) -> str:
    """A key without its quotes."""
    if word[0] == "'":
        return word[1:-1].replace("''", "'")
    if word[0] != '"':
        return word
    try:
        return str(ast.literal_eval(word))
    except (ValueError, SyntaxError) as error:
        raise _odd(word, where) from error


def _odd(line: str, where: str) -> InputError:
    return error("odd_parameter_line", where=where, got=repr(line.strip()[:60]))
