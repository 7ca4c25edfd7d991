"""Policies that a robot must refuse, made from a good one: what `test_export` loads.

All but those of the last kind have right checksums: their files are whole, and wrong.
"""

import io
import json
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sim2gp.runs import load_run, new_run

Summary = dict[str, Any]
Arrays = dict[str, np.ndarray]
#: Of no field of the header.
VALUES = (None, True, -1, 0, 1.5, 10**9, "1", "", [], [1], {}, {"a": 1})
#: Of no array.
TYPES = ("<f8", "<f2", ">f4", "<i4", "<u1", "?", "<c8", "<U4")


class Case(NamedTuple):
    name: str
    code: str
    make: Callable[[Path], None]  # writes the policy into a new folder


def cases(folder: Path) -> list[Case]:
    """Every case from the good policy in ``folder`` (two layers, an angle)."""
    run = load_run(folder)
    found = [
        *_headers(run.summary["policy"], archive(run.arrays)),
        *_channels(run.summary["policy"], archive(run.arrays)),
        *_summaries(archive(run.arrays)),
        *_arrays(run.summary, run.arrays),
        *_archives(run.summary, run.arrays),
        *_damage(folder),
    ]
    names = [case.name for case in found]
    assert len(set(names)) == len(names), {n for n in names if names.count(n) > 1}
    return found


def written(path: Path, summary: str, arrays: bytes) -> None:
    """A run of these two files, whole and with its checksums."""
    with new_run(path, "export policy") as writer:
        writer.write_bytes("arrays.npz", arrays)
        writer.write_text("summary.json", summary)


