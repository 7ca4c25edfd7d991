"""Recordings of real machines: the whole tables, by night; every goal must hold."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.nightly
@pytest.mark.parametrize("name", ["real_arm", "qube"])
def test_the_goals_on_real_recordings_hold(
    name: str, shared_data: Path, tmp_path: Path
) -> None:
    script = ROOT / "benchmarks" / f"{name}.py"
    command = [sys.executable, str(script), str(shared_data)]
    command += ["--run", str(tmp_path / "run")]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=1800
    )
    print(done.stdout)
    assert done.returncode == 0, done.stderr
    verdicts = [x for x in done.stdout.splitlines() if x.startswith(("holds", "FAILS"))]
    assert verdicts
    assert not [line for line in verdicts if line.startswith("FAILS")]
