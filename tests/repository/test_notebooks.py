"""The notebooks of examples/ run from the first cell to the last."""

import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
#: `test_from_python.py` runs the fourth.
NOTEBOOKS = ("first_posterior", "your_robot", "swing_up")


@pytest.mark.nightly
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if name == "your_robot":
        pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
    found = runpy.run_path(str(EXAMPLES / f"{name}.py"))
    if name == "first_posterior":
        low, high = found["mass"].interval
        assert low < 1.15 < high
    if name == "swing_up":
        last = {n: float(h.returns[-1]) for n, h in found["histories"].items()}
        assert last["with a spring"] > last["simulator alone"]
