"""The catalogue of errors: complete, and used."""

import ast
import string
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim2gp.errors import CODES, Entry, InputError, NotConverged, catalogue, error
from tests.catalogue.test_all_bad_inputs import CASES

ROOT = Path(__file__).resolve().parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
#: What `error` takes itself; all else fills templates.
OWN = {"where", "got", "expected", "fix"}
#: Errors that no row of the table of bad inputs provokes, and why.
NOT_PROVOKED = {
    "another_machine_than_fitted": "of a fit: test_project_model.py",
    "constant_not_open": "of a fit whose machine has other constants open",
    "worker_of_other_code": "of a cluster with two versions: test_shares.py",
    "fault_of_sim2gp": "of an error that is no input's: test_cli.py",
    "simulator_not_finite_on_box": "of a training by night: test_function_space.py",
    "episode_not_finite": "of a compiled episode: test_episode.py",
    "information_not_finite": "of a search that is lost at every start",
    "no_commands_keep_limits": "of a search by night: test_design_search.py",
    "options_refused": "of a machine that checks its options by other errors",
    "did_not_become_free": "always the cause of `cannot_be_added`",
    "model_leaves_logs": "of a draft whose model diverges at its own numbers",
    "actuator_with_several_inputs": "of models that no MuJoCo so far compiles",
}


def calls() -> Iterator[tuple[str, str, set[str]]]:
    """Place, key and keywords of each call of `error`."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            match node:
                case ast.Call(
                    func=ast.Name(id="error"),
                    args=[ast.Constant(value=str(key)), *_],
                    keywords=given,
                ):
                    place = f"{path.name}:{node.lineno}"
                    yield place, key, {each.arg or "**" for each in given}


def fields(entry: Entry, given: set[str]) -> set[str]:
    """The names in the templates that are used."""
    used = [entry.title]
    used += [] if "expected" in given else [entry.expected]
    used += [] if "fix" in given else [entry.fix]
    return {name for text in used for name in string.Template(text).get_identifiers()}


def test_each_call_fills_its_templates() -> None:
    for place, key, given in calls():
        assert key in catalogue(), place
        wanted = fields(catalogue()[key], given)
        assert wanted == given - OWN, f"{place}: {key}"


def test_each_entry_is_used_and_has_a_code() -> None:
    assert {key for _, key, _ in calls()} == set(catalogue())
    codes = tomllib.loads(CODES.read_text(encoding="utf-8"))
    known = {code for chapter in codes.values() for code in chapter}
    assert {entry.code for entry in catalogue().values()} <= known


def test_each_error_is_provoked_or_listed() -> None:
    """The list is right: what it names has no row yet."""
    provoked = {given.key for bad in CASES for given in bad.inputs}
    assert set(catalogue()) - provoked == set(NOT_PROVOKED)


def test_no_key_is_repeated() -> None:
    files = [f for f in CODES.parent.glob("*.toml") if f != CODES]
    keys = [k for f in files for k in tomllib.loads(f.read_text(encoding="utf-8"))]
    assert len(keys) == len(set(keys))


def test_an_error_has_the_words_of_its_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = Entry("E116", "no $what", "at least $least", "record ${what}s")
    monkeypatch.setattr("sim2gp.errors.catalogue", lambda: {"few": entry})
    made = error("few", where="a.csv", got=1, what="row", least=2)
    assert (made.key, made.code) == ("few", "E116")
    assert isinstance(made, InputError)
    assert str(made) == (
        "E116 no row in a.csv: got 1, expected at least 2. Fix: record rows."
    )
    other = error("few", NotConverged, what="row", expected="more", fix="wait")
    assert isinstance(other, NotConverged)
    assert str(other) == "E116 no row: expected more. Fix: wait."
