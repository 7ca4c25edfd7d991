"""The catalogue of errors: complete, and used."""

import ast
import string
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim2gp.errors import CODES, Entry, InputError, NotConverged, catalogue, error

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
#: What `error` takes itself; all else fills templates.
OWN = {"where", "got", "expected", "fix"}


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


def test_no_key_stands_twice() -> None:
    files = [f for f in CODES.parent.glob("*.toml") if f != CODES]
    keys = [k for f in files for k in tomllib.loads(f.read_text(encoding="utf-8"))]
    assert len(keys) == len(set(keys))


def test_an_error_has_the_words_of_its_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = Entry("E116", "no $what", "at least $least", "record ${what}s")
    monkeypatch.setattr("sim2gp.errors.catalogue", lambda: {"few": entry})
    made = error("few", where="a.csv", got=1, what="row", least=2)
    assert isinstance(made, InputError)
    assert str(made) == (
        "E116 no row in a.csv: got 1, expected at least 2. Fix: record rows."
    )
    other = error("few", NotConverged, what="row", expected="more", fix="wait")
    assert isinstance(other, NotConverged)
    assert str(other) == "E116 no row: expected more. Fix: wait."
