"""Metrics on their way: what is written is what came, and NaN is never a number."""

import json
import math
import struct
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim2gp.commands.demo import _episode_listener
from sim2gp.models import PointEstimate, Sim2GP
from sim2gp.planning.episode import Trajectory
from sim2gp.planning.loop import Episode
from sim2gp.runs.sinks import JSONLines, Sink, TensorBoard, WandB, each_episode, opened
from sim2gp.systems import CartPole

STEPS = [(1, {"a/return": 2.5, "lost": math.nan}), (2, {"a/return": -math.inf})]


def write(sink: Sink) -> None:
    for step, values in STEPS:
        sink.scalars(step, values)
    sink.close()


def test_json_lines_are_json_and_say_what_is_not_finite(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "run.jsonl"
    for _ in range(2):  # a second run begins anew
        write(JSONLines(path))

    def refused(word: str) -> Any:
        raise AssertionError(word)

    lines = path.read_text().splitlines()
    found = [json.loads(line, parse_constant=refused) for line in lines]
    assert [line["step"] for line in found] == [1, 2]
    assert [line["values"] for line in found] == [{"a/return": 2.5}, {}]
    assert [line["not_finite"] for line in found] == [
        {"lost": "nan"},
        {"a/return": "-inf"},
    ]


def test_a_line_is_on_the_disk_before_the_next(tmp_path: Path) -> None:
    sink = JSONLines(tmp_path / "a.jsonl")
    sink.scalars(1, {"x": np.float32(0.5)})
    assert json.loads((tmp_path / "a.jsonl").read_text())["values"] == {"x": 0.5}
    sink.close()


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Of an event file: records of a length, its checksum, a message, its checksum."""
    from tensorboardX.proto.event_pb2 import Event

    (path,) = folder.iterdir()
    data, found = path.read_bytes(), []
    while data:
        (size,) = struct.unpack("<Q", data[:8])
        event = Event.FromString(data[12 : 12 + size])
        found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
        data = data[16 + size :]
    return found


def test_tensorboard_gets_every_number(tmp_path: Path) -> None:
    write(TensorBoard(tmp_path))
    expected = [(step, tag, x) for step, each in STEPS for tag, x in each.items()]
    for mine, given in zip(events(tmp_path), expected, strict=True):
        assert mine[:2] == given[:2]
        np.testing.assert_equal(mine[2], given[2])


class Fake(ModuleType):
    """Weights & Biases, as far as it is used."""

    def __init__(self) -> None:
        super().__init__("wandb")
        self.calls: list[Any] = []

    def init(self, **options: Any) -> Any:
        self.calls.append(options)
        log, finish = self.calls.append, lambda: self.calls.append("finished")
        return SimpleNamespace(log=log, finish=finish)


def test_wandb_stays_offline_unless_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = Fake()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.delenv("WANDB_MODE", raising=False)
    write(WandB(tmp_path / "a"))
    assert fake.calls[0]["mode"] == "offline"
    assert fake.calls[0]["dir"] == str(tmp_path / "a")
    np.testing.assert_equal(fake.calls[1], {"step": 1} | STEPS[0][1])
    assert fake.calls[-1] == "finished"
    monkeypatch.setenv("WANDB_MODE", "online")
    with opened("wandb", tmp_path / "run", {"seed": 3}):
        pass
    made = fake.calls[-2]
    assert (made["mode"], made["name"], made["config"]) == (
        "online",
        "run",
        {"seed": 3},
    )


def test_sinks_stand_beside_the_run_and_are_closed(tmp_path: Path) -> None:
    """However the block ends, and nothing is in the run's own folder."""
    with pytest.raises(ZeroDivisionError), opened("jsonl", tmp_path / "demo") as sink:
        raise ZeroDivisionError
    assert isinstance(sink, JSONLines)
    assert sink.file.closed
    with opened("tensorboard", tmp_path / "demo") as sink:
        sink.scalars(1, {"x": 1.0})
    with opened(None, tmp_path / "demo") as sink:
        sink.scalars(1, {"x": 1.0})
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"demo.jsonl", "demo.tensorboard"}
    (folder,) = (tmp_path / "demo.tensorboard").iterdir()
    assert events(folder) == [(1, "x", 1.0)]


class Kept:
    def __init__(self) -> None:
        self.seen: list[Any] = []

    def scalars(self, step: int, values: Any) -> None:
        self.seen.append((step, values))

    def close(self) -> None:
        raise AssertionError("whoever opened it closes it")


def test_an_episode_is_told_in_units(tmp_path: Path) -> None:
    """Its return, its failures, and the constants at the posterior's mean."""
    system = CartPole()
    belief = Sim2GP(system).init(jax.random.key(0))
    reward, failed = jnp.asarray([1.0, 2.5]), jnp.asarray([True, False])
    rollout = SimpleNamespace(reward=reward, failed=failed)
    sink = Kept()
    each_episode(sink, "a")(SimpleNamespace(index=3, trajectory=rollout, belief=belief))
    each_episode(sink)(SimpleNamespace(index=4, trajectory=rollout, belief=None))
    constants = {
        f"a/constants/{p.name}": pytest.approx(p.constrain(p.mean), rel=1e-12)
        for p in system.parameters.free
    }
    assert sink.seen == [
        (3, {"a/return": 3.5, "a/failed_plans": 1.0} | constants),
        (4, {"return": 3.5, "failed_plans": 1.0}),
    ]


def test_the_demo_tells_its_bar_and_the_sink() -> None:
    sink, said = Kept(), []
    rollout = Trajectory(
        np.zeros((2, 4), "f4"),
        np.zeros((1, 1), "f4"),
        np.full(1, 3.5),
        np.ones(1, bool),
    )
    belief = PointEstimate(Sim2GP(CartPole())).init(jax.random.key(0))
    _episode_listener(said.append, sink, 7, "prior mean")(Episode(2, rollout, belief))
    assert said == ["prior mean, episode 2: return 4"]
    name = "seed 7/prior mean"
    assert sink.seen == [(2, {f"{name}/return": 3.5, f"{name}/failed_plans": 1.0})]
