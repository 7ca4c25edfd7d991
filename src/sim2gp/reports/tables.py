"""Tables as data; the template draws them."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim2gp.reports.numbers import format_number, format_percent, is_number

SHARES = ("coverage90", "coverage95", "coverage")


@dataclass(frozen=True)
class TableCell:
    """One cell, in the order in which it is read.

    A bar of a ``share`` ("40%"), a ``name`` in bold, ``text``, its ``unit``, a ``chip``
    (tone and word), and below them ``why``.
    """

    text: object = ""
    name: object = ""
    share: str | None = None
    unit: str = ""
    chip: tuple[str, str] | None = None
    why: object = ""

    @property
    def empty(self) -> bool:
        """Whether nothing is shown."""
        shown = (str(self.text), self.share, self.name, self.unit, self.chip, self.why)
        return not any(shown)


@dataclass(frozen=True)
class ReportTable:
    """Columns and rows; ``words`` are the columns of text, not of numbers.

    With ``cards`` every row becomes a card of its own on a narrow screen, which begins
    with the first column and, where the last one is ``prose``, with that.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[TableCell]]
    words: Collection[int]
    cards: bool = False
    prose: bool = True


def make_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    words: Collection[int],
    cards: bool = False,
    prose: bool = True,
) -> ReportTable:
    """A table whose cells may be plain text."""
    cells = [
        [
            x if isinstance(x, TableCell) else TableCell("" if x is None else x)
            for x in row
        ]
        for row in rows
    ]
    return ReportTable(columns, cells, words, cards, prose)


def format_value(key: str, value: object) -> object:
    """A value of a summary as text."""
    if key in SHARES:
        return format_percent(value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return format_number(value) if is_number(value) or value is None else value


def records(entries: Mapping[str, Any], first: str) -> ReportTable:
    """A table of named entries: one column for every key that any of them has."""
    rows = {
        name: value if isinstance(value, Mapping) else {"value": value}
        for name, value in entries.items()
    }
    keys = list(dict.fromkeys(key for row in rows.values() for key in row))
    words = [
        index + 1
        for index, key in enumerate(keys)
        if any(isinstance(row.get(key), str) for row in rows.values())
    ]
    return make_table(
        [first, *(key.replace("_", " ") for key in keys)],
        [
            [TableCell(name=name), *(format_value(key, row.get(key)) for key in keys)]
            for name, row in rows.items()
        ],
        words=(0, *words),
    )
