"""`sim2gp demo` as a user runs it: a report, and with a force that is missing."""

import json
from pathlib import Path

import pytest

from sim2gp.cli import main
from sim2gp.commands.demo import _held_sentence


@pytest.mark.nightly  # 40 s: it compiles and runs an oracle and a learner
def test_a_mismatched_demo_ends_with_a_report(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--mismatch", "--episodes", "1", "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["with_mismatch"]
    assert len(summary["returns"]["missing forces"]) == 1
    assert "<svg" in (out / "report.html").read_text()


def test_intervals_that_hold_are_counted() -> None:
    """One inside, one at its end, one below; what has no truth does not count."""
    interval = {"q025": 1.0, "q975": 2.0}
    truths = {"a": 1.5, "b": 2.0, "c": 0.9}
    entries = {n: interval | {"truth": t} for n, t in truths.items()}
    said = _held_sentence(entries | {"noise": interval})
    assert said.startswith("2 of 3 intervals of 95 % hold the true value")
