"""What a run says of its files: every malformed manifest, and runs that hold less."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sim2gp.errors import InputError
from sim2gp.runs import load_run, new_run
from sim2gp.runs.plain import to_json
from sim2gp.runs.sealed import is_sealed, seal, unseal

GOLDEN = Path(__file__).parents[1] / "golden"


def save(path: Path, value: float = 1.0) -> None:
    with new_run(path, "test") as run:
        run.write_summary({"value": value})


def sealed(changes: dict[str, Any]) -> Callable[[bytes], bytes]:
    return lambda good: seal(unseal(good) | changes)


def entry(name: str, **changes: Any) -> dict[str, Any]:
    return {"files": {name: {"bytes": 1, "sha256": 64 * "0"} | changes}}


#: What may be written over a manifest, and the words that refuse it.
MANIFESTS: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "nothing": (lambda good: b"", "E183 .* unreadable JSON"),
    "a list": (lambda good: b"[1, 2]", "E183 .* not an object"),
    "null": (lambda good: b"null", "E183 .* not an object"),
    "a number": (lambda good: b"7", "E183 .* not an object"),
    "no JSON": (lambda good: b"{'a': 1}", "E183 .* unreadable JSON"),
    "NaN": (lambda good: b'{"format": NaN}', "E183 .* NaN"),
    "not UTF-8": (lambda good: b'{"format": "\xff"}', "E183 .* UTF-8"),
    "UTF-16": (lambda good: good.decode().encode("utf-16"), "E183 .* UTF-8"),
    "NUL": (lambda good: bytes(100), "E183 .* unreadable JSON"),
    "deep": (lambda good: b'{"a":' * 10**6, "E183 .* nested"),
    "deep lists": (lambda good: b"[" * 10**6, "E183 .* nested"),
    "huge": (lambda good: b" " * (2**24 + 1), "E183 .* more than"),
    "a huge number": (lambda good: b'{"format": ' + b"9" * 10**4 + b"}", "E183"),
    "a name twice": (lambda good: b'{"format": 1, "format": 1}', "E183 .* twice"),
    "no entries": (lambda good: b"{}", "E183 .* entry format"),
    "no checksum": (lambda good: to_json(unseal(good)).encode(), "E183 .* checksum"),
    "sealed, of format 1": (sealed({"format": 1}), "E183 .* checksum"),
    "format true": (sealed({"format": True}), "E183 .* entry format"),
    "format 0": (sealed({"format": 0}), "E183 .* entry format"),
    "format 1.5": (sealed({"format": 1.5}), "E183 .* entry format"),
    "format as text": (sealed({"format": "2"}), "E183 .* entry format"),
    "no command": (sealed({"command": None}), "E183 .* entry command"),
    "no version": (sealed({"sim2gp": 1}), "E183 .* entry sim2gp"),
    "environment": (sealed({"environment": []}), "E183 .* entry environment"),
    "a list of files": (sealed({"files": ["summary.json"]}), "E183 .* entry files"),
    "no files": (sealed({"files": None}), "E183 .* entry files"),
    "a file of text": (sealed({"files": {"a": "b"}}), "E183 .* entry files"),
    "no size": (sealed(entry("a", bytes="1")), "E183 .* entry files"),
    "size below 0": (sealed(entry("a", bytes=-1)), "E183 .* entry files"),
    "half a checksum": (sealed(entry("a", sha256="0")), "E183 .* entry files"),
    "no summary": (sealed(entry("arrays.npz")), "E130 .* without summary"),
    "another size": (sealed(entry("summary.json")), "E183 .* bytes, not 1"),
}


@pytest.mark.parametrize("name", MANIFESTS)
def test_a_malformed_manifest_is_a_typed_error(name: str, tmp_path: Path) -> None:
    save(tmp_path / "a")
    spoil, said = MANIFESTS[name]
    path = tmp_path / "a" / "manifest.json"
    path.write_bytes(spoil(path.read_bytes()))
    with pytest.raises(InputError, match=said) as refused:
        load_run(tmp_path / "a")
    assert len(str(refused.value)) < 500
    save(tmp_path / "a", 2.0)  # and what is damaged is replaced
    assert load_run(tmp_path / "a").summary["value"] == 2.0


def test_runs_of_the_first_format_still_load() -> None:
    """Of version 0.1.0: their manifests carry no checksum of their own."""
    run = load_run(GOLDEN / "policy")
    assert run.summary["title"] == "A trained policy"
    assert run.arrays["weights/0"].shape == (5, 8)
    assert not is_sealed((GOLDEN / "policy" / "manifest.json").read_bytes())
    kept = sorted((Path(__file__).parents[2] / "results").glob("*/manifest.json"))
    for path in kept:
        assert load_run(path.parent).summary["versions"]
