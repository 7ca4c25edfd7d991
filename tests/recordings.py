"""One motion as every library writes it: two episodes of a swing with its command."""

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROWS = 400
START = 1_700_000_000_123_456_789  # ns since 1970: float64 resolves 256 ns there
STEP = 10_000_000  # ns


@dataclass(frozen=True)
class Channel:
    """A state or an input of some system."""

    name: str
    unit: str
    angle: bool = False
    low: float = -math.inf
    high: float = math.inf


def stamps(rows: int = ROWS) -> np.ndarray:
    """Whole nanoseconds since the start."""
    return STEP * np.arange(rows)


def motion(phase: float = 0.0, rows: int = ROWS) -> np.ndarray:
    """Columns time, angle, rate, command; float32 holds the last three exactly."""
    t = stamps(rows) / 1e9
    q, dq = np.sin(3 * t + phase), 3 * np.cos(3 * t + phase)
    kept = np.stack([q, dq, np.sin(t**2)]).astype(np.float32).astype(np.float64)
    return np.stack([t, *kept], axis=1)


def write_csv(path: Path, table: np.ndarray) -> None:
    rows = [",".join(repr(float(v)) for v in row) for row in table]
    path.write_text("\n".join(["time,q,dq,u", *rows]) + "\n")


def write_npz(path: Path, table: np.ndarray) -> None:
    np.savez_compressed(path, time=table[:, 0], state=table[:, 1:3], u=table[:, 3])


def write_hdf5(path: Path, episodes: list[np.ndarray]) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for i, table in enumerate(episodes):
            group = file.create_group(f"data/demo_{i}")
            group["time"] = table[:, 0]
            group["obs/joint"] = table[:, 1:3].astype(np.float32)
            group["u"] = table[:, 3]


def write_parquet(path: Path, table: np.ndarray) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pairs = pa.array(table[:, 1:3].tolist(), pa.list_(pa.float32()))
    columns = {"time": table[:, 0], "state": pairs, "u": table[:, 3]}
    pq.write_table(pa.table(columns), path, row_group_size=150)


def _features() -> dict[str, Any]:
    return {
        "observation.state": {
            "dtype": "float32",
            "shape": [2],
            "names": {"motors": ["elbow.pos", "elbow.vel"]},
        },
        "action": {"dtype": "float32", "shape": [1], "names": None},
    }


def _frames(episodes: list[np.ndarray], first: int = 0) -> Any:
    import pyarrow as pa

    tables = []
    for i, table in enumerate(episodes, first):
        rows = len(table)
        state = pa.array(table[:, 1:3].tolist(), pa.list_(pa.float32(), 2))
        tables.append(
            pa.table(
                {
                    "observation.state": state,
                    "action": pa.array(table[:, 3:].tolist(), pa.list_(pa.float32())),
                    "timestamp": pa.array(table[:, 0].astype(np.float32)),
                    "frame_index": np.arange(rows),
                    "episode_index": np.full(rows, i),
                    "index": np.arange(rows),
                    "task_index": np.zeros(rows, dtype=np.int64),
                }
            )
        )
    return pa.concat_tables(tables)


def write_lerobot(folder: Path, episodes: list[np.ndarray], version: str) -> None:
    """v2.1: a file for each episode; v3.0: many in one, cut anywhere."""
    import pyarrow.parquet as pq

    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    (folder / "meta").mkdir()
    info = {
        "codebase_version": version,
        "fps": 100,
        "total_episodes": len(episodes),
        "features": _features(),
    }
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    if version == "v2.1":
        for i, table in enumerate(episodes):
            pq.write_table(_frames([table], i), data / f"episode_{i:06d}.parquet")
        return
    frames = _frames(episodes)
    pq.write_table(frames.slice(0, 250), data / "file-000.parquet")
    pq.write_table(frames.slice(250), data / "file-001.parquet")


