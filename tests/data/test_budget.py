"""One budget of bytes and seconds for a file: whatever it declares, in every format."""

import threading
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bombs
import recordings as rec
from recordings import Channel
from sim2gp.cli import main
from sim2gp.data.logs import Budget, Column, columns_of, read_log
from sim2gp.data.logs.budget import Meter, readable
from sim2gp.data.logs.unpack import inflate, lzf_pieces, pieces
from sim2gp.errors import InputError

MIB = 2**20
SMALL = Budget(64 * MIB, 30.0)  # a piece may have 2 MiB


def read(path: Path, name: str = "q", budget: Budget = SMALL) -> Any:
    states, actions = (Channel("q", "m"),), (Channel("u", "V"),)
    columns = {"q": Column(name), "u": 0.0}
    return read_log(path, columns, states=states, actions=actions, budget=budget)


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd", "none"])
def test_chunks_of_a_bag(kind: str, tmp_path: Path) -> None:
    """A rosbag1 is read in each compression; too small a budget refuses it."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    path, store = tmp_path / "a.bag", get_typestore(Stores.ROS1_NOETIC)
    message = "std_msgs/msg/Float64MultiArray"
    layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    writer = Writer(path)
    if kind in ("bz2", "lz4"):
        writer.set_compression(getattr(Writer.CompressionFormat, kind.upper()))
    with writer:
        arm = writer.add_connection("/arm", message, typestore=store)
        for i, value in enumerate(bombs.GOOD["q"]):
            said = store.types[message](layout=layout, data=np.full(200, value))
            raw = store.serialize_ros1(said, message)
            writer.write(arm, 10_000_000 * i, raw)
    if kind == "zstd":  # no rosbag1 is compressed so
        content = path.read_bytes().replace(b"compression=none", b"compression=zstd")
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"^E12[56] "):
            columns_of(path)
        return
    (log,) = read(path, "/arm/data[0]")
    np.testing.assert_array_equal(log.channels["q"], bombs.GOOD["q"])
    with pytest.raises(InputError, match=r"^E126 chunk too large"):
        read(path, "/arm/data[0]", Budget(MIB))


def test_a_column_by_a_part_of_its_name(tmp_path: Path) -> None:
    """To pyarrow, "q" names "q.picture" too, which unpacks to three gigabytes."""
    bombs.write_parquet(tmp_path / "a.parquet", "q.picture")
    (log,) = read(tmp_path / "a.parquet")
    np.testing.assert_array_equal(log.channels["q"], bombs.GOOD["q"])
    with pytest.raises(InputError, match=r"^E1(03|21|23|26|40) "):
        read(tmp_path / "a.parquet", "q.picture[0]")


def endless(seen: list[BaseException]) -> None:
    """A loop that takes the first interrupt for an error of its own, and goes on."""
    end = time.monotonic() + 30.0
    while True:
        try:
            while time.monotonic() < end:
                sum(range(100))
            raise AssertionError("nothing ended it")
        except BaseException as error:
            seen.append(error)
            if len(seen) > 1:
                raise


def test_a_library_that_does_not_return() -> None:
    """It is interrupted, even if it catches that once; nothing follows later."""
    meter = Meter("a.bag", Budget(seconds=0.2))
    started = time.monotonic()
    seen: list[BaseException] = []
    with pytest.raises(InputError, match=r"^E126 takes too long"), readable(meter):
        endless(seen)
    assert len(seen) == 2
    assert time.monotonic() - started < 20.0
    for _ in range(15):  # an interrupt that came late would come here
        time.sleep(0.1)
    assert "budget" not in [thread.name for thread in threading.enumerate()]


def test_errors_of_users_and_of_ours_pass() -> None:
    for error in (KeyboardInterrupt(), SystemExit(), InputError("E103", "missing")):
        with pytest.raises(type(error)) as caught, readable(Meter("a.npz")):
            raise error
        assert caught.value is error
    meter = Meter("a.npz", place="array q")
    with pytest.raises(InputError, match=r"^E126 does not fit"), readable(meter):
        raise MemoryError
    words = r"^E125 .*in a.npz:array q: got RecursionError"
    with pytest.raises(InputError, match=words), readable(meter):
        raise RecursionError


def test_a_budget_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """By one number on the command line, and by the two of it in Python."""
    monkeypatch.chdir(tmp_path)
    np.savez_compressed("a.npz", **bombs.GOOD)
    with pytest.raises(InputError, match=r"^E126 too many numbers"):
        read(Path("a.npz"), budget=Budget(1000))
    (log,) = read(Path("a.npz"), budget=Budget(1000).times(4.0))
    assert len(log) == bombs.ROWS
    (tmp_path / "p.toml").write_text(
        'system = "cartpole"\n[[logs]]\nfiles = ["a.npz"]\n'
        '[logs.columns]\nx = "q"\nvoltage = "u"\n'
    )
    assert main(["identify", "p.toml", "--budget", "1e-9"]) == 2
    assert capsys.readouterr().err.startswith("E126 ")
    for number in ("0", "-1", "inf", "nan"):
        assert main(["identify", "p.toml", f"--budget={number}"]) == 2
        assert capsys.readouterr().err.startswith("E148 ")
    for bad in ((0, 1.0), (1, 0.0), (1, float("nan"))):
        with pytest.raises(InputError, match=r"^E148 "):
            Budget(*bad)


def test_every_compression_is_unpacked_in_pieces(tmp_path: Path) -> None:
    import bz2

    import h5py
    import lz4.frame
    import zstandard

    whole = np.random.default_rng(0).integers(0, 4, 3 * MIB).astype(np.uint8).tobytes()
    packed = {
        "zstd": zstandard.compress(whole),
        "lz4": lz4.frame.compress(whole),
        "bz2": bz2.compress(whole),
        "none": whole,
    }
    for kind, content in packed.items():
        assert b"".join(pieces(content, kind, "a bag")) == whole
    assert b"".join(pieces(packed["lz4"] * 2, "lz4", "a bag")) == whole * 2
    assert b"".join(inflate(zlib.compress(whole))) == whole
    for cut in ("lz4", "bz2"):
        with pytest.raises((EOFError, RuntimeError)):
            list(pieces(packed[cut][:-9], cut, "a bag"))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        flat = np.frombuffer(whole, np.uint8)
        data = file.create_dataset("q", data=flat, chunks=flat.shape, compression="lzf")
        _, content = data.id.read_direct_chunk((0,))
    assert sum(map(len, lzf_pieces(content))) == len(whole)


@pytest.mark.parametrize("options", [
    {"compression": "gzip"},
    {"compression": "gzip", "shuffle": True, "fletcher32": True},
    {"compression": "lzf", "fletcher32": True},
    {"chunks": (7,)},
    {},
])  # fmt: skip
def test_chunks_of_hdf5_are_read_as_they_were(
    options: dict[str, Any], tmp_path: Path
) -> None:
    import h5py

    table = rec.motion()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in zip(("time", "q", "dq", "u"), table.T, strict=True):
            file.create_dataset(name, data=values, **options)
    found = columns_of(tmp_path / "a.h5", SMALL)
    np.testing.assert_array_equal(found["q"], table[:, 1])
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file.create_dataset("n", data=np.arange(400), scaleoffset=0)
    with pytest.raises(InputError, match=r"^E136 .*dataset n.*filter 6"):
        columns_of(tmp_path / "a.h5")
