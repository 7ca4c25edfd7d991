"""Bad inputs 99 to 106: recordings of every format, read from Python."""

import io
import json
import os
import struct
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import recordings as rec
from recordings import Channel
from sim2gp.data.logs import Column, columns_of, read_log
from sim2gp.data.logs import file as files
from tests.catalogue.bad_files import archive as archive_of
from tests.catalogue.bad_files import header
from tests.catalogue.bad_inputs import Case, Input, Patch, case

STATES = (Channel("q", "rad", angle=True), Channel("dq", "rad/s"))
ACTIONS = (Channel("u", "V"),)
TABLE = rec.motion(rows=120)
T, Q, DQ, U = TABLE.T
GOOD = {"time": T, "q": Q, "dq": DQ, "u": U}
NAMES = ("q", "dq", "u")
Write = Callable[[Path], object]


def recording(
    key: str,
    name: str,
    write: Write,
    *said: str,
    names: tuple[str | float | None, ...] = NAMES,
    **options: Any,
) -> Input:
    """A file or a folder of that name, which a function writes."""

    def make(folder: Path, patch: Patch) -> None:
        write(folder / name)
        columns = {
            c: Column(n) if isinstance(n, str) else n
            for c, n in zip(NAMES, names, strict=True)
            if n is not None
        }
        read_log(folder / name, columns, states=STATES, actions=ACTIONS, **options)

    return Input(key, (Path(name).name, *said), make)


# Archives


def npz(key: str, changes: dict[str, Any], *said: str, **options: Any) -> Input:
    """What NumPy writes, of the good columns and these; None leaves one out."""
    arrays = {k: v for k, v in (GOOD | changes).items() if v is not None}
    return recording(key, "a.npz", lambda p: np.savez(p, **arrays), *said, **options)


def raw(key: str, content: bytes, *said: str, name: str = "a.npz") -> Input:
    return recording(key, name, lambda path: path.write_bytes(content), *said)


def whole() -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **GOOD)
    return buffer.getvalue()


def one_name_twice(path: Path) -> None:
    path.write_bytes(whole())
    with zipfile.ZipFile(path, "a") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file.writestr("q.npy", header(0))


def unknown_method(path: Path) -> None:
    """A member that says that it is encrypted by a method of its own."""
    content = whole()
    local, central = content.find(b"PK\3\4"), content.find(b"PK\1\2")
    changed = bytearray(content)
    changed[local + 8 : local + 10] = changed[central + 10 : central + 12] = b"\x63\0"
    path.write_bytes(changed)


#: More numbers than a reader takes, as the archive and the array's header claim.
MANY = 2**28 + 2**26


def bomb(path: Path) -> None:
    zeros = header(MANY) + bytes(2**20)
    archive_of(("q.npy", zeros))(path)
    real, claimed = struct.pack("<I", len(zeros)), struct.pack("<I", 8 * MANY + 128)
    path.write_bytes(path.read_bytes().replace(real, claimed))


def growing(folder: Path, patch: Patch) -> None:
    """A recorder that is still writing, while the archive is read."""
    read = zipfile.ZipFile.infolist

    def grow(self: zipfile.ZipFile) -> Any:
        os.utime(folder / "a.npz", ns=(0, 0))
        return read(self)

    patch.setattr(zipfile.ZipFile, "infolist", grow)
    npz("", {}).make(folder, patch)


#: What evaluates an array's header, or counts on another form, stumbles here.
ARRAY = b"{'descr': '<f8', 'fortran_order': False, 'shape': "
DAMAGED = (
    ARRAY + b"(3,",
    ARRAY + b"(3,)",
    ARRAY + b"(3,), }}",
    b"{'descr': '<f8', 'fortran_order': 0, 'shape': (3,), }",
    ARRAY + b"(-3,), }",
    ARRAY + b"(3.0,), }",
    ARRAY + b"(3 * 1,), }",
    ARRAY + b"3, }",
    ARRAY + b"(" + b"1," * 40 + b"), }",
    b"{'descr': '<f8', 'shape': (3,), 'shape': (3,), }",
    b"{'descr': '<z8', 'fortran_order': False, 'shape': (3,), }",
    b"{'descr': __import__('os'), 'fortran_order': False, 'shape': (3,), }",
    b"\xff\xfe'",
    b"''" + b"'",
    b"(" * 900,
    b"",
)


