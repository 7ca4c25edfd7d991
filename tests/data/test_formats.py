"""Every format, written by its own library: one motion is one log, bit by bit."""

import contextlib
import json
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import recordings as rec
from recordings import Channel
from sim2gp.data.logs import Column, Log, columns_of, read_log
from sim2gp.data.split_log import cut
from sim2gp.errors import InputError
from sim2gp.identification.fit import fit_windows
from sim2gp.project import load_project
from simulated_logs import FREE, simulated

STATES = (Channel("q", "rad", angle=True), Channel("q.velocity", "rad/s"))
ACTIONS = (Channel("u", "V"),)
ONE, TWO = rec.motion(), rec.motion(1.0, 300)
JOINT = ("/joint_states/elbow/position", "/joint_states/elbow/velocity", "/cmd/data[0]")

#: Format -> what writes it, the place, columns of q, q.velocity and u, the period.
SINGLE: dict[str, tuple[Callable[..., Any], str, tuple[str, str, str]]] = {
    "csv": (rec.write_csv, "a.csv", ("q", "dq", "u")),
    "npz": (rec.write_npz, "a.npz", ("state[0]", "state[1]", "u")),
    "parquet": (rec.write_parquet, "a.parquet", ("state[0]", "state[1]", "u")),
    "rosbag1": (lambda p, t: rec.write_bag(p, t, "ros1"), "a.bag", JOINT),
    "rosbag2": (lambda p, t: rec.write_bag(p, t, "sqlite3"), "bag", JOINT),
    "rosbag2 MCAP": (lambda p, t: rec.write_bag(p, t, "mcap"), "capped", JOINT),
    "MCAP": (rec.write_mcap, "a.mcap", ("/arm/elbow/q", "/arm/elbow/dq", "/cmd/u[0]")),
}
LEROBOT = ("observation.state/elbow.pos", "observation.state/elbow.vel", "action[0]")
JOINTS = ("observations/joint[0]", "observations/joint[1]", "actions[0]")
SEVERAL: dict[str, tuple[Callable[..., Any], str, tuple[str, str, str]]] = {
    "hdf5": (rec.write_hdf5, "a.h5", ("obs/joint[0]", "obs/joint[1]", "u")),
    "v2.1": (lambda p, e: rec.write_lerobot(p, e, "v2.1"), "v2", LEROBOT),
    "v3.0": (lambda p, e: rec.write_lerobot(p, e, "v3.0"), "v3", LEROBOT),
    "minari": (lambda p, e: rec.write_minari(p.parents[1], e), "swing/test-v0", JOINTS),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("formats")
    for write, name, _ in SINGLE.values():
        write(folder / name, ONE)
    for write, name, _ in SEVERAL.values():
        write(folder / name, [ONE, TWO])
    return folder


def read(path: Path, names: tuple[str, ...], **options: Any) -> tuple[Log, ...]:
    named = zip(("q", "q.velocity", "u"), names, strict=True)
    columns = {channel: Column(name) for channel, name in named}
    return read_log(path, columns, states=STATES, actions=ACTIONS, **options)


def assert_same(log: Log, table: np.ndarray, time: np.ndarray | None = None) -> None:
    np.testing.assert_array_equal(log.time, table[:, 0] if time is None else time)
    np.testing.assert_array_equal(log.channels["q"], table[:, 1])
    np.testing.assert_array_equal(log.channels["q.velocity"], table[:, 2])
    np.testing.assert_array_equal(log.inputs["u"], table[:, 3])
    assert all(mask.all() for mask in log.mask.values())


@pytest.mark.parametrize("kind", SINGLE)
def test_one_motion_in_every_format(folder: Path, kind: str) -> None:
    _, name, names = SINGLE[kind]
    (log,) = read(folder / name, names)
    assert_same(log, ONE)
    assert log.name == Path(name).stem


@pytest.mark.parametrize("kind", SEVERAL)
def test_episodes_are_logs_of_their_own(folder: Path, kind: str) -> None:
    _, name, names = SEVERAL[kind]
    period = 0.01 if kind == "minari" else None
    one, two = read(folder / name, names, period=period)
    even = None if period is None else period * np.arange(400)
    held = [table.copy() for table in (ONE, TWO)]
    for table in held if kind == "minari" else ():
        table[-1, 3] = table[-2, 3]  # an action that was never taken
    assert_same(one, held[0], even)
    assert_same(two, held[1], even if even is None else even[:300])
    assert one.source != two.source
    label = "demo_{}" if kind == "hdf5" else "{}"
    stem = "a" if kind == "hdf5" else Path(name).name
    expected = [f"{stem}[{label.format(i)}]" for i in (0, 1)]
    assert [one.name, two.name] == expected


def test_minari_itself_reads_what_was_read(folder: Path) -> None:
    import minari

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(folder))
        episodes = list(minari.load_dataset("swing/test-v0").iterate_episodes())
    logs = read(folder / "swing/test-v0", JOINTS, period=0.01)
    for log, episode in zip(logs, episodes, strict=True):
        seen = episode.observations["joint"]
        np.testing.assert_array_equal(log.channels["q"], seen[:, 0])
        np.testing.assert_array_equal(log.inputs["u"][:-1], episode.actions[:, 0])
        assert log.inputs["u"][-1] == log.inputs["u"][-2]  # the last action is held
        assert len(log) == len(episode.actions) + 1


