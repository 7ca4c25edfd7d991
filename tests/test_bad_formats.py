"""Bad recordings of every format: one line with its code; nothing run or unpacked.

Those of the list of bad inputs stand in its own table (test_all_bad_inputs.py).
"""

import io
import json
import os
import struct
import subprocess
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
from sim2gp.data.logs import Column, read_log
from sim2gp.data.logs import file as files
from sim2gp.errors import InputError

STATES = (Channel("q", "rad", angle=True), Channel("dq", "rad/s"))
ACTIONS = (Channel("u", "V"),)
TABLE = rec.motion(rows=120)
T, Q, DQ, U = TABLE.T
GOOD = {"time": T, "q": Q, "dq": DQ, "u": U}


def line_of(path: Path, **options: Any) -> str:
    """The one line that reading says; anything but an `InputError` fails."""
    names = options.pop("names", ("q", "dq", "u"))
    columns = {c: Column(n) for c, n in zip(("q", "dq", "u"), names, strict=True)}
    with pytest.raises(InputError) as caught:
        read_log(path, columns, states=STATES, actions=ACTIONS, **options)
    line = str(caught.value)
    assert "\n" not in line
    assert "Fix: " in line
    assert "got " in line
    return line


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=True, **arrays)
    return buffer.getvalue()