def archive(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def case(name: str, policy: Any, content: bytes, code: str = "E133") -> Case:
    """With another header."""
    text = json.dumps({"policy": policy})
    return Case(name, code, lambda path: written(path, text, content))


def _headers(about: Summary, content: bytes) -> Iterator[Case]:
    """Fields that are missing, of another type or value, unknown, or there twice."""

    def changed(field: str, value: Any, code: str = "E133") -> Case:
        name = f"{field} = {value!r}"
        return case(name, about | {field: value}, content, code)

    for field, good in about.items():
        less = {k: v for k, v in about.items() if k != field}
        yield case(f"no {field}", less, content)
        for value in VALUES:
            newer = field == "format" and type(value) is int and value > good
            if type(value) is not type(good) or value != good:
                yield changed(field, value, "E185" if newer else "E133")
        member = f'"{field}": {json.dumps(good)}'
        twice = json.dumps({"policy": about}).replace(member, f"{member}, {member}")
        assert twice.count(member) == 2
        yield whole(f"{field} twice", twice, content)
    yield changed("format", 2, "E185")
    yield changed("layers", 1)
    yield changed("layers", 3)
    yield changed("author", "somebody")


def _channels(about: Summary, content: bytes) -> Iterator[Case]:
    """Names and units that cannot be, or are not those of the arrays."""

    def changed(field: str, value: Any) -> Case:
        return case(f"{field}: {value!r}", about | {field: value}, content)

    for field in ("states", "actions"):
        names = about[field]
        for wrong in ("", " ", "a\nb", "\x00", "x" * 1000, 3, None, ["q"]):
            yield changed(field, [wrong, *names[1:]])
        yield changed(field, [*names, names[0]])
        yield changed(field, [*names, "another"])
        yield changed(field, [*names, "one", "more"])
    yield changed("states", [about["actions"][0], *about["states"][1:]])
    yield changed("actions", about["states"][:1])
    units = about["units"]
    for channel in units:
        yield changed("units", {k: v for k, v in units.items() if k != channel})
        for wrong in ("", None, 1.0, "\n", ["rad"]):
            yield changed("units", units | {channel: wrong})
    yield changed("units", units | {"another": "m"})
    turning = about["states"][about["angle"]]
    for wrong in ("deg", "m", "rad/s"):
        yield changed("units", units | {turning: wrong})


def _summaries(content: bytes) -> Iterator[Case]:
    """Of something else than a policy, or no JSON."""
    for value in (None, [], "policy", {}):
        yield case(f"policy = {value!r}", value, content)
    for text in ("{}", '{"model": {}}'):
        yield whole(text, text, content, "E133")
    for text in ("", "[]", "null", '{"policy": NaN}', "{" * 5, '{"a":' * 10**5):
        yield whole(f"summary {text[:8]}", text, content)


def whole(name: str, text: str, content: bytes, code: str = "E183") -> Case:
    """With another summary."""
    return Case(name, code, lambda path: written(path, text, content))


def _arrays(summary: Summary, arrays: Arrays) -> Iterator[Case]:
    """Arrays that are missing, of another type or shape, not finite, or impossible."""
    text = json.dumps(summary)

    def case(name: str, changes: Mapping[str, Any], code: str = "E133") -> Case:
        content = archive(
            {k: v for k, v in (arrays | changes).items() if v is not None}
        )
        return Case(name, code, lambda path: written(path, text, content))

    def at(x: np.ndarray, value: float) -> np.ndarray:
        out = x.copy()
        out.flat[-1] = value
        return out

    for name, x in arrays.items():
        yield case(f"no {name}", {name: None})
        for dtype in TYPES:
            yield case(f"{name} as {dtype}", {name: x.astype(dtype)})
        for value in (np.nan, np.inf, -np.inf):
            yield case(f"{name} with {value}", {name: at(x, value)}, "E181")
        shapes = {
            "one row more": np.concatenate([x, x[:1]]),
            "no rows": x[:0],
            "one axis more": x[None],
            "a scalar": x.flat[0],
        }
        if x.ndim == 2:
            shapes |= {"transposed": x.T, "flat": x.ravel(), "short": x[:, :-1]}
        for what, value in shapes.items():
            yield case(f"{name}, {what}", {name: value})
    for name in ("weights", "biases"):
        pair = arrays[f"{name}/0"], arrays[f"{name}/1"]
        yield case(f"{name} swapped", {f"{name}/0": pair[1], f"{name}/1": pair[0]})
        for number in ("2", "00", "-1"):
            yield case(f"{name}/{number} as well", {f"{name}/{number}": pair[0]})
    scale, low, high = arrays["scale"], arrays["low"], arrays["high"]
    for value in (0.0, -0.0, -1.0):
        yield case(f"scale {value}", {"scale": at(scale, value)})
    yield case("low > high", {"low": high, "high": low})
    far = np.finfo(np.float32).max
    yield case("limits too far apart", {"low": at(low, -far), "high": at(high, far)})
    yield case("../x as well", {"../x": scale})


def _archives(summary: Summary, arrays: Arrays) -> Iterator[Case]:
    """Members that are there twice, or hold something else than they declare."""
    text = json.dumps(summary)

    def case(name: str, members: list[tuple[str, bytes]]) -> Case:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as file:
            for member, content in members:
                # A name that is there already is what this is about.
                file.NameToInfo.pop(member, None)
                file.writestr(member, content)
        content = buffer.getvalue()
        return Case(name, "E133", lambda path: written(path, text, content))

    good = {f"{name}.npy": npy(x) for name, x in arrays.items()}
    for name, content in good.items():
        others = [(k, v) for k, v in good.items() if k != name]
        shape = arrays[name.removesuffix(".npy")].shape
        start = len(content) - 4 * int(np.prod(shape))
        yield case(f"{name} twice", [*others, (name, content), (name, content)])
        for what, wrong in {
            "declares too much": header((2**40, 2**10)) + content[start:],
            "declares a negative size": header((-1, *shape)) + content[start:],
            "holds too much": content + b"\0" * 64,
            "holds too little": content[:-1],
            "has no header": content[start:],
            "has a header that is no Python": header(shape).replace(b"{", b"("),
            "holds objects": header(shape, "|O") + content[start:],
            "is of another version": content[:6] + b"\x09" + content[7:],
        }.items():
            yield case(f"{name} {what}", [*others, (name, wrong)])
    members = list(good.items())
    yield case("a member without .npy", [*members, ("weights/0", members[0][1])])
    for name, content in {"empty": b"", "text": b"weights", "zip": b"PK\3\4"}.items():
        yield Case(
            f"arrays: {name}",
            "E133",
            lambda path, content=content: written(path, text, content),
        )


def npy(x: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(x))
    return buffer.getvalue()


def header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    """The first bytes of an array's file, whatever follows."""
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape}, }}"
    return (
        b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + f"{text}\n".encode()
    )


def _damage(folder: Path) -> Iterator[Case]:
    """A byte flipped, or the end cut off, of each file."""
    rng = np.random.default_rng(0)
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}

    def case(name: str, what: str, content: bytes) -> Case:
        def make(path: Path) -> None:
            path.mkdir()
            for other, whole in (files | {name: content}).items():
                (path / other).write_bytes(whole)

        return Case(f"{name}: {what}", "E183", make)

    for name, content in files.items():
        for place in rng.choice(len(content), 12, replace=False).tolist():
            flipped = bytearray(content)
            flipped[place] ^= int(rng.integers(1, 256))
            yield case(name, f"byte {place}", bytes(flipped))
        for end in (0, 1, len(content) // 2, len(content) - 1):
            yield case(name, f"cut at {end}", content[:end])
