"""The table of bad inputs: what an input is, and how logs are spoilt.

A case is a number, a title, and inputs. An input is made in a folder. What must be
said of it is a key of the catalogue of errors, and the places and names that the line
has to have. The files of cases share what is here.
"""

import os
import socket
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim2gp.errors import catalogue

Patch = pytest.MonkeyPatch
Make = Callable[[Path, Patch], Sequence[str] | None]

PROJECT = """system = "cartpole"

[[logs]]
files = ["*.csv"]
time = "t"

[logs.columns]
x = "pos"
"x.velocity" = "vel"
theta = "angle"
voltage = "cmd"
"""
HEADER = "t,pos,vel,angle,cmd"
IDENTIFY = ("identify", "project.toml")
PERIOD, ROWS = 0.01, 300


@dataclass(frozen=True)
class Input:
    """``make`` writes the input and returns a command's words; None: it raises.

    ``key`` is its error's in the catalogue. A code stands for an error that is not
    there (of the command line, of a value in a project file), and a code that begins
    with W for a note of a command that goes on; "" is no error.
    """

    key: str
    words: tuple[str, ...]
    make: Make
    summary: dict[str, Any] = field(default_factory=dict)
    brief: bool = False  # a command's line without what is expected, or the fix

    @property
    def code(self) -> str:
        """That of the entry, or the key itself."""
        known = catalogue().get(self.key)
        return self.key if known is None else known.code


@dataclass(frozen=True)
class Case:
    """A line of the list of bad inputs."""

    number: int
    title: str
    inputs: tuple[Input, ...]


def case(number: int, title: str, *inputs: Input) -> Case:
    return Case(number, title, inputs)


def refusal(key: str, make: Callable[[], object], *words: str) -> Input:
    """An error of a call from Python, which needs no folder."""

    def called(folder: Path, patch: Patch) -> None:
        make()

    return Input(key, words, called)


def refusals(key: str, *calls: tuple[str, Callable[[], object]]) -> list[Input]:
    """Several calls of one error, each with the name of what is refused."""
    return [refusal(key, make, what) for what, make in calls]


def table(time: np.ndarray | None = None) -> np.ndarray:
    """Rows of a cart that swings, of a pole that has its own will, and a chirp."""
    t = PERIOD * np.arange(ROWS) if time is None else time
    x, v = 0.2 * np.sin(3 * t), 0.6 * np.cos(3 * t)
    return np.stack([t, x, v, np.cos(t), np.sin(t * t)], axis=1)


def text(values: np.ndarray | None = None, header: str = HEADER) -> str:
    values = table() if values is None else values
    rows = [",".join(repr(float(v)) for v in row) for row in values]
    return "\n".join([header, *rows]) + "\n"


def changed(row: int, column: int, value: float) -> str:
    values = table()
    values[row, column] = value
    return text(values)


def cell(row: int, column: int, value: str) -> str:
    """The text with one cell replaced; row 0 is line 2."""
    lines = text().splitlines()
    cells = lines[row + 1].split(",")
    cells[column] = value
    lines[row + 1] = ",".join(cells)
    return "\n".join(lines)


def column(index: int, function: Callable[[np.ndarray], Any]) -> str:
    values = table()
    values[:, index] = function(values[:, index])
    return text(values)


def swapped(one: int, other: int) -> str:
    values = table()
    values[:, [one, other]] = values[:, [other, one]]
    return text(values)


def clock(jump: float, row: int = 100) -> str:
    values = table()
    values[row:, 0] += jump
    return text(values)


def marked(every: int) -> str:
    values = table()
    values[::every, 3] = -9999.0
    return text(values)


def episodes(ids: np.ndarray) -> str:
    return text(np.column_stack([table(), ids]), HEADER + ",run")


def log(
    content: str | bytes,
    key: str,
    *words: str,
    project: str = PROJECT,
    command: Sequence[str] = IDENTIFY,
    **summary: Any,
) -> Input:
    """A file a.csv beside a project that names it."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(project)
        raw = content.encode("latin-1") if isinstance(content, str) else content
        (folder / "a.csv").write_bytes(raw)
        return command

    named = ("a.csv", *words) if key else words
    return Input(key, named, make, summary)


def stored(name: str, write: Callable[[Path], object], key: str, *words: str) -> Input:
    """A file of any format that a project names, and that a function writes."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(PROJECT.replace("*.csv", name))
        write(folder / name)
        return IDENTIFY

    return Input(key, (name, *words), make)


def renamed(old: str, new: str) -> str:
    assert old in PROJECT
    return PROJECT.replace(old, new)


