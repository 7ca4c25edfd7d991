"""`sim2gp demo` as a user runs it: a report, and with a force that is missing."""

import json
from pathlib import Path

import pytest

from sim2gp.cli import main


@pytest.mark.nightly  # 40 s: it compiles and runs an oracle and a learner
def test_a_mismatched_demo_ends_with_a_report(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    assert main(["demo", "--mismatch", "--episodes", "1", "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["with_mismatch"]
    assert len(summary["returns"]["missing forces"]) == 1
    assert "<svg" in (out / "report.html").read_text()
