"""The first screen of an identification: five questions, and an answer to each."""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from sim2gp.identification.words import bound_warnings
from sim2gp.reports.numbers import format_number
from sim2gp.reports.parameters import Summary

MANY = 4  # names that a sentence lists


def glance(summary: Summary) -> dict[str, str]:
    """What was learned, how sure, does it predict, what is missing, what next.

    Nothing where the run is not an identification that came to its end.
    """
    finished = summary.get("command") == "identify" and not summary.get("first_answer")
    if not finished or not _entries(summary):
        return {}
    return {
        "What was learned": str(summary.get("headline") or ""),
        "How sure": _width_answer(summary),
        "Does it predict": _predicts(summary),
        "What is missing": _misfit_answer(summary),
        "What next": _next_command(summary),
    }


def _entries(summary: Summary) -> Mapping[str, Mapping[str, Any]]:
    found: Mapping[str, Mapping[str, Any]] = summary.get("parameters") or {}
    return found


def _width_answer(summary: Summary) -> str:
    """How wide the intervals are, and what they allow for."""
    shares = [
        100.0 * entry["sd"] / abs(entry["mean"])
        for entry in _entries(summary).values()
        if entry.get("verdict") == "identified" and entry.get("mean")
    ]
    said = []
    if shares:
        middle = format_number(median(shares), 2)
        words = f"Standard deviations are {middle} % of the values"
        if len(shares) > 1:
            words += f" (median; at most {format_number(max(shares), 2)} %)"
        said.append(f"{words}.")
    about = summary.get("intervals") or {}
    if about.get("which") == "corrected" and about.get("allowed_for"):
        said.append("The intervals allow for correlated errors and missing physics.")
    elif about.get("which") == "corrected":
        said.append("The intervals allow for correlated errors, not missing physics.")
    elif about:
        said.append("The intervals assume a correct model: there are few windows.")
    check = summary.get("check") or {}
    if check.get("text"):
        said.append(str(check["text"]))
    return " ".join(said)


def _predicts(summary: Summary) -> str:
    """Of data that the fit has not seen."""
    about = summary.get("held_out") or {}
    return str(about.get("headline") or about.get("text") or "Not asked (--quick).")


def _misfit_answer(summary: Summary) -> str:
    """What the residuals say of the model."""
    misfit = summary.get("misfit") or {}
    if misfit.get("alarm"):
        return "Something: the residuals contradict the model."
    return str(misfit.get("verdict") or "")


def _next_command(summary: Summary) -> str:
    """The command that helps most."""
    misfit, entries = summary.get("misfit") or {}, _entries(summary)
    if pressed := bound_warnings(entries):
        names = _first_names(list(pressed))
        return f"Write a wider range of {names} in the project file; identify again."
    if misfit.get("alarm"):
        return "sim2gp explain RUN says which physics may be missing."
    settled = "identified", "dead", "at_bound"
    open_ = [n for n, entry in entries.items() if entry.get("verdict") not in settled]
    if open_:
        names = _first_names(open_)
        return f"sim2gp design RUN: an experiment that tells more of {names}."
    return (
        "sim2gp evaluate RUN --logs FILE: does it predict another recording? "
        "sim2gp export RUN writes simulators to train on."
    )


def _first_names(names: Sequence[str]) -> str:
    shown = ", ".join(names[:MANY])
    rest = len(names) - MANY
    return f"{shown} and {format_number(rest)} more" if rest > 0 else shown


def unique(problems: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Each sentence once, in the order of their first places."""
    kept: dict[str, str] = {}
    for weight, words in problems:
        kept.setdefault(words, weight)
    return [(weight, words) for words, weight in kept.items()]