@pytest.mark.parametrize("kind", [*SINGLE, *SEVERAL])
def test_every_numeric_column_is_told(folder: Path, kind: str) -> None:
    _, name, names = (SINGLE | SEVERAL)[kind]
    found = columns_of(folder / name)
    for column, values in zip(names, ONE[:, 1:].T, strict=True):
        if kind == "minari" and column == names[2]:
            values = np.append(values[:-1], values[-2])
        np.testing.assert_array_equal(found[column], values)


def test_a_single_file_of_a_rosbag2_is_read_too(folder: Path) -> None:
    for file in (*(folder / "bag").glob("*.db3"), *(folder / "capped").glob("*.mcap")):
        (log,) = read(file, JOINT)
        assert_same(log, ONE)


def test_a_bag_without_definitions(folder: Path, tmp_path: Path) -> None:
    """As ROS 2 Humble writes them: the types of ROS itself are known."""
    shutil.copytree(folder / "bag", tmp_path / "bag")
    (database,) = (tmp_path / "bag").glob("*.db3")
    with contextlib.closing(sqlite3.connect(database)) as connection:
        connection.execute("DELETE FROM message_definitions")
        connection.commit()
    (log,) = read(tmp_path / "bag", JOINT)
    assert_same(log, ONE)
    for file in (database, tmp_path / "bag" / "metadata.yaml"):
        content = file.read_bytes().replace(b"Float64MultiArray", b"Float64XxxxxXxxxx")
        file.write_bytes(content)
    assert "/cmd/data[0]" not in columns_of(tmp_path / "bag")
    with pytest.raises(InputError, match=r"E136 .*/cmd: got std_msgs/msg/Float64Xxx"):
        read(tmp_path / "bag", JOINT)


