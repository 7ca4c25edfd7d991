"""What a person sees on the terminal: every table of a summary, and no clutter."""

import pytest

from sim2gp.runs.show import print_summary


def test_tables_and_parameters_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    summary = {
        "headline": "It swings.",
        "versions": {"jax": "0.0"},
        "parameters": {"m2": {"unit": "kg", "mean": 0.5, "note": "a long note"}},
        "directions": [{"text": "Raise m2", "combination": "m2", "flat": True}],
        "tables": [
            {
                "title": "Score of each episode",
                "columns": ["method", "episode 1"],
                "rows": [["posterior sampling", "0.97"]],
                "note": "One machine.",
            }
        ],
    }
    print_summary(summary, "sim2gp demo", verbose=True)
    shown = capsys.readouterr().out
    for wanted in ("It swings.", "m2", "kg", "Raise m2", "Score of each", "0.97"):
        assert wanted in shown
    assert "One machine." in shown
    for hidden in ("a long note", "combination", "0.0\n"):
        assert hidden not in shown
    print_summary(summary, "sim2gp demo", files=["runs/demo/report.html"])
    brief = capsys.readouterr().out
    for wanted in ("It swings.", "m2", "kg", "Score of each", "0.97"):
        assert wanted in brief
    assert "Raise m2" not in brief
    assert brief.rstrip().endswith("Written: runs/demo/report.html")


def test_answers_take_the_place_of_tables(capsys: pytest.CaptureFixture[str]) -> None:
    summary = {
        "headline": "2 of 2 are identified.",
        "parameters": {"m2": {"mean": 0.5, "widened": 1.5}},
        "tables": [{"title": "More", "columns": ["a"], "rows": [["b"]]}],
        "rank": 2,
    }
    answers = {"What was learned": summary["headline"], "What next": "evaluate"}
    print_summary(summary, "sim2gp identify", answers=answers)
    shown = capsys.readouterr().out
    assert shown.count("2 of 2 are identified.") == 1
    assert "What next: evaluate" in shown
    for hidden in ("More", "rank", "widened"):
        assert hidden not in shown
