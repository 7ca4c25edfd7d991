"""From words to a command: tyro parses them, and each error is one clear line."""

import contextlib
import io
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, NoReturn, Union, get_args, get_type_hints

import tyro
from tyro.conf import subcommand

from sim2gp.cli.options import Common, Range
from sim2gp.errors import InputError, nearest

PROGRAM = "sim2gp"
_NAMES = re.compile(r"--[a-z][\w-]*|(?<=')[\w.-]+(?=')")


def parse_command(
    args: Sequence[str], commands: dict[str, type[Common]]
) -> Common | None:
    """The command that the words are; None where a help page was printed.

    Raises `InputError` E148 for a number out of range, E149 for a seed, E160 otherwise.
    """
    kinds = tuple(
        Annotated[kind, subcommand(name, description=kind.__doc__)]
        for name, kind in commands.items()
    )
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            found: Common = tyro.cli(
                Union[kinds],  # type: ignore[call-overload]  # noqa: UP007 - a table
                args=list(args),
                prog=PROGRAM,
                description="A posterior sample is a simulator.",
                config=(tyro.conf.FlagCreatePairsOff,),
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            return None
        text = re.sub(r"[^\x20-\x7e]+|-{3,}", " ", errors.getvalue())
        _refuse(" ".join(text.split()), args, [*commands, "--help", "--version"])
    _check_ranges(found)
    return found


def _refuse(text: str, args: Sequence[str], commands: Sequence[str]) -> NoReturn:
    """Tyro's words, ``text``, as an error of ours."""
    known = [*_NAMES.findall(text), *commands]
    if found := re.search(r"Unrecognized options: ([^\s,]+)", text):
        word = found[1]
        if not word.startswith("-") and word != args[0]:
            what, fix = "unexpected argument", "remove it"
            raise usage_error(what, word, "options only", fix)
        kind = "option" if word.startswith("-") else "command"
        names = [name for name in known if name != word]
        raise usage_error(f"unknown {kind}", word, "", _nearest(word, names))
    if found := re.search(r"Missing from ([\w ]+): (\S+) (.*?) \(required\)", text):
        command, name, what = found.groups()
        fix = f"see {command} --help"
        raise usage_error(f"missing {name}", " ".join(args), what.rstrip("."), fix)
    if found := re.search(r"invalid choice '(.*?)' for argument '(.*?)'", text):
        word, option = found.groups()
        choices = re.findall(r"'([\w.-]+)'", text[found.end() :])
        given = sorted(x for x in choices if x != "None")  # tyro has a set of them
        raise usage_error(
            option, word, "one of " + ", ".join(given), _nearest(word, given)
        )
    if found := re.search(r"Missing value for argument '(.*?)'", text):
        fix = "add the value"
        raise usage_error(found[1], "nothing", f"{found[1]} VALUE", fix)
    if found := re.search(r"Error parsing (\S+): .*(int|float).*?'(.*?)'", text):
        option, kind, word = found.groups()
        expected = "a whole number" if kind == "int" else "a number"
        code = "E149" if option == "--seed" else "E148"
        raise usage_error(option, word, expected, "correct the number", code)
    if found := re.search(r"Error parsing (\S+): .*arguments: \['(.*?)'", text):
        raise usage_error(found[1], found[2], "numbers", "correct the number", "E148")
    raise usage_error("arguments", " ".join(args), text[:200], f"see {PROGRAM} --help")


def _nearest(word: str, names: Iterable[str]) -> str:
    close = nearest(word, names)
    return f"did you mean {close}" if close else f"see {PROGRAM} --help"


def _check_ranges(command: Common) -> None:
    """Numbers lie where their fields say (E148, of a seed E149)."""
    hints = get_type_hints(type(command), include_extras=True)
    for name, hint in hints.items():
        ranges = [mark for mark in get_args(hint)[1:] if isinstance(mark, Range)]
        value = getattr(command, name)
        for mark in ranges:
            for each in value if isinstance(value, tuple) else (value,):
                if each is not None and not mark.holds(each):
                    option, code = "--" + name.replace("_", "-"), mark.code
                    got, fix = str(each), "correct the number"
                    raise usage_error(option, got, mark.words, fix, code)


def usage_error(
    what: str, got: str, expected: str, fix: str, code: str = "E160"
) -> InputError:
    """An error in the arguments."""
    where = "the command line"
    return InputError(code, what, where=where, got=got, expected=expected, fix=fix)


def refuse(given: object, options: Iterable[str], expected: str, or_: str) -> None:
    """E160 where one of these options is given; ``or_`` is what else to do."""
    for option in options:
        if getattr(given, option):
            fix = f"leave --{option} out, {or_}"
            raise usage_error("too much", f"--{option}", expected, fix)


def parse_words(option: str, words: Iterable[str]) -> dict[str, str]:
    """``NAME=WORD`` words by name (E160 for another form, or a name twice)."""
    return {name: value for name, value, _ in _named_values(option, words)}


def parse_numbers(option: str, words: Iterable[str]) -> dict[str, float]:
    """``NAME=NUMBER`` words by name (E160 for another form, or a name twice)."""
    return {
        name: _parse_number(option, word, v)
        for name, v, word in _named_values(option, words)
    }


def pairs(option: str, words: Iterable[str]) -> dict[str, tuple[float, float]]:
    """``NAME=LOW:HIGH`` words by name (E141 where low is not below high, E160)."""
    found = {}
    for name, value, word in _named_values(option, words):
        ends = [_parse_number(option, word, end) for end in value.split(":")]
        if len(ends) != 2:
            raise usage_error(option, word, f"{name}=LOW:HIGH", "write both ends")
        if not ends[0] < ends[1]:
            raise usage_error(option, word, "LOW below HIGH", "swap the two", "E141")
        found[name] = ends[0], ends[1]
    return found


def _named_values(option: str, words: Iterable[str]) -> Iterator[tuple[str, str, str]]:
    seen: set[str] = set()
    for word in words:
        name, _, value = word.partition("=")
        if not (name and value):
            raise usage_error(option, word, "NAME=VALUE", "write name and value")
        if name in seen:
            raise usage_error(option, word, "each name once", "remove one of the two")
        seen.add(name)
        yield name, value, word


def _parse_number(option: str, word: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise usage_error(option, word, "finite numbers", "correct the number")
    return value
