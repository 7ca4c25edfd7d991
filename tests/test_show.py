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
    print_summary(summary, "sim2gp demo")
    shown = capsys.readouterr().out
    for wanted in ("It swings.", "m2", "kg", "Raise m2", "Score of each", "0.97"):
        assert wanted in shown
    assert "One machine." in shown
    for hidden in ("a long note", "combination", "0.0\n"):
        assert hidden not in shown