def archive(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


def header(shape: tuple[int, ...]) -> bytes:
    """The start of an array that claims a shape."""
    buffer = io.BytesIO()
    spec = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(buffer, spec)
    return buffer.getvalue()


SMALL = np.ones(5)
ARCHIVES: dict[str, tuple[bytes, str, list[str]]] = {
    "nan": (
        npz(**GOOD | {"q": np.where(T == T[7], np.nan, Q)}),
        "E101",
        ["row 7", "q"],
    ),
    "missing": (npz(time=T, q=Q, u=U), "E103", ["column dq", "time, q, u", "mean q"]),
    "case": (npz(time=T, Q=Q, dq=DQ, u=U), "E103", ["column q ", "mean Q"]),
    "no time": (npz(q=Q, dq=DQ, u=U), "E103", ["column time", "state period"]),
    "table": (npz(**GOOD | {"q": TABLE[:, :2]}), "E103", ["column q ", "mean q[0]"]),
    "one more": (npz(**GOOD | {"u": U[:-1]}), "E140", ["Minari's alone"]),
    "none": (npz(time=SMALL[:0], q=Q[:0], dq=DQ[:0], u=U[:0]), "E115", ["0 rows"]),
    "one row": (npz(**{n: v[:1] for n, v in GOOD.items()}), "E116", ["1 usable row"]),
    "backwards": (npz(**GOOD | {"time": T[::-1]}), "E108", ["row 1"]),
    "other": (archive({"a.txt": b"1,2"}), "E125", ["a.txt", "numpy.savez"]),
    "gzip": (b"\x1f\x8b" + bytes(40), "E126", ["compressed"]),
    "a CSV": (b"time,q,dq,u\n", "E120", ["npz", "b'time'"]),
    "a Parquet": (b"PAR1" + bytes(40), "E120", ["the first bytes of parquet"]),
    "cut off": (npz(**GOOD)[:900], "E125", ["a whole file"]),
}


@pytest.mark.parametrize("name", ARCHIVES)
def test_bad_archive(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    content, code, words = ARCHIVES[name]
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    line = line_of(path)
    assert line.startswith(f"{code} ")
    for word in ("a.npz", *words):
        assert word in line
    assert not Path("was-unpickled").exists()


def test_an_archive_with_one_name_twice(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **GOOD)
    with zipfile.ZipFile(path, "a") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        file.writestr("q.npy", header((0,)))
    assert line_of(path).startswith("E104 column q stands twice")


def test_transposed_tables(tmp_path: Path) -> None:
    """Where no column of time tells which axis is the rows'."""
    path = tmp_path / "a.npz"
    np.savez(path, x=TABLE[:, 1:3].T, u=U[None])
    names = ("x[0]", "x[1]", "u[0]")
    assert "looks transposed" in line_of(path, names=names, period=0.01)


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    shape = (2**28 + 2**26,)
    zeros = header(shape) + bytes(2**20)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("q.npy", zeros)
    content = bytearray(path.read_bytes())
    # The archive claims more than two gigabytes, as the array's header does.
    size = 8 * shape[0]
    real, claimed = struct.pack("<I", len(zeros)), struct.pack("<I", size + 128)
    path.write_bytes(bytes(content).replace(real, claimed))
    columns = {"q": Column("q"), "u": 0.0}
    with pytest.raises(InputError, match=rf"E126 too many numbers .*{size} bytes"):
        read_log(path, columns, states=STATES, actions=ACTIONS, period=0.01)


def parquet(path: Path, **columns: Any) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table({**GOOD, **columns})
    pq.write_table(table, path, row_group_size=50, write_page_checksum=True)
    return path


def test_bad_parquet(tmp_path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = tmp_path / "a.parquet"
    columns: dict[str, tuple[Any, str]] = {
        "nulls": (pa.array([None, *Q[1:]], pa.float64()), r"E101 .*row 0, column q"),
        "truths": (pa.array(Q > 0), r"E123 .*column q"),
        "texts": (pa.array(["1"] * 120), r"E121 .*column q"),
        "halves": (pa.array(np.float16(Q)), r"E124 .*column q"),
        "records": (pa.array([{"a": 1.0}] * 120), r"E123 .*column q"),
        "dates": (pa.array([0] * 120, pa.date32()), r"E121 .*column q"),
        "nothing": (pa.nulls(120), r"E180|E123"),
        "lists": (pa.array([[1.0]] * 120), r"E103 .*did you mean q\[0\]"),
    }
    for column, pattern in columns.values():
        with pytest.raises(InputError, match=pattern):
            raise_of(parquet(path, q=column))
    twice = pa.table([T, Q, Q], names=["time", "q", "q"])
    pq.write_table(twice, path)
    assert line_of(path).startswith("E104 column q stands twice")
    ragged = pa.array([[1.0, 2.0]] + [[1.0]] * 119)
    line = line_of(parquet(path, q=ragged), names=("q[0]", "dq", "u"))
    assert line.startswith("E140 lists of different lengths")


def raise_of(path: Path) -> None:
    columns = {name: Column(name) for name in ("q", "dq", "u")}
    read_log(path, columns, states=STATES, actions=ACTIONS)


def hdf5(path: Path, make: Callable[[Any], None]) -> Path:
    import h5py

    with h5py.File(path, "w") as file:
        for name, values in GOOD.items():
            file[name] = values
        make(file)
    return path


def test_bad_hdf5(tmp_path: Path) -> None:
    import h5py

    def linked(file: Any) -> None:
        del file["q"]
        file["q"] = h5py.ExternalLink(str(tmp_path / "other.h5"), "/q")

    def huge(file: Any) -> None:
        for name in GOOD:
            del file[name]
            file.create_dataset(name, (10**9,), "f8", chunks=(10**6,))

    def worded(file: Any) -> None:
        del file["q"]
        file["q"] = ["text"] * 120

    hdf5(tmp_path / "other.h5", lambda file: None)
    for make, pattern in (
        (linked, r"^E103 missing column q"),
        (huge, r"^E126 too many numbers .*got 32000000000 bytes"),
        (worded, r"^E121 .*column q"),
    ):
        with pytest.raises(InputError, match=pattern):
            raise_of(hdf5(tmp_path / "a.h5", make))
    whole = (tmp_path / "other.h5").read_bytes()
    (tmp_path / "other.h5").write_bytes(whole[:-300])
    assert line_of(tmp_path / "other.h5").startswith("E125 file incomplete")


def test_bad_folders(tmp_path: Path) -> None:
    (tmp_path / "plain").mkdir()
    assert line_of(tmp_path / "plain").startswith("E130 not a file")
    (tmp_path / "lero" / "meta").mkdir(parents=True)
    info = tmp_path / "lero" / "meta" / "info.json"
    for text, code in (("{", "E125"), ("[1]", "E125"), ("{}", "E136")):
        info.write_text(text)
        assert line_of(tmp_path / "lero").startswith(f"{code} ")
    info.write_text(json.dumps({"codebase_version": "v3.0"}))
    assert line_of(tmp_path / "lero").startswith("E130 no data")
    (tmp_path / "ros").mkdir()
    (tmp_path / "ros" / "a.db3.zstd").write_bytes(b"\x28\xb5\x2f\xfd")
    listed = "relative_file_paths:\n    - a.db3.zstd\n"
    (tmp_path / "ros" / "metadata.yaml").write_text(listed)
    assert line_of(tmp_path / "ros").startswith("E126 compressed file")
    (tmp_path / "ros" / "metadata.yaml").write_text("a: *b\n")
    assert line_of(tmp_path / "ros").startswith("E125 ")
    place = rec.write_minari(tmp_path, [TABLE])
    names = ("observations/joint[0]", "observations/joint[1]", "actions[0]")
    import h5py

    with h5py.File(place / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/actions"].resize((118, 1))
    line = line_of(place, names=names, period=0.01)
    assert line.startswith("E140 episode of unequal lengths")
    assert "120 observations, 118 actions" in line
    assert line_of(place, names=names).startswith("E140")
    (place / "data" / "metadata.json").write_text('{"data_format": "arrow"}')
    assert "E136" in line_of(place, names=names)


def test_bad_bags(tmp_path: Path) -> None:
    rec.write_bag(tmp_path / "a.bag", TABLE, "ros1")
    names = (
        "/joint_states/elbow/position",
        "/joint_states/elbow/speed",
        "/cmd/data[0]",
    )
    line = line_of(tmp_path / "a.bag", names=names)
    assert line.startswith("E103 missing column /joint_states/elbow/speed")
    assert "did you mean /joint_states/" in line
    gone = ("/joints/elbow/position", "/joint_states/elbow/velocity", "/cmd/data[0]")
    line = line_of(tmp_path / "a.bag", names=gone)
    assert "did you mean /joint_states/elbow/position" in line
    for option in ({"period": 0.01}, {"episode": "run"}):
        assert line_of(tmp_path / "a.bag", names=gone, **option).startswith("E160")
    whole = (tmp_path / "a.bag").read_bytes()
    (tmp_path / "a.bag").write_bytes(whole[: len(whole) // 2])
    assert line_of(tmp_path / "a.bag", names=gone).startswith("E125 ")
    rec.write_mcap(tmp_path / "a.mcap", TABLE, encoding="protobuf")
    names = ("/arm/elbow/q", "/arm/elbow/dq", "/cmd/u[0]")
    line = line_of(tmp_path / "a.mcap", names=names)
    assert line.startswith("E136 ")
    assert "'protobuf'" in line


def test_a_file_that_grows_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, **GOOD)
    read = zipfile.ZipFile.infolist

    def grow(self: zipfile.ZipFile) -> Any:
        os.utime(path, ns=(0, 0))
        return read(self)

    monkeypatch.setattr(zipfile.ZipFile, "infolist", grow)
    assert line_of(path).startswith("E129 file changed")


@pytest.mark.parametrize(
    ("kind", "module", "extra"),
    [
        ("a.parquet", "pyarrow", "parquet"),
        ("a.h5", "h5py", "hdf5"),
        ("a.bag", "rosbags.rosbag1", "ros"),
        ("a.mcap", "mcap.reader", "ros"),
    ],
)
def test_a_missing_extra_is_named(
    kind: str, module: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    magic = files.MAGIC[files.SUFFIXES[Path(kind).suffix]]
    (tmp_path / kind).write_bytes(magic + bytes(64) + magic)
    monkeypatch.setitem(sys.modules, module, None)
    line = line_of(tmp_path / kind)
    assert line.startswith("E135 ")
    assert line.endswith(f"Fix: pip install 'sim2gp[{extra}]'.")


def test_reading_imports_what_it_needs_alone() -> None:
    """sim2gp starts without any of the optional libraries."""
    code = (
        "import sys, sim2gp.data.logs; names = {n.split('.')[0] for n in sys.modules};"
        "print(sorted(names & {'h5py', 'pyarrow', 'rosbags', 'mcap', 'minari'}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "[]"
