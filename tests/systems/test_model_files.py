"""Model files of other packages: each steps as C MuJoCo, or is refused by name."""

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")

ROOT = Path(__file__).resolve().parents[2]
#: Of gymnasium: motors, contacts, a loose body, and a free joint, which is refused.
BY_DAY = ("inverted_pendulum", "reacher", "hopper", "pusher_v5", "ant")


def _benchmark() -> ModuleType:
    script = ROOT / "benchmarks" / "model_files.py"
    spec = importlib.util.spec_from_file_location("model_files", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


BENCHMARK = _benchmark()
FILES = BENCHMARK.files()


@pytest.mark.parametrize("name", BY_DAY)
def test_some_of_gymnasium(name: str) -> None:
    file = f"gymnasium/envs/mujoco/assets/{name}.xml"
    if file not in FILES:
        pytest.skip("gymnasium (the extra `gym`) is not installed, or lacks the file")
    found = BENCHMARK.row(file, FILES[file])
    assert BENCHMARK.holds(found), found
    assert found["opens"] == (name != "ant")


@pytest.mark.nightly
@pytest.mark.parametrize("package", BENCHMARK.PACKAGES)
def test_every_file_of_a_package(package: str) -> None:
    own = {k: v for k, v in FILES.items() if k.startswith(package + "/")}
    if not own:
        pytest.skip(f"{package} is not installed: pip install --no-deps {package}")
    wrong = [r for r in map(BENCHMARK.row, own, own.values()) if not BENCHMARK.holds(r)]
    assert not wrong


def test_the_stored_table_has_no_third_case() -> None:
    table = json.loads((ROOT / "results" / "model_files.json").read_text())
    rows, count = table["rows"], table["count"]
    assert all(map(BENCHMARK.holds, rows))
    assert {r["file"].split("/")[0] for r in rows} == set(BENCHMARK.PACKAGES)
    assert count["files"] == len(rows) == count["open"] + count["refused"]
    assert count["third_case"] == 0


@pytest.mark.parametrize(
    "change",
    [
        {"step_error": 1e-9},
        {"step_error": float("nan")},
        {"derivative_finite": False},
        {"opens": False, "code": "E172", "element": "", "lines": 1},
        {"opens": False, "code": "E172", "element": "root", "lines": 2},
    ],
)
def test_a_third_case_is_one(change: dict[str, object]) -> None:
    good = {"opens": True, "step_error": 0.0, "derivative_finite": True}
    assert BENCHMARK.holds(good)
    assert not BENCHMARK.holds(good | change)