def write_minari(root: Path, episodes: list[np.ndarray]) -> Path:
    """Minari's own storage; it looks for its root in the environment."""
    import gymnasium as gym
    import minari
    from minari.data_collector import EpisodeBuffer

    buffers = [
        EpisodeBuffer(
            id=i,
            observations={"joint": list(table[:, 1:3])},
            actions=list(table[:-1, 3:]),
            rewards=[0.0] * (len(table) - 1),
            terminations=[False] * (len(table) - 1),
            truncations=[False] * (len(table) - 1),
            infos={},
        )
        for i, table in enumerate(episodes)
    ]
    box = gym.spaces.Box(-10.0, 10.0, (2,), np.float64)
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        warnings.simplefilter("ignore")  # it asks for authors and environments
        minari.create_dataset_from_buffers(
            "swing/test-v0",
            buffer=buffers,
            observation_space=gym.spaces.Dict({"joint": box}),
            action_space=gym.spaces.Box(-10.0, 10.0, (1,), np.float64),
        )
    return root / "swing" / "test-v0"


def joint_state(types: Any, ns: int, table_row: np.ndarray, *, ros1: bool) -> Any:
    """A sensor_msgs/JointState of two joints, stamped."""
    time = types["builtin_interfaces/msg/Time"](ns // 10**9, ns % 10**9)
    header = types["std_msgs/msg/Header"]
    values = {"stamp": time, "frame_id": ""} | ({"seq": 0} if ros1 else {})
    return types["sensor_msgs/msg/JointState"](
        header=header(**values),
        name=["base", "elbow"],
        position=np.array([0.0, table_row[1]]),
        velocity=np.array([0.0, table_row[2]]),
        effort=np.array([]),
    )


def write_bag(path: Path, table: np.ndarray, kind: str, *, headed: bool = True) -> None:
    """Joint states and commands by rosbags; "ros1", "sqlite3" or "mcap"."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types = store.types
    write = store.serialize_ros1 if ros1 else store.serialize_cdr
    if ros1:
        writer: Any = Writer1(path)
    else:
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
    state, command = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
    layout = types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
    with writer:
        states = writer.add_connection("/joint_states", state, typestore=store)
        commands = writer.add_connection("/cmd", command, typestore=store)
        for row, ns in zip(table, START + stamps(len(table)), strict=True):
            said = joint_state(types, int(ns) * headed, row, ros1=ros1)
            writer.write(states, int(ns), write(said, state))
            said = types[command](layout=layout, data=row[3:])
            writer.write(commands, int(ns), write(said, command))


def write_mcap(
    path: Path,
    table: np.ndarray,
    now: np.ndarray | None = None,
    *,
    encoding: str = "json",
) -> None:
    """Messages in JSON by mcap's own writer, for Foxglove; ``now`` in ns."""
    from mcap.writer import Writer

    now = START + (stamps(len(table)) if now is None else now)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b'{"type": "object"}')
        ids = [writer.register_channel(t, encoding, schema) for t in ("/arm", "/cmd")]
        for row, ns in zip(table, now, strict=True):
            stamp = {"sec": int(ns) // 10**9, "nsec": int(ns) % 10**9}
            arm = {"timestamp": stamp, "elbow": {"q": row[1], "dq": row[2]}}
            for channel, said in zip(ids, (arm, {"u": [row[3]]}), strict=True):
                data = json.dumps(said).encode()
                writer.add_message(channel, int(ns), data, int(ns))
        writer.finish()


#: Topic -> stamps in s, contents.
Messages = dict[str, tuple[np.ndarray, Sequence[Any]]]


def write_streams(path: Path, streams: Messages, start: int = START) -> Path:
    """An MCAP file of JSON."""
    from mcap.writer import Writer

    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        for topic, (times, contents) in streams.items():
            channel = writer.register_channel(topic, "json", schema)
            for t, content in zip(times, contents, strict=True):
                ns = start + round(1e9 * float(t))
                writer.add_message(channel, ns, json.dumps(content).encode(), ns)
        writer.finish()
    return path


def numbers(name: str, values: np.ndarray) -> list[dict[str, Any]]:
    return [{name: float(v)} for v in values]
