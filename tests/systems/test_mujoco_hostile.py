"""Model files that reach for files outside their folder: none is accepted or opened."""

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import hostile_models
from hostile_models import SHOWN, Hostile, furnish, hostile, watched
from sim2gp.errors import InputError
from sim2gp.systems.mujoco import load as mjcf_load
from sim2gp.systems.mujoco import sources as mjcf_sources
from sim2gp.systems.mujoco.load import compiled
from sim2gp.systems.mujoco.sources import read_sources

mujoco = pytest.importorskip("mujoco", reason="the extra `mujoco` is not installed")
pytest.importorskip("lxml", reason="the extra `mujoco` is not installed")
linux = pytest.mark.skipif(sys.platform != "linux", reason="inotify")
CHILD = Path(hostile_models.__file__).with_name("hostile_child.py")


def documents(count: int, model: Path, seed: int = 0) -> list[Hostile]:
    rng = np.random.default_rng(seed)
    return [hostile(rng, model) for _ in range(count)]


def accepted(found: list[Hostile], model: Path) -> tuple[list[Hostile], Counter]:
    """Those that the guard lets through, and why it refuses the others."""
    good, codes = [], Counter()
    for each in found:
        try:
            read_sources(each.write(model), model)
        except InputError as error:
            codes[str(error).split()[0]] += 1
        else:
            good.append(each)
    return good, codes


@pytest.mark.parametrize(
    "count", [1_000, pytest.param(10_000, marks=pytest.mark.nightly)]
)
def test_no_hostile_document_is_accepted(tmp_path: Path, count: int) -> None:
    """Whatever spelling, encoding, element and nesting a path outside has."""
    model, outside = furnish(tmp_path)
    found = documents(count, model)
    if sys.platform == "linux":
        with watched(outside) as opened:
            good, codes = accepted(found, model)
        assert opened == []
    else:
        good, codes = accepted(found, model)
    assert good == []
    assert set(codes) == {"E170", "E171"}
    assert codes["E171"] > count / 4  # or the grammar would make no paths


def compiled_anyway(found: list[Hostile], model: Path, way: str) -> list[list[float]]:
    """Masses of bodies in what MuJoCo makes of documents that were refused."""
    lines = [
        json.dumps(
            {
                "text": each.text.decode("latin-1"),
                "part": None if each.part is None else each.part.decode("latin-1"),
                "suffix": each.suffix,
            }
        )
        for each in found
    ]
    child = str(Path(mjcf_load.__file__).with_name("compile_child.py"))
    done = subprocess.run(
        [sys.executable, "-I", str(CHILD), child, str(model), way],
        input="\n".join(lines),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def shown(masses: list[list[float]]) -> int:
    """In how many models a sentinel weighs something."""
    return sum(
        any(np.isclose(mass, s, rtol=1e-3) for mass in each for s in SHOWN)
        for each in masses
    )


@linux
def test_the_compiler_opens_nothing_outside(tmp_path: Path) -> None:
    """500 documents: by our loader, and to the compiler although they are refused.

    The compiler without its seal opens sentinels, which the watch and masses show.
    """
    model, outside = furnish(tmp_path)
    found = documents(500, model, seed=1)
    with watched(outside) as opened:
        for each in found:
            with pytest.raises(InputError):
                compiled(each.write(model))
    assert opened == []
    with watched(outside) as opened:
        masses = compiled_anyway(found, model, "sealed")
    assert opened == []
    assert (len(masses), shown(masses)) == (500, 0)
    with watched(outside) as opened:
        masses = compiled_anyway(found, model, "open")
    assert {"secret.stl", "secret.xml", "secret.mjcf.xml", "secret.obj"} <= set(opened)
    assert shown(masses) > 20


@linux
@pytest.mark.parametrize(
    "planted", ["links", pytest.param("dots", marks=pytest.mark.nightly)]
)
def test_a_planted_bypass_is_caught(tmp_path: Path, monkeypatch, planted: str) -> None:
    """A guard that lets one trick through: it is accepted, opened, and weighs."""
    model, outside = furnish(tmp_path)
    right = mjcf_sources.is_inside

    def lexical(file: str, root: str) -> bool:
        return Path(file).is_relative_to(root)  # links are not followed

    def wrong(file: str, root: str) -> bool:
        return "outside" in file or right(file, root)

    monkeypatch.setattr(
        mjcf_sources, "is_inside", lexical if planted == "links" else wrong
    )
    with watched(outside) as opened:
        good, _ = accepted(documents(300, model), model)
    assert good
    assert opened
    masses: list[list[float]] = []
    for each in good:  # until one of them has the sentinel's mesh or body
        try:
            masses.append(compiled(each.write(model), model).body_mass.tolist())
        except InputError:
            continue
        if shown(masses):
            return
    raise AssertionError(f"{len(good)} accepted, no sentinel's mass")
