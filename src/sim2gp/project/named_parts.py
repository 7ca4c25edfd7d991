"""Named parts of file patterns: ``logs/{robot}/*.csv`` says whose each file is."""

import fnmatch
import os
import re
from pathlib import PurePath

_NAMED = re.compile(r"\{([A-Za-z_][A-Za-z0-9_]*)\}")
#: Pieces of a pattern, and what each stands for as a regular expression.
_PIECES = re.compile(r"\*\*/|\*\*|\*|\?|\[!?\]?[^\]]*\]|" + _NAMED.pattern)
_MEANT = {"**/": "(?:[^/]+/)*", "**": ".*", "*": "[^/]*", "?": "[^/]"}


def as_glob(pattern: str) -> str:
    """The pattern with a star for each named part."""
    return _NAMED.sub("*", pattern)


def names_in(pattern: str) -> list[str]:
    """The names of its parts."""
    return _NAMED.findall(pattern)


def named_parts(pattern: str, path: str, folder: str) -> dict[str, str]:
    """What the names stand for in a ``path`` that the pattern matches in ``folder``."""
    if not names_in(pattern):
        return {}
    within = path.removeprefix(os.path.join(folder, ""))
    found = re.fullmatch(_expression(pattern), PurePath(within).as_posix())
    return {} if found is None else found.groupdict()


def _expression(pattern: str) -> str:
    pattern = PurePath(pattern).as_posix()
    text, end, known = "", 0, set[str]()
    for piece in _PIECES.finditer(pattern):
        text += re.escape(pattern[end : piece.start()])
        end, name = piece.end(), piece.group(1)
        if name is None:
            text += _MEANT.get(piece.group()) or _of_set(piece.group())
        else:
            text += f"(?P={name})" if name in known else f"(?P<{name}>[^/]+)"
            known.add(name)
    return text + re.escape(pattern[end:])


def _of_set(text: str) -> str:
    """One of some characters, as `glob` reads it."""
    whole = fnmatch.translate(text)  # "(?s:...)" and an end
    return whole[len("(?s:") : whole.rindex(")")]
