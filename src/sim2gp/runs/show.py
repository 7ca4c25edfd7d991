"""A summary for people: what matters, and on request all numbers as tables.

A value that is a table of tables (``parameters.<name>.{mean, sd, ...}``) becomes one
with a row for each name; a table of plain values becomes rows ``group.name``.
"""

import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

LONGEST = 12  # numbers of a list that are still printed
# What a terminal need not repeat: the report and summary.json have it all, and a table
# of its own says some of it better.
_HIDDEN = (
    *("warnings", "versions", "animation", "figure1", "units", "tables", "command"),
    "headline",
    *("configurations", "candidates", "misfit_as_it_is", "diff"),
    *(
        "intervals.allowed_for",
        "trivial",
        "losses",
        "held_out.trivial",
        "held_out.losses",
    ),
    *("calibration.channels", "held_out.calibration.channels"),
)
#: Of a parameter, what is printed without ``--verbose``.
_MAIN = frozenset(("unit", "mean", "sd", "q025", "q975", "truth", "verdict"))
_HIDDEN_COLUMNS = {
    "parameters": ("meaning", "note", "partners", "low", "high"),
    "directions": ("combination", "flat"),
    "base_parameters": ("prior_sd", "everywhere"),
    "misfit.tests": ("freedom",),
}


def print_summary(
    summary: Mapping[str, Any],
    title: str,
    *,
    answers: Mapping[str, str] | None = None,
    files: Sequence[str] = (),
    verbose: bool = False,
) -> None:
    """Print what matters of a summary to stdout, as wide as the terminal allows.

    That is its headline, its parameters, ``answers`` to questions or else its tables,
    and the ``files`` to open next. ``verbose`` prints all numbers.
    """
    from rich.console import Console

    sys.stdout.write(summary.get("diff", ""))
    # Away from a terminal nothing may be folded: a pipe has no width.
    width = None if sys.stdout.isatty() else 160
    console = Console(file=sys.stdout, width=width, highlight=False)
    headline = str(summary.get("headline") or "")
    if headline:
        console.print(headline, markup=False)
    groups = dict(_summary_groups(summary))
    tables = summary.get("tables", ())
    if verbose or not ("parameters" in groups or tables):
        for name, rows in groups.items():
            console.print(_rich_table(name, rows, _HIDDEN_COLUMNS.get(name, ())))
        _print_singles(console, summary, title)
    elif "parameters" in groups:
        rows = groups["parameters"]
        known = {key for row in rows.values() for key in row}
        console.print(_rich_table("parameters", rows, known - _MAIN))
    if verbose or not answers:
        _print_tables(console, tables)
    for question, answer in (answers or {}).items():
        if answer and answer != headline:
            console.print(f"{question}: {answer}", markup=False)
    for file in files:
        console.print(f"Written: {file}", markup=False, soft_wrap=True)


def _rich_table(name: str, rows: Mapping[str, Any], hidden: Collection[str]) -> Any:
    from rich.table import Table

    columns = list(dict.fromkeys(key for row in rows.values() for key in row))
    columns = [c for c in columns if c not in hidden]
    shown = [c for c in columns if any(_is_short(r.get(c)) for r in rows.values())]
    table = Table("", *shown, title=name, title_justify="left")
    for label, row in rows.items():
        cells = [row.get(column) for column in shown]
        table.add_row(label, *(_cell_text(c) if _is_short(c) else "" for c in cells))
    return table


def _print_singles(console: Any, summary: Mapping[str, Any], title: str) -> None:
    from rich.table import Table

    singles = Table(title=title, show_header=False, title_justify="left")
    for key, text in _singles(summary):
        singles.add_row(key, text)
    if singles.row_count:
        console.print(singles)


def _print_tables(console: Any, tables: Iterable[Mapping[str, Any]]) -> None:
    from rich.table import Table

    for said in tables:
        table = Table(*said["columns"], title=said["title"], title_justify="left")
        for row in said["rows"]:
            table.add_row(*(_cell_text(cell) for cell in row))
        console.print(table)
        if said.get("note"):
            console.print(said["note"])


def _singles(summary: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    for key, value in summary.items():
        if prefix + key in _HIDDEN:
            continue
        if _is_short(value):
            yield prefix + key, _cell_text(value)
        elif isinstance(value, Mapping) and not _is_group(value):
            yield from _singles(value, f"{prefix}{key}.")


def _summary_groups(
    summary: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, dict[str, Mapping[str, Any]]]]:
    for key, value in summary.items():
        if prefix + key in _HIDDEN:
            continue
        if isinstance(value, Mapping) and _is_group(value):
            yield prefix + key, dict(value)
        elif isinstance(value, Mapping):
            yield from _summary_groups(value, f"{prefix}{key}.")
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            yield prefix + key, {str(i + 1): row for i, row in enumerate(value)}


def _is_group(value: Mapping[str, Any]) -> bool:
    return bool(value) and all(isinstance(row, Mapping) for row in value.values())


def _is_short(value: Any) -> bool:
    if isinstance(value, list | tuple):
        plain = not any(isinstance(v, Mapping | list | tuple) for v in value)
        return plain and 0 < len(value) <= LONGEST
    return not isinstance(value, Mapping)


def _cell_text(value: Any) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return "  ".join(_cell_text(v) for v in value)
    return f"{value:.4g}" if isinstance(value, float) else str(value)
