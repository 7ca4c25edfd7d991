"""Programs kept between commands: in a private folder, one for each processor."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from sim2gp.cli import kept_programs, main
from sim2gp.cli.kept_programs import FOLDER, keep_programs

linux = pytest.mark.skipif(sys.platform != "linux", reason="kept on Linux only")


@pytest.fixture
def without_jax(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "jax")


def kept(cache: Path, **more: str) -> dict[str, str]:
    environment = {"XDG_CACHE_HOME": str(cache)} | more
    keep_programs(environment)
    return environment


@linux
@pytest.mark.usefixtures("without_jax")
def test_a_private_folder_is_named_by_the_processor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = Path(kept(tmp_path)[FOLDER])
    assert mine.parent == tmp_path / "sim2gp" / "programs"
    assert mine.stat().st_mode & 0o777 == 0o700
    monkeypatch.setattr(kept_programs, "_processor", lambda: "another")
    assert kept(tmp_path)[FOLDER] == str(mine.with_name("another"))
    assert kept(tmp_path, JAX_COMPILATION_CACHE_DIR="/x")[FOLDER] == "/x"


@linux
@pytest.mark.usefixtures("without_jax")
def test_nothing_is_kept_where_others_may_write(tmp_path: Path) -> None:
    folder = Path(kept(tmp_path)[FOLDER])
    folder.chmod(0o770)
    assert FOLDER not in kept(tmp_path)
    folder.chmod(0o700)
    assert FOLDER in kept(tmp_path)
    file = tmp_path / "file"
    file.write_text("")
    assert FOLDER not in kept(file)


def test_a_process_that_has_jax_decides_for_itself(tmp_path: Path) -> None:
    assert "jax" in sys.modules
    assert FOLDER not in kept(tmp_path)
    assert not list(tmp_path.iterdir())


PROGRAM = """
import os, sys
from sim2gp.cli import kept_programs, main
kept_programs.SECONDS = 0.0
kept_programs.keep_programs(os.environ)
import jax
hits = []
jax.monitoring.register_event_listener(lambda event, **more: hits.append(event))
jax.jit(lambda x: jax.numpy.sin(x) @ x)(jax.numpy.ones(3)).block_until_ready()
print(sum(hit == "/jax/compilation_cache/cache_hits" for hit in hits))
"""


@linux
def test_the_next_process_takes_what_was_compiled(tmp_path: Path) -> None:
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    for name in (FOLDER, kept_programs.LEAST, kept_programs.SIZE):
        environment.pop(name, None)

    def hits() -> int:
        words = sys.executable, "-c", PROGRAM
        done = subprocess.run(words, env=environment, capture_output=True, check=True)
        return int(done.stdout)

    assert hits() == 0
    assert hits() > 0


@pytest.mark.parametrize("words", [(), ("--no-cache",)])
def test_an_option_keeps_nothing(
    words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr("sim2gp.cli.keep_programs", asked.append)
    assert main(["example", str(tmp_path / "first"), "--quiet", *words]) == 0
    assert asked == ([] if words else [os.environ])
