"""JSON that carries its own checksum, and a strict reader of JSON from outside.

A sealed file is plain JSON whose first member is the SHA-256 of every byte behind it::

    {
      "sha256": "9f86d081...",
      "format": 2,

The checksum is compared before anything is parsed.
"""

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from sim2gp.runs.plain import to_json

HEAD = b'{\n  "sha256": "'
_START = len(HEAD) + 64


def seal(values: Mapping[str, Any]) -> bytes:
    """These values as JSON, with their checksum (E203 for numbers not finite)."""
    rest = b'",' + to_json(values)[1:].encode("utf-8")
    return HEAD + hashlib.sha256(rest).hexdigest().encode("ascii") + rest


def is_sealed(content: bytes) -> bool:
    """Whether it begins as `seal` does."""
    return content.startswith(HEAD)


def unseal(content: bytes) -> dict[str, Any]:
    """What was sealed; ValueError where a single bit differs."""
    if not is_sealed(content):
        raise ValueError("no checksum of its own")
    digest = hashlib.sha256(content[_START:]).hexdigest()
    if digest.encode("ascii") != content[len(HEAD) : _START]:
        raise ValueError("bytes of another checksum")
    values = parse(content)
    del values["sha256"]
    return values


def parse(content: bytes) -> dict[str, Any]:
    """One JSON object; ValueError, in few words, for anything else.

    Refused as well: a name that occurs twice in an object, NaN, infinity, deep nests.
    """
    try:
        found = json.loads(
            content.decode("utf-8"), object_pairs_hook=_unique, parse_constant=_refused
        )
    except UnicodeDecodeError as error:
        raise ValueError("bytes that are not UTF-8") from error
    except json.JSONDecodeError as error:
        raise ValueError("unreadable JSON") from error
    except RecursionError as error:
        raise ValueError("JSON that is nested too deeply") from error
    if not isinstance(found, dict):
        raise ValueError("JSON that is not an object")
    return found


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("JSON with a name that occurs twice")
    return found


def _refused(constant: str) -> Any:
    raise ValueError(f"JSON with {constant}")
