"""Every mutant exists in today's code; by night, every one is killed."""

import ast
import shutil
from pathlib import Path

import pytest

import mutants
from test_all_bad_inputs import CASES

#: Cases of a table, which a hunt may name as well.
TITLES = {"test_all_bad_inputs.py": [bad.title for bad in CASES]}


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: m.name)
def test_a_mutant_applies_to_the_code_as_it_is(mutant, tmp_path: Path):
    (tmp_path / mutant.file).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(mutants.PACKAGE / mutant.file, tmp_path / mutant.file)
    mutant.apply(tmp_path)


@pytest.mark.parametrize("hunt", sorted({m.hunt for m in mutants.MUTANTS}))
def test_a_hunt_names_tests_that_exist(hunt: mutants.Hunt):
    """A renamed test would end the night's hunt, or a mutant would live unseen."""
    file, only = hunt
    tree = ast.parse((mutants.ROOT / "tests" / file).read_text())
    names = [n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    found = [n for n in names if n.startswith("test_")] + TITLES.get(file, [])
    for word in (only or "test").split(" or "):
        assert any(word in name for name in found), (file, word)


def test_names_are_unique():
    names = [m.name for m in mutants.MUTANTS]
    assert len(set(names)) == len(names)


@pytest.mark.nightly
def test_no_mutant_survives():
    assert mutants.survivors(mutants.MUTANTS) == []