def test_fields_of_any_message_by_path(tmp_path: Path) -> None:
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    make = store.types
    stamp = make["builtin_interfaces/msg/Time"](12, 34)
    header = make["std_msgs/msg/Header"](stamp=stamp, frame_id="base")
    vector, nine = make["geometry_msgs/msg/Vector3"], np.arange(9.0)
    turn = make["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    rate, pull = vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0)
    imu = make["sensor_msgs/msg/Imu"](header, turn, nine, rate, nine, pull, nine)
    pixels = np.zeros(3000, dtype=np.uint8)
    picture = make["sensor_msgs/msg/CompressedImage"](header, "jpeg", pixels)
    state = make["std_msgs/msg/Float64"](7.5)
    with Writer(tmp_path / "bag", version=9) as writer:
        for topic, said in (("/imu", imu), ("/camera", picture), ("/level", state)):
            kind = said.__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            writer.write(connection, 10**9, store.serialize_cdr(said, kind))
    found = {name: float(v[0]) for name, v in columns_of(tmp_path / "bag").items()}
    assert found["/imu/angular_velocity/z"] == 3.0
    assert found["/imu/linear_acceleration/x"] == 4.0
    assert found["/imu/linear_acceleration_covariance[8]"] == 8.0
    assert found["/level/data"] == 7.5
    assert not [name for name in found if "header" in name or "camera" in name]


def test_nanoseconds_keep_their_digits(tmp_path: Path) -> None:
    """Stamps since 1970 in float64 are 256 ns apart: the start goes first."""
    now = rec.START + rec.stamps()
    np.savez(tmp_path / "a.npz", t=now, q=ONE[:, 1:3], u=ONE[:, 3])
    clock = Column("t", "ns")
    (log,) = read(tmp_path / "a.npz", ("q[0]", "q[1]", "u"), time=clock)
    np.testing.assert_allclose(log.time, ONE[:, 0], rtol=1e-15)
    assert [note.code for note in log.notes] == ["W154"]
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"time": pa.array(now.astype("M8[ns]"), pa.timestamp("ns", "UTC"))}
    columns |= {"q": ONE[:, 1], "dq": ONE[:, 2], "u": ONE[:, 3]}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    (log,) = read(tmp_path / "a.parquet", ("q", "dq", "u"))
    assert_same(log, ONE)


def test_arrays_by_columns_and_of_other_byte_orders(tmp_path: Path) -> None:
    path, names = tmp_path / "a.npz", ("q[0]", "q[1]", "u")
    state = np.asfortranarray(ONE[:, 1:3])
    assert state.flags.f_contiguous
    np.savez(path, time=ONE[:, 0].astype(">f8"), q=state, u=ONE[:, 3])
    (log,) = read(path, names)
    assert_same(log, ONE)


