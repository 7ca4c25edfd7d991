"""Notes of several logs as lines to read: what holds for many of them is said once."""

import re
from collections.abc import Sequence

from sim2gp.data.logs.log import Log, Note

_NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?!\w)")


def note_lines(logs: Sequence[Log], more: Sequence[Note] = ()) -> list[str]:
    """The logs' notes and ``more`` as lines, alike ones of several logs in one line.

    Notes are alike if they differ in the log's source and in numbers alone; the line
    has the first of them and the number of logs. What several notes say of one log
    alone (its gaps) stays as it is.
    """
    longest = sorted({log.source for log in logs if log.source}, key=len, reverse=True)
    sources = re.compile(
        "|".join(rf"(?<!\w){re.escape(word)}(?!\w)" for word in longest) or r"(?!)"
    )
    groups: dict[tuple[str, str], list[tuple[Note, str]]] = {}
    own = [(note, log.source) for log in logs for note in log.notes]
    for note, holder in [*own, *((note, "") for note in more)]:
        named = sources.search(note.text)
        source = named.group() if named else holder
        alike = _NUMBER.sub("#", sources.sub("*", note.text))
        groups.setdefault((note.code, alike), []).append((note, source))
    lines: list[str] = []
    for (code, _), found in groups.items():
        count, first = len({source for _, source in found}), found[0][0]
        if count > 1:
            lines.append(f"{code} in {count} logs, the first: {first.text}")
        else:
            lines += dict.fromkeys(str(note) for note, _ in found)
    return lines