def headed(key: str, text: bytes) -> Input:
    """An array whose header has these bytes."""
    start = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text
    content = (("q.npy", start + bytes(24)),)

    def make(folder: Path, patch: Patch) -> None:
        archive_of(*content)(folder / "a.npz")
        columns_of(folder / "a.npz")

    return Input(key, ("a.npz:array q",), make)


# Tables


def parquet(key: str, column: Callable[[Any], Any], *said: str, **options: Any):
    """Row groups of 50 rows with checksums; q is what pyarrow makes of it."""

    def write(path: Path) -> None:
        pa = pytest.importorskip("pyarrow")
        import pyarrow.parquet as pq

        table = pa.table(GOOD | {"q": column(pa)})
        pq.write_table(table, path, row_group_size=50, write_page_checksum=True)

    return recording(key, "a.parquet", write, *said, **options)


def q_twice(path: Path) -> None:
    pa = pytest.importorskip("pyarrow")
    import pyarrow.parquet as pq

    pq.write_table(pa.table([T, Q, Q], names=["time", "q", "q"]), path)


def hdf5(change: Callable[[Any], object], cut: int = 0) -> Write:
    def write(path: Path) -> None:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, values in GOOD.items():
                file[name] = values
            change(file)
        path.write_bytes(path.read_bytes()[: -cut or None])

    return write


def linked(file: Any) -> None:
    del file["q"]
    file["q"] = pytest.importorskip("h5py").ExternalLink("other.h5", "/q")


def huge(file: Any) -> None:
    for name in GOOD:
        del file[name]
        file.create_dataset(name, (10**9,), "f8", chunks=(10**6,))


def worded(file: Any) -> None:
    del file["q"]
    file["q"] = ["text"] * 120


def filtered(folder: Path, patch: Patch) -> None:
    integers = np.arange(len(Q))
    hdf5(lambda file: file.create_dataset("n", data=integers, scaleoffset=0))(
        folder / "a.h5"
    )
    columns_of(folder / "a.h5")


# Folders


def lerobot(info: str) -> Write:
    def write(path: Path) -> None:
        (path / "meta").mkdir(parents=True)
        (path / "meta" / "info.json").write_text(info)

    return write


