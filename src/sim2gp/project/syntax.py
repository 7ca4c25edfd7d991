"""What to write instead of a line that is not TOML, from where the parser stopped."""

import re
from collections.abc import Sequence

#: Sections that occur once for each of their tables, in double brackets.
LISTS = ("logs", "weighed")
#: The last part of a channel's name that has two, which needs quotes.
PARTS = ("velocity", "control")

#: What Python's parser says, the text where it stopped, and the fix.
_SYNTAX: Sequence[tuple[str, str, str]] = (
    ("Invalid value", r"[+-]?\.\d", "write a digit before the point, as in 0.5"),
    ("Expected newline", r"\.(?!\d)", "write a digit after the point, as in 5.0"),
    ("Invalid value", r"(?i)(true|yes|on)\b", "write true"),
    ("Invalid value", r"(?i)(false|no|off)\b", "write false"),
    ("Invalid value", "[“”„‘’]", 'write plain quotes, as in "name"'),
    ("Invalid value", r"\(", "write a pair in brackets, [low, high]"),
    ("Invalid value", r"[^\W\d]|[/.~]", 'write text in quotes, as in "name"'),
    ("(Invalid hex|Unescaped)", "", "write / in paths, or the text in single quotes"),
    ("Expected ']", r"\s*\]?\s*(#|$)", "close the brackets as they were opened"),
    ("Expected ']", ".", 'write the name in quotes, as in [parameters."a/b"]'),
    ("Expected '='", r"\s*:", "write = instead of :"),
    ("(Expected '='|Invalid statement)", ".*=", "write the name in quotes"),
    ("Expected newline", r"\s*(//|;|%|--)", "begin a comment with #"),
    ("Invalid statement", r"(//|;|%|--)", "begin a comment with #"),
    ("Expected newline", r",\d", "write a decimal point instead of the comma"),
    ("Expected newline", r",", "write a list in brackets"),
    ("Expected newline", r"\s*(\+-|\+/-|±)", "write {mean = 0.5, sd = 0.1}"),
    ("Expected newline", r"\s*\]", "close the brackets as they were opened"),
    ("Expected newline", r"\s*[^\W\d]", "write the number alone, without a unit"),
    ("(Unterminated|Expected [\"'])", "", "close the quotes"),
    ("Unclosed array", "", "close the bracket"),
    (
        "(Invalid initial|Unclosed inline)",
        "",
        "write a table {a = 1, b = 2} on one line, without a comma at its end",
    ),
)


def fix_for_syntax(reason: str, row: str, column: int) -> str:
    """For a line that is not TOML, of which the parser stopped at a column."""
    rest = row[max(0, column - 1) :]
    for said, found, fix in _SYNTAX:
        if re.match(said, reason) and re.match(found, rest):
            return fix
    return "correct the line"


def fix_for_repeated(row: str) -> str:
    """For a key or table that is there already."""
    header = re.match(r"\s*\[+\s*(\w+)", row)
    if header and header[1] in LISTS:
        return f"write [[{header[1]}]] for each, and its other tables below it"
    dotted = re.match(rf"\s*([\w-]+)\.({'|'.join(PARTS)})\s*=", row)
    if dotted:
        return f'write the name in quotes: "{dotted[1]}.{dotted[2]}"'
    return "remove one of the two"
