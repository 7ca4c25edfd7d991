"""The table of mutants fits today's code; by night, each of them is found."""

import ast
import shutil
from pathlib import Path

import pytest

import mutants
from tests.catalogue.test_all_bad_inputs import CASES

#: Cases of a table, which a mutant may name as well, and keys of errors.
KEYS = {given.key for bad in CASES for given in bad.inputs}
TITLES = {"test_all_bad_inputs.py": [*(bad.title for bad in CASES), *KEYS]}


def test_each_mutant_applies_to_the_code_as_it_is(tmp_path: Path) -> None:
    for number, mutant in enumerate(mutants.MUTANTS):
        place = tmp_path / str(number) / mutant.file
        place.parent.mkdir(parents=True)
        shutil.copy(mutants.PACKAGE / mutant.file, place)
        mutant.apply(tmp_path / str(number))
        assert place.read_text() != (mutants.PACKAGE / mutant.file).read_text()


def test_each_mutant_names_tests_that_exist() -> None:
    """A renamed test would end the night's run, or a mutant would survive unseen."""
    for file, only in sorted({(m.tests, m.only) for m in mutants.MUTANTS}):
        tree = ast.parse(mutants.file_of(file).read_text())
        names = [n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
        found = [n for n in names if n.startswith("test_")] + TITLES.get(file, [])
        for word in (only or "test").split(" or "):
            assert any(word in name for name in found), (file, word)


def test_no_two_have_one_name() -> None:
    assert len({m.name for m in mutants.MUTANTS}) == len(mutants.MUTANTS) == 166


@pytest.mark.nightly
def test_no_mutant_survives() -> None:
    assert mutants.survivors(mutants.MUTANTS) == []