TEXTS = text()
GOOD = dict(zip(HEADER.split(","), table().T, strict=True))
DEGREES = renamed('x = "pos"\n"x.velocity" = "vel"\ntheta = "angle"', "") + (
    'theta = "pos"\n"theta.velocity" = "vel"\n'
)
BY_RUN = renamed('time = "t"', 'time = "t"\nepisode = "run"')
COUNTS = renamed(
    'x = "pos"\n"x.velocity" = "vel"', 'x = {column = "pos", scale = 1e-3}'
)
WRAPPED = np.angle(np.exp(1j * 9 * table()[:, 0]))


def npz(**changes: Any) -> Callable[[Path], None]:
    """Writes arrays by NumPy, pickling where it wants to: the reader must not."""
    return lambda path: np.savez(path, allow_pickle=True, **GOOD | changes)


def parquet(path: Path) -> bytes:
    """Row groups of 50 rows with checksums of their pages."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    pq.write_table(pa.table(GOOD), path, row_group_size=50, write_page_checksum=True)
    return path.read_bytes()


def short_parquet(path: Path) -> None:
    path.write_bytes(parquet(path)[:-200])


def damaged_page(path: Path) -> None:
    """One byte of a page of the second row group is another."""
    whole = bytearray(parquet(path))
    import pyarrow.parquet as pq

    place = pq.ParquetFile(path).metadata.row_group(1).column(1)
    first = place.dictionary_page_offset or place.data_page_offset
    whole[first + place.total_compressed_size - 5] ^= 0xFF
    path.write_bytes(whole)


def many_rows(path: Path) -> None:
    """A hundred million rows in some kilobytes: run lengths make it true."""
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    pages = pa.table(dict.fromkeys(GOOD, pa.nulls(1_000_000, pa.float64())))
    with pq.ParquetWriter(path, pages.schema, compression="zstd") as writer:
        for _ in range(100):
            writer.write_table(pages)


def outside(path: Path) -> None:
    """An HDF5 file whose numbers lie in another file."""
    h5py = pytest.importorskip("h5py")
    (path.parent / "secret").write_bytes(bytes(8 * ROWS))
    with h5py.File(path, "w") as file:
        for name, values in GOOD.items():
            if name != "pos":
                file[name] = values
        external = [(str(path.parent / "secret"), 0, 8 * ROWS)]
        file.create_dataset("pos", (ROWS,), "f8", external=external)


def bound_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        here = Path.cwd()
        os.chdir(path.parent)  # a socket's own path must be short
        made.bind(path.name)
        os.chdir(here)


def locked(path: Path) -> None:
    path.write_text(TEXTS)
    path.chmod(0)
    if os.access(path, os.R_OK):  # nothing is forbidden to root: a loop is unreadable
        path.unlink()
        path.symlink_to(path.name)


def named(files: str, key: str, *words: str) -> Input:
    """A project that names files which are not there."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        (folder / "project.toml").write_text(PROJECT.replace("*.csv", files))
        return IDENTIFY

    return Input(key, words, make)


def growing(folder: Path, patch: Patch) -> Sequence[str]:
    """A recorder that is still writing."""
    (folder / "project.toml").write_text(PROJECT)
    (folder / "a.csv").write_text(TEXTS)
    read = Path.read_bytes

    def grow(self: Path) -> bytes:
        content = read(self)
        if self.name == "a.csv":
            os.utime(self, ns=(0, self.stat().st_mtime_ns + 1_000_000))
        return content

    patch.setattr(Path, "read_bytes", grow)
    return IDENTIFY


def late(rows: int) -> np.ndarray:
    """A cart on which held random commands act, logged some rows too late."""
    rng = np.random.default_rng(0)
    t = PERIOD * np.arange(ROWS)
    u = np.repeat(rng.uniform(-1.0, 1.0, ROWS // 4), 4)
    v = np.concatenate([[0.0], np.cumsum(PERIOD * (20 * u - 1.0))[:-1]])
    v -= v.mean()
    x = np.concatenate([[0.0], np.cumsum(PERIOD * 0.5 * (v[1:] + v[:-1]))])
    return np.stack([t, x, v, 0 * t, np.roll(u, rows)], axis=1)


MODEL = """<mujoco><worldbody><body name="arm">
  <joint name="hip" damping=".1"/>
  <inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/>
</body></worldbody><actuator><motor name="push" joint="hip"/></actuator></mujoco>
"""
LOGS = """[[logs]]
files = ["a.csv"]
time = "t"
[logs.columns]
hip = "pos"
push = "cmd"
"""


def model(text: str, key: str, *said: str, more: str = "") -> Input:
    """A project about a model's file."""

    def make(folder: Path, patch: Patch) -> Sequence[str]:
        pytest.importorskip("mujoco")
        (folder / "arm.xml").write_text(text)
        (folder / "a.csv").write_text(TEXTS)
        (folder / "project.toml").write_text(f'system = "arm.xml"\n{LOGS}{more}')
        return IDENTIFY

    return Input(key, said, make)
