"""Named parts of patterns against Python's own `glob`."""

import glob
import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim2gp.project.named_parts import as_glob, named_parts, names_in

FILES = (
    "logs/a/run1.csv",
    "logs/a/run2.csv",
    "logs/b[1]/run1.csv",
    "logs/b/deep/er/run1.csv",
    "logs/c_1.csv",
    "logs/c_2_x.csv",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("named")
    for name in FILES:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    return root


@pytest.mark.parametrize(
    ("pattern", "parts"),
    [
        ("logs/{robot}/run1.csv", ["a", "b[1]"]),
        ("logs/{robot}/**/run1.csv", ["a", "b", "b[1]"]),
        ("logs/{robot}_?.csv", ["c", "c_2"]),
        ("logs/c_{robot}.csv", ["1", "2_x"]),
        ("logs/[!ab]_{robot}*.csv", ["1", "2_x"]),
        ("./logs/../logs/{robot}/run[12].csv", ["a", "a", "b[1]"]),
    ],
)
def test_parts_of_what_glob_finds(folder: Path, pattern: str, parts: list[str]) -> None:
    found = glob.glob(os.path.join(folder, as_glob(pattern)), recursive=True)
    named = [named_parts(pattern, path, str(folder)) for path in found]
    assert sorted(one["robot"] for one in named) == parts


def test_a_part_is_the_same_throughout() -> None:
    pattern = "{robot}/{robot}_{run}.csv"
    assert names_in(pattern) == ["robot", "robot", "run"]
    assert named_parts(pattern, "a/a_1.csv", "") == {"robot": "a", "run": "1"}
    assert named_parts(pattern, "a/b_1.csv", "") == {}


@given(st.text(st.sampled_from("ab*?[]!{}/.(+\\"), max_size=12))
def test_patterns_of_any_form_are_read(text: str) -> None:
    """What is no pattern of ours or of glob's stands for itself."""
    pattern = f"{text}{{robot}}"
    assert "robot" in names_in(pattern)
    assert set(named_parts(pattern, "some/file", "")) <= {"robot", *names_in(pattern)}
