"""Arguments are checked before they are parsed: each fault is one clear line."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Sequence
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from sim2gp.errors import InputError, nearest

MAX_SEED = 2**32 - 1


def check_arguments(args: Sequence[str], commands: dict[str, type]) -> None:
    """Commands, options, choices and numbers are known and well-formed.

    Raises `InputError` E148 for a number out of range, E149 for a seed, E160 otherwise.
    """
    name = args[0]
    if name not in commands:
        kind = "option" if name.startswith("-") else "command"
        known = ["--help", "--version"] if kind == "option" else list(commands)
        raise _unknown(kind, name, known)
    fields = _fields(commands[name])
    optional = _optional(commands[name])
    options = {option: kind for option, (kind, _) in fields.items() if option[0] == "-"}
    loose: list[str] = []
    words = list(args[1:])
    while words:
        word = words.pop(0)
        if not word.startswith("-") or word == "-":
            loose.append(word)
            continue
        option, given, value = word.partition("=")
        option = option.replace("_", "-")
        if option not in options:
            raise _unknown("option", option, options)
        kind = options[option]
        if kind is bool:
            continue
        values = [value] if given else _values(words, many=get_origin(kind) is tuple)
        if not values or not values[0]:
            raise usage_error(option, "nothing", f"{option} VALUE", "add the value")
        _check_value(option, values[0], kind)
    wanted = {n: k for n, k in fields.items() if n[0] != "-"}
    _check_loose(loose, wanted, sum(n not in optional for n in wanted))


def usage_error(
    what: str, got: str, expected: str, fix: str, code: str = "E160"
) -> InputError:
    """A fault in the arguments."""
    where = "the command line"
    return InputError(code, what, where=where, got=got, expected=expected, fix=fix)


def numbers(option: str, words: Iterable[str]) -> dict[str, float]:
    """``NAME=NUMBER`` words by name (E160 for another form, or a name twice)."""
    return {name: _number(option, word, v) for name, v, word in _named(option, words)}


def pairs(option: str, words: Iterable[str]) -> dict[str, tuple[float, float]]:
    """``NAME=LOW:HIGH`` words by name (E141 where low is not below high, E160)."""
    found = {}
    for name, value, word in _named(option, words):
        ends = [_number(option, word, end) for end in value.split(":")]
        if len(ends) != 2:
            raise usage_error(option, word, f"{name}=LOW:HIGH", "write both ends")
        if not ends[0] < ends[1]:
            raise usage_error(option, word, "LOW below HIGH", "swap the two", "E141")
        found[name] = ends[0], ends[1]
    return found


def _named(option: str, words: Iterable[str]) -> Iterator[tuple[str, str, str]]:
    seen: set[str] = set()
    for word in words:
        name, _, value = word.partition("=")
        if not (name and value):
            raise usage_error(option, word, "NAME=VALUE", "write name and value")
        if name in seen:
            raise usage_error(option, word, "each name once", "remove one of the two")
        seen.add(name)
        yield name, value, word


def _number(option: str, word: str, text: str) -> float:
    if not (_is_number(text) and math.isfinite(float(text))):
        raise usage_error(option, word, "finite numbers", "correct the number")
    return float(text)


def _fields(command: type) -> dict[str, tuple[Any, str]]:
    """Type and shown name of each option (--name) and each positional (name)."""
    hints = get_type_hints(command, include_extras=True)
    found = {}
    for field in dataclasses.fields(command):
        kind, loose, shown = hints[field.name], False, field.name.upper()
        if get_origin(kind) is Annotated:
            kind, *marks = get_args(kind)
            shown = next((m.metavar for m in marks if hasattr(m, "metavar")), shown)
            # tyro's Positional is the only mark that carries no fields.
            loose = any(not hasattr(mark, "metavar") for mark in marks)
        name = field.name if loose else "--" + field.name.replace("_", "-")
        found[name] = (kind, shown or field.name.upper())
    return found


def _optional(command: type) -> set[str]:
    """The fields that have a default."""
    missing = dataclasses.MISSING
    return {f.name for f in dataclasses.fields(command) if f.default is not missing}


def _values(words: list[str], many: bool) -> list[str]:
    """Take the value, or all, that follow an option; a number may be negative."""
    taken: list[str] = []
    while words and (many or not taken):
        minus = words[0].startswith("-")
        if minus and (many or not _is_number(words[0])):
            break
        taken.append(words.pop(0))
    return taken


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _check_loose(
    words: list[str], wanted: dict[str, tuple[Any, str]], least: int
) -> None:
    shown = [name for _, name in wanted.values()]
    many = bool(wanted) and get_origin([*wanted.values()][-1][0]) is tuple
    if len(words) > len(wanted) and not many:
        expected = " ".join(shown) or "options only"
        word = words[len(wanted)]
        raise usage_error("unexpected argument", word, expected, "remove it")
    if len(words) < least:
        got, lacking = " ".join(words) or "nothing", shown[len(words)]
        raise usage_error(f"missing {lacking}", got, " ".join(shown), f"add {lacking}")
    for word, (kind, name) in zip(words, wanted.values(), strict=False):
        _check_value(name, word, kind)


def _check_value(name: str, value: str, kind: Any) -> None:
    if get_origin(kind) in (UnionType, Union):  # of something and None
        kind = get_args(kind)[0]
    if get_origin(kind) is Literal:
        choices = get_args(kind)
        if value not in choices:
            close = nearest(value, choices)
            fix = f"did you mean {close}" if close else "choose one of these"
            raise usage_error(name, value, "one of " + ", ".join(choices), fix)
    elif kind in (int, float):
        _check_number(name, value, kind)


def _check_number(option: str, value: str, kind: type) -> None:
    seed = option == "--seed"
    low, code = (0, "E149") if seed else (1, "E148")
    if kind is float:
        expected = "a positive number"
        good = _is_number(value) and 0 < float(value) < float("inf")
    else:
        expected = f"a whole number from {low} to {MAX_SEED}"
        good = value.isascii() and value.isdigit() and low <= int(value) <= MAX_SEED
    if not good:
        raise usage_error(option, value, expected, "correct the number", code)


def _unknown(kind: str, name: str, known: Iterable[str]) -> InputError:
    known = list(known)
    close = nearest(name, known)
    fix = f"did you mean {close}" if close else "see sim2gp --help"
    return usage_error(f"unknown {kind}", name, "one of " + ", ".join(known), fix)
