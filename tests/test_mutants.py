"""Every mutant exists in today's code; by night, every one is killed."""

import shutil
from pathlib import Path

import pytest

import mutants


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: m.name)
def test_a_mutant_applies_to_the_code_as_it_is(mutant, tmp_path: Path):
    shutil.copytree(mutants.PACKAGE, tmp_path / "sim2gp")
    mutant.apply(tmp_path / "sim2gp")


def test_names_are_unique():
    names = [m.name for m in mutants.MUTANTS]
    assert len(set(names)) == len(names)


@pytest.mark.nightly
def test_no_mutant_survives():
    assert mutants.survivors(mutants.MUTANTS) == []