def test_names_with_dots_are_whole_names(tmp_path: Path) -> None:
    """Asked for "arm.u", pyarrow brings the record "arm" along, and first."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = {"arm": pa.array([{"u": 0.0}] * 400), "time": ONE[:, 0]}
    columns |= {"arm.q": pa.array(ONE[:, 1:3].tolist()), "arm.u": ONE[:, 3]}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    (log,) = read(tmp_path / "a.parquet", ("arm.q[0]", "arm.q[1]", "arm.u"))
    assert_same(log, ONE)


def test_episode_ids_in_a_column(tmp_path: Path) -> None:
    both = np.concatenate([ONE, TWO])
    ids = np.repeat([7, 3], [400, 300])
    arrays = {"time": both[:, 0], "q": both[:, 1:3], "u": both[:, 3]}
    names, path = ("q[0]", "q[1]", "u"), tmp_path / "a.npz"
    np.savez(path, run=ids, **arrays)
    one, two = read(path, names, episode="run")
    assert_same(one, ONE)
    assert_same(two, TWO)
    assert (one.name, two.name) == ("a[7]", "a[3]")
    np.savez(path, run=np.roll(ids, 5), **arrays)
    with pytest.raises(InputError, match=r"E127 episodes interleaved.*row 405"):
        read(path, names, episode="run")
    np.savez(path, run=np.where(np.arange(700) == 5, np.nan, ids), **arrays)
    with pytest.raises(InputError, match=r"E127 episode id missing.*row 5:"):
        read(path, names, episode="run")


def test_datasets_side_by_side_are_no_episodes(tmp_path: Path) -> None:
    """Two arms in groups of one kind: a path from the root names one of them."""
    import h5py

    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for arm, table in (("run_1", ONE), ("run_2", TWO[:300])):
            for i, name in enumerate(("t", "q", "dq", "u")):
                file[f"{arm}/{name}"] = table[:, i]
                file[f"raw/{arm}/{name}"] = 2 * table[:, i]
    names = ("run_2/q", "run_2/dq", "run_2/u")
    (log,) = read(tmp_path / "a.hdf5", names, time="run_2/t")
    assert_same(log, TWO)


def test_lerobot_stamps_that_are_not_even_are_used(tmp_path: Path) -> None:
    late = ONE.copy()
    late[200:, 0] += 0.003
    rec.write_lerobot(tmp_path / "ds", [late], "v3.0")
    (log,) = read(tmp_path / "ds", LEROBOT)
    np.testing.assert_array_equal(log.time, late[:, 0].astype(np.float32))
    assert "W154" in [note.code for note in log.notes]
    (log,) = read(tmp_path / "ds", LEROBOT, time="timestamp")
    np.testing.assert_array_equal(log.time, late[:, 0].astype(np.float32))
    with pytest.raises(InputError, match=r"E106 .*slope 0\.5"):
        read(tmp_path / "ds", LEROBOT, period=0.02)


PROJECT = """system = "furuta"
[parameters]
{fixed}
[[logs]]
files = ["{files}"]
{more}
[logs.columns]
theta = "{0}"
alpha = "{1}"
voltage = "{2}"
"""


def project_logs(
    folder: Path, files: str, names: tuple[str, ...], more: str = ""
) -> tuple[Any, tuple[Log, ...]]:
    from sim2gp.systems import Furuta

    nominal = Furuta().parameters.nominal()
    fixed = "\n".join(f"{n} = {v}" for n, v in nominal.items() if n not in FREE)
    path = folder / "machine.toml"
    path.write_text(PROJECT.format(*names, fixed=fixed, files=files, more=more))
    project = load_project(path)
    return project.build_system(), project.load_logs()


def test_a_project_learns_the_same_from_any_format(tmp_path: Path) -> None:
    """Of the shapes of test_identify.py: one compiled fit serves both."""
    for seed in (1, 2):
        log = simulated(seconds=1.3, seed=seed, noise=5e-4)
        now = 2_000_000 * np.arange(len(log))
        columns = (log.channels["theta"], log.channels["alpha"], log.inputs["voltage"])
        table = np.stack([now / 1e9, *columns], axis=1)
        rec.write_csv(tmp_path / f"log{seed}.csv", table)
        rec.write_mcap(tmp_path / f"log{seed}.mcap", table, now)
    beliefs = []
    for files, names in (
        ("*.csv", ("q", "dq", "u")),
        ("*.mcap", ("/arm/elbow/q", "/arm/elbow/dq", "/cmd/u[0]")),
    ):
        system, logs = project_logs(tmp_path, files, names)
        windows, _ = cut(logs, system, window=0.2)
        belief = fit_windows(system, windows, key=jax.random.key(0))
        beliefs.append([np.asarray(leaf) for leaf in jax.tree.leaves(belief)])
    for one, other in zip(*beliefs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_folders_and_periods_in_a_project(folder: Path, tmp_path: Path) -> None:
    names = ("observations/joint[0]", "observations/joint[1]", "actions[0]")
    place = f"{folder.as_posix()}/swing/test-*"
    _, logs = project_logs(tmp_path, place, names, "period = 0.02")
    assert [len(log) for log in logs] == [400, 300]
    assert logs[0].period == pytest.approx(0.02)
    for more, words in (
        ('time = "t"\nperiod = 0.02', "time and period"),
        ('resample = {period = 0.1, stamps = "/arm"}', "resample.period and"),
        ("resample = {perod = 0.1}", "did you mean period"),
        ('resample = {method = "cubic"}', "'linear' or 'hold'"),
    ):
        with pytest.raises(InputError, match=f"E160.*line .*{words}|E160.*{words}"):
            project_logs(tmp_path, place, names, more)


def test_lance_and_partial_downloads_are_told(tmp_path: Path) -> None:
    rec.write_lerobot(tmp_path / "ds", [ONE, TWO], "v2.1")
    (tmp_path / "ds/data/chunk-000/episode_000000.parquet").unlink()
    (log,) = read(tmp_path / "ds", LEROBOT)
    assert_same(log, TWO)
    assert [note.code for note in log.notes] == ["W127"]
    place = tmp_path / "ds" / "meta" / "info.json"
    info = json.loads(place.read_text())
    place.write_text(json.dumps(info | {"storage_format": "lance"}))
    with pytest.raises(InputError, match=r"E136 .*info\.json.*lance.*Fix:"):
        read(tmp_path / "ds", LEROBOT)


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
