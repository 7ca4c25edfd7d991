"""The first screen of a report: an answer to each question, from the summary alone."""

import re
from typing import Any

import pytest

from report_example import full_run
from sim2gp.identification.words import bound_warnings
from sim2gp.reports.document import write_report
from sim2gp.reports.glance import glance, unique

ENTRY = {"mean": 2.0, "sd": 0.1, "q025": 1.8, "q975": 2.2, "verdict": "identified"}
PRESSED = (
    ENTRY
    | {"verdict": "at_bound", "mean": 2.9, "low": 0.5, "high": 3.0}
    | {"unit": "kg"}
)
SUMMARY: dict[str, Any] = {
    "command": "identify",
    "headline": "2 of 2 constants are identified.",
    "parameters": {"mass": ENTRY, "length": ENTRY | {"mean": -1.0}},
    "intervals": {"which": "corrected"},
    "held_out": {"headline": "Forecast 0.5 s ahead, 0.1 times the error."},
    "misfit": {"alarm": False, "verdict": "Nothing contradicts the model."},
}


def answers(summary: dict[str, Any]) -> dict[str, str]:
    """What stands on the page."""
    header = write_report(summary, {}).split("</header>")[0]
    return dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", header))


def test_each_question_has_its_answer() -> None:
    said = answers(SUMMARY)
    assert said["What was learned"] == SUMMARY["headline"]
    assert said["How sure"] == (
        "Standard deviations are 7.5 % of the values (median; at most 10 %). "
        "The intervals allow for correlated errors, not missing physics."
    )
    assert said["Does it predict"] == SUMMARY["held_out"]["headline"]
    assert said["What is missing"] == SUMMARY["misfit"]["verdict"]
    assert "sim2gp evaluate RUN" in said["What next"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"misfit": {"alarm": True, "verdict": "wrong"}}, "sim2gp explain RUN"),
        (
            {"parameters": {"mass": ENTRY | {"verdict": "weak"}}},
            "sim2gp design RUN: an experiment that tells more of mass.",
        ),
        ({"parameters": {"mass": PRESSED}}, "Write a wider range of mass"),
        ({"parameters": {"lag": PRESSED | {"mean": 0.0, "low": 0.0}}}, "evaluate RUN"),
    ],
)
def test_the_next_step_is_the_one_that_helps(
    change: dict[str, Any], words: str
) -> None:
    assert words in answers(SUMMARY | change)["What next"]


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (PRESSED, "upper end of its range, 3 kg"),
        (PRESSED, "a larger `high`"),
        (PRESSED | {"mean": 1.0}, "a smaller `low`"),
        (PRESSED | {"mean": 0.0, "low": 0.0}, ""),
    ],
)
def test_an_end_of_a_range_is_a_warning_that_says_which(
    entry: dict[str, Any], words: str
) -> None:
    said = bound_warnings({"mass": entry})
    assert words in said["mass"] if words else not said


def test_what_is_not_known_is_not_claimed() -> None:
    bare = {"command": "identify", "parameters": {"mass": {"verdict": "weak"}}}
    said = answers(bare)
    assert "How sure" not in said
    assert said["Does it predict"] == "Not asked (--quick)."
    assert not glance({"command": "demo", "parameters": {"mass": ENTRY}})
    assert not glance(SUMMARY | {"first_answer": True})


def test_words_of_a_run_are_escaped() -> None:
    assert answers(SUMMARY | {"headline": "<b>"})["What was learned"] == "&lt;b&gt;"


def test_a_warning_is_said_once() -> None:
    assert unique([("warn", "a"), ("bad", "b"), ("warn", "a")]) == [
        ("warn", "a"),
        ("bad", "b"),
    ]
    summary, arrays = full_run()
    twice = summary | {"warnings": ["W110 the period varies"] * 2}
    assert write_report(twice, arrays).count("W110 the period varies") == 1
