"""Typed errors with stable codes: what is wrong, where, and what to do about it.

Compiled code cannot raise; it returns status codes, and the host raises once per call.
A code is never reused for another meaning. What each code means, and the words of each
error, are data: `catalogue/*.toml`.
"""

import difflib
import functools
import re
import string
import tomllib
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

CATALOGUE = Path(__file__).parent / "catalogue"
CODES = CATALOGUE / "codes.toml"  # what each code means
COMPARED = 2_000_000  # pairs of characters that are looked at for a misspelt name
_OF_CALLBACK = re.compile(r"^(?:\S+\.)?InputError: (E\d{3}) (.*)$", re.MULTILINE)


class Sim2GPError(Exception):
    """Root of every error that sim2gp raises on purpose; ``code`` is stable.

    ``key`` names its entry in the catalogue: finer than the code, and not stable.
    """

    def __init__(
        self,
        code: str,
        what: str,
        *,
        where: str = "",
        got: object = None,
        expected: str = "",
        fix: str = "",
        key: str = "",
    ) -> None:
        self.code, self.what, self.where = code, what, where
        self.got, self.expected, self.fix = got, expected, fix
        self.key = key
        super().__init__(str(self))

    @property
    def arguments(self) -> dict[str, str]:
        """In words: what makes the same error in another process."""
        names = ("code", "what", "where", "got", "expected", "fix", "key")
        given = {name: getattr(self, name) for name in names}
        return {name: str(x) for name, x in given.items() if x is not None}

    def __str__(self) -> str:
        text = f"{self.code} {self.what}"
        if self.where:
            text += f" in {self.where}"
        details = []
        if self.got is not None:
            details.append(f"got {self.got}")
        if self.expected:
            details.append(f"expected {self.expected}")
        if details:
            text += ": " + ", ".join(details)
        if self.fix:
            text += f". Fix: {self.fix}"
        return " ".join(f"{text.rstrip('.')}.".split())


class InputError(Sim2GPError):
    """The user's input is wrong; the command line ends with exit code 2."""


class NotConverged(Sim2GPError):
    """E201: the MAP was not reached; ``known`` is the posterior where the fit ended."""

    known: object = None


class DeadParameters(Sim2GPError):
    """E146: the data do not depend on a parameter at all (zero Jacobian column)."""


class NotPositiveDefinite(Sim2GPError):
    """E202: a matrix that must be a covariance is not; names rank and parameters."""


class NotFinite(Sim2GPError):
    """E203: a simulation or a fit produced a number that is not finite."""


class Sim2GPWarning(UserWarning):
    """A typed warning; its text starts with its code (W110 and so on)."""


@dataclass(frozen=True)
class Entry:
    """The words of one error; a field that is given with it replaces ``$name``."""

    code: str
    title: str
    expected: str = ""
    fix: str = ""


@functools.cache
def catalogue() -> dict[str, Entry]:
    """Every error of the catalogue by its key."""
    found: dict[str, Entry] = {}
    for file in sorted(CATALOGUE.glob("*.toml")):
        if file != CODES:
            entries = tomllib.loads(file.read_text(encoding="utf-8"))
            found |= {key: Entry(**words) for key, words in entries.items()}
    return found


Kind = TypeVar("Kind", bound=Sim2GPError)


def error(
    key: str,
    kind: type[Kind] = InputError,  # type: ignore[assignment]
    /,
    *,
    where: str = "",
    got: object = None,
    expected: str | None = None,
    fix: str | None = None,
    **fields: object,
) -> Kind:
    """An error of the catalogue: ``raise error("no_transition", where=source, got=2)``.

    ``fields`` fill its templates; ``expected`` and ``fix`` replace them where they are
    found out, such as the name that was meant.
    """
    entry = catalogue()[key]

    def filled(template: str) -> str:
        return string.Template(template).substitute(fields)

    return kind(
        entry.code,
        filled(entry.title),
        where=where,
        got=got,
        expected=filled(entry.expected) if expected is None else expected,
        fix=filled(entry.fix) if fix is None else fix,
        key=key,
    )


def missing_extra(what: str, caught: ImportError, extra: str) -> InputError:
    """E135: something needs a package that an extra of ours installs."""
    return error(
        "missing_extra",
        got=str(caught),
        expected=caught.name or "",
        what=what,
        extra=extra,
    )


@contextmanager
def of_callbacks() -> Iterator[None]:
    """Raise again an `InputError` that compiled code met when it called back.

    JAX passes on the text of what a callback raises, and nothing else.
    """
    try:
        yield
    except RuntimeError as error:
        found = _OF_CALLBACK.findall(str(error))
        if not found:
            raise
        code, what = found[-1]
        raise InputError(code, what) from error


def warn(code: str, text: str) -> None:
    """Emit a `Sim2GPWarning` once at the caller's line."""
    warnings.warn(f"{code} {text}", Sim2GPWarning, stacklevel=3)


def nearest(name: str, names: Iterable[str]) -> str | None:
    """The known name that a misspelt one most likely meant, or None."""
    lower: dict[str, str] = {}
    cost = 0  # of a comparison: the product of the two lengths
    for other in names:
        cost += len(name) * len(other)
        if cost > COMPARED:
            break
        lower[other.lower()] = other
    found = difflib.get_close_matches(name.lower(), list(lower), n=1, cutoff=0.5)
    return lower[found[0]] if found else None
