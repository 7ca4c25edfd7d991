"""The study of `explain`, whole, by night: every bar must hold."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.nightly
def test_planted_physics_is_found(tmp_path: Path) -> None:
    script = ROOT / "benchmarks" / "explain.py"
    command = [sys.executable, str(script), "--out", str(tmp_path / "study")]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=4 * 3600
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr
    verdicts = [x for x in done.stdout.splitlines() if x.startswith(("holds", "FAILS"))]
    assert len(verdicts) == 4
    assert not [line for line in verdicts if line.startswith("FAILS")]
