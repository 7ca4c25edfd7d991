"""No key of a project file is accepted and ignored: each changes what a command reads.

The schema is walked, whatever it holds (the pairs of files are in `key_changes`).
"""

import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import pytest
from pydantic import BaseModel

from key_changes import ALSO, CHANGES, REFUSED, Observe, loaded, write_files
from sim2gp.errors import InputError
from sim2gp.project import schema
from sim2gp.project.project import SYSTEMS, system_class
from tests.data.test_streams import asynchronous


def keys(model: type[BaseModel], path: str = "") -> Iterator[str]:
    """Every key of a schema by its path; "*" is a name of the user's."""
    for name, field in model.model_fields.items():
        yield from within(field.annotation, f"{path}.{name}".lstrip("."))


def within(kind: Any, path: str) -> Iterator[str]:
    """A key of some type, and the keys inside it."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        yield from keys(kind, path)
        return
    args = typing.get_args(kind)
    origin = typing.get_origin(kind)
    if origin is dict:
        yield from (path,) if args[1] is Any else within(args[1], f"{path}.*")
        return
    if origin is list:
        inner = [a for a in args if isinstance(a, type) and issubclass(a, BaseModel)]
        yield from within(inner[0], path) if inner else (path,)
        return
    if origin is typing.Annotated:
        yield from within(args[0], path)
        return
    if origin in (typing.Union, types.UnionType):
        found = [list(within(arg, path)) for arg in args if arg is not type(None)]
        yield from dict.fromkeys(key for each in found for key in each)
        return
    yield path


ALL_KEYS = sorted(set(keys(schema.ProjectSpec)))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the files are, and the test."""
    write_files(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def seen(folder: Path, said: str, observe: Observe, patch: pytest.MonkeyPatch) -> str:
    """What a command makes of a file, or why it refuses the file."""
    try:
        return observe(loaded(folder, said), patch)
    except InputError as error:
        return f"{error.code} {error.what}"


@pytest.mark.parametrize("key", [*ALL_KEYS, *ALSO])
def test_no_key_is_accepted_and_ignored(
    key: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if "mcap" in str(CHANGES.get(key)):
        pytest.importorskip("mcap")
        asynchronous(folder / "a.mcap")
    if "arm.xml" in str(CHANGES.get(key)):
        pytest.importorskip("mujoco")
    if key in REFUSED:
        with pytest.raises(InputError, match="E160"):
            loaded(folder, REFUSED[key])
        return
    assert key in CHANGES | ALSO, f"write two files that {key} makes different"
    before, after, observe = (CHANGES | ALSO)[key]
    was = seen(folder, before, observe, monkeypatch)
    now = seen(folder, after, observe, monkeypatch)
    assert was != now
    assert not now.startswith("E"), now


def test_the_walk_sees_the_whole_schema() -> None:
    assert set(CHANGES) | set(REFUSED) == set(ALL_KEYS)
    for key in ALL_KEYS:
        *table, last = key.split(".")
        assert last == "*" or last in schema.keys_at(tuple(table)), key


#: One value of each option that is not its default.
OPTIONS: dict[str, Any] = {
    "gravity": 3.0,
    "locked": "[true, false]",
    "motor_resistance": 2.0,
    "motor_inertia": 2e-6,
    "gear_ratio": 2.0,
    "pinion_radius": 0.01,
    "motor_efficiency": 0.8,
    "gear_efficiency": 0.8,
    "length1": 0.3,
    "coulomb_width": 0.5,
    "coulomb_shape": '"arctangent"',
}
MACHINES = [name for name in SYSTEMS if name != "cart_pole"]


def options_of(machine: str) -> list[str]:
    hints = system_class(machine).__init__.__annotations__
    return [name for name in hints if name not in ("parameters", "return")]


@pytest.mark.parametrize(
    ("machine", "option"), [(m, option) for m in MACHINES for option in options_of(m)]
)
def test_each_option_moves_its_machine(machine: str, option: str, folder: Path) -> None:
    # Gravity and friction are those of a machine that has them.
    has = f'system = "{machine}"\n'
    has += (
        "[options]\ngravity = 9.81\n"
        if "gravity" in options_of(machine)
        else "[options]\n"
    )
    line = f"{option} = {OPTIONS[option]}\n"
    after = has.replace("gravity = 9.81\n", line) if option == "gravity" else has + line
    plain, changed = (loaded(folder, said).system for said in (has, after))
    s = 0.1 * jnp.arange(1.0, 5.0)
    a = jnp.full(len(plain.actions), 0.2)
    before = plain.flow(plain.nominal(), s, a, 0.01)
    assert bool(jnp.any(before != changed.flow(changed.nominal(), s, a, 0.01)))
    assert before.shape == s.shape