def ros(metadata: str) -> Write:
    def write(path: Path) -> None:
        path.mkdir()
        (path / "a.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
        (path / "metadata.yaml").write_text(metadata)

    return write


OF_MINARI = ("observations/joint[0]", "observations/joint[1]", "actions[0]")


def minari(key: str, change: Callable[[Any], object], about: str, *said: str) -> Input:
    """A dataset whose file and description are changed."""

    def make(folder: Path, patch: Patch) -> None:
        h5py = pytest.importorskip("h5py")
        place = rec.write_minari(folder, [TABLE])
        with h5py.File(place / "data" / "main_data.hdf5", "a") as file:
            change(file)
        if about:
            (place / "data" / "metadata.json").write_text(about)
        columns = {c: Column(n) for c, n in zip(NAMES, OF_MINARI, strict=True)}
        read_log(place, columns, states=STATES, actions=ACTIONS, period=0.01)

    return Input(key, said, make)


# Packages


def without(name: str, module: str, extra: str) -> Input:
    def make(folder: Path, patch: Patch) -> None:
        magic = files.MAGIC[files.SUFFIXES[Path(name).suffix]]
        patch.setitem(sys.modules, module, None)
        raw("", magic + bytes(64) + magic, name=name).make(folder, patch)

    return Input("package_missing", (f"pip install 'sim2gp[{extra}]'",), make)


def limited(folder: Path, patch: Patch) -> None:
    """A text file of more than a reader takes."""
    (folder / "project.toml").write_text("# long\n")
    with files.unchanged_size(folder / "project.toml", limit=3):
        pass


FORMATS: tuple[Case, ...] = (
    case(
        99,
        "columns of an archive",
        npz("value_not_finite", {"q": np.where(T == T[7], np.nan, Q)}, "row 7", "q"),
        npz("missing_column", {"dq": None}, "column dq", "time, q, u", "mean q"),
        npz("missing_column", {"q": None, "Q": Q}, "column q ", "mean Q"),
        npz("missing_column", {"time": None}, "column time"),
        npz("missing_column", {"q": TABLE[:, :2]}, "column q ", "mean q[0]"),
        npz("columns_of_different_lengths", {"u": U[:-1]}),
        npz("no_rows", {n: v[:0] for n, v in GOOD.items()}, "0 rows"),
        npz("no_transition", {n: v[:1] for n, v in GOOD.items()}, "1 usable row"),
        npz("time_does_not_increase", {"time": T[::-1]}, "row 1"),
        recording(
            "array_transposed",
            "a.npz",
            lambda path: np.savez(path, x=TABLE[:, 1:3].T, u=U[None]),
            names=("x[0]", "x[1]", "u[0]"),
            period=0.01,
        ),
    ),
    case(
        100,
        "archive",
        recording("member_not_an_array", "a.npz", archive_of(("a.txt", b"1,2"))),
        raw("compressed_file", b"\x1f\x8b" + bytes(40)),
        raw("not_what_its_name_says", b"time,q,dq,u\n", "b'time'"),
        raw("not_what_its_name_says", b"PAR1" + bytes(40), "parquet"),
        raw("file_incomplete_or_damaged", whole()[:900]),
        recording("repeated_column", "a.npz", one_name_twice, "column q"),
        recording("unknown_archive_compression", "a.npz", unknown_method, "method 99"),
        Input("file_changed_while_read", ("a.npz",), growing),
        Input("file_too_large", ("project.toml",), limited),
        Input(
            "nul_in_path",
            (),
            lambda folder, patch: columns_of(folder / "a\0.csv"),
        ),
    ),
    case(
        101,
        "archive that claims too much",
        recording(
            "beyond_the_budget",
            "a.npz",
            bomb,
            f"{8 * MANY} bytes",
            names=("q", None, 0.0),
            period=0.01,
        ),
    ),
    case(
        102,
        "header of an array",
        *[headed("file_incomplete_or_damaged", text) for text in DAMAGED],
    ),
    case(
        103,
        "Parquet",
        parquet(
            "value_not_finite",
            lambda pa: pa.array([None, *Q[1:]], pa.float64()),
            "row 0, column q",
        ),
        parquet("array_not_real", lambda pa: pa.array(Q > 0), "column q"),
        parquet("text_in_array", lambda pa: pa.array(["1"] * 120), "column q"),
        parquet("too_few_digits", lambda pa: pa.array(np.float16(Q)), "column q"),
        parquet("array_not_real", lambda pa: pa.array([{"a": 1.0}] * 120), "column q"),
        parquet(
            "text_in_array", lambda pa: pa.array([0] * 120, pa.date32()), "column q"
        ),
        parquet("array_of_objects", lambda pa: pa.nulls(120)),
        parquet("missing_column", lambda pa: pa.array([[1.0]] * 120), "mean q[0]"),
        parquet(
            "lists_of_different_lengths",
            lambda pa: pa.array([[1.0, 2.0]] + [[1.0]] * 119),
            names=("q[0]", "dq", "u"),
        ),
        recording("repeated_column", "a.parquet", q_twice, "column q"),
    ),
    case(
        104,
        "HDF5",
        recording("missing_column", "a.h5", hdf5(linked), "column q"),
        recording("beyond_the_budget", "a.h5", hdf5(huge), "got 32000000000 bytes"),
        recording("text_in_array", "a.h5", hdf5(worded), "column q"),
        recording("file_incomplete_or_damaged", "a.h5", hdf5(lambda file: None, 300)),
        Input("unread_hdf5_filter", ("dataset n", "filter 6"), filtered),
    ),
    case(
        105,
        "folders",
        recording("not_a_file", "plain", Path.mkdir, "a folder"),
        recording("file_incomplete_or_damaged", "lero", lerobot("{")),
        recording("file_incomplete_or_damaged", "lero", lerobot("[1]")),
        recording("not_lerobot_format", "lero", lerobot("{}")),
        recording(
            "lerobot_without_data",
            "lero",
            lerobot(json.dumps({"codebase_version": "v3.0"})),
        ),
        recording(
            "compressed_file",
            "ros",
            ros("relative_file_paths:\n    - a.db3.zstd\n"),
        ),
        recording("file_incomplete_or_damaged", "ros", ros("a: *b\n")),
        minari(
            "episode_of_unequal_lengths",
            lambda file: file["episode_0/actions"].resize((118, 1)),
            "",
            "120 observations, 118 actions",
        ),
        minari("not_minari_format", lambda file: None, '{"data_format": "arrow"}'),
        minari("no_episodes", lambda file: file.pop("episode_0"), ""),
    ),
    case(
        106,
        "a package is missing",
        without("a.parquet", "pyarrow", "parquet"),
        without("a.h5", "h5py", "hdf5"),
        without("a.bag", "rosbags.rosbag1", "ros"),
        without("a.mcap", "mcap.reader", "ros"),
    ),
)
