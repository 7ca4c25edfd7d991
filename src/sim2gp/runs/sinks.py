"""Where numbers go while a run goes on: TensorBoard, Weights & Biases, or JSON lines.

A sink takes named numbers of one step. What is not finite is written where the format
has a word for it, and named apart from the numbers where it has not; never as a zero.
"""

import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, SupportsFloat, runtime_checkable

from sim2gp.errors import missing_extra
from sim2gp.runs.store import disk_error


@runtime_checkable
class Sink(Protocol):
    """Takes numbers as they come."""

    def scalars(self, step: int, values: Mapping[str, SupportsFloat]) -> None:
        """Numbers of one step, by name; a slash in a name makes a group."""

    def close(self) -> None:
        """Nothing more comes; all that came is on the disk."""


class JSONLines:
    """A line for each step: ``{"step": 1, "time": ..., "values": {...}}``.

    JSON has no word for NaN: such values are in ``not_finite``, as text. An earlier
    file is replaced. Raises `DiskError` E190, or `InputError` E130 for a bad path.
    """

    def __init__(self, path: Path | str) -> None:
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self.file = path.open("w", encoding="utf-8", newline="\n")
        except OSError as error:
            raise disk_error(path, error) from error

    def scalars(self, step: int, values: Mapping[str, SupportsFloat]) -> None:
        """One line, at once on its way to the disk."""
        numbers = {name: float(value) for name, value in values.items()}
        line: dict[str, Any] = {"step": step, "time": time.time()}
        line["values"] = {k: v for k, v in numbers.items() if math.isfinite(v)}
        lost = {k: str(v) for k, v in numbers.items() if not math.isfinite(v)}
        if lost:
            line["not_finite"] = lost
        self.file.write(json.dumps(line, allow_nan=False, ensure_ascii=False) + "\n")
        self.file.flush()

    def close(self) -> None:
        """Close the file."""
        self.file.close()


class TensorBoard:
    """An event file in a folder, for ``tensorboard --logdir``; NaN stays NaN.

    Raises `InputError` E135 without the extra ``tensorboard``.
    """

    def __init__(self, folder: Path | str) -> None:
        try:
            from tensorboardX.event_file_writer import EventsWriter
            from tensorboardX.proto.event_pb2 import Event
        except ImportError as error:
            what = "metrics cannot be written for TensorBoard"
            raise missing_extra(what, error, "tensorboard") from error
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
            # Not `SummaryWriter`: its thread takes events out of a queue of pickles.
            self.writer = EventsWriter(str(Path(folder) / "events"))
        except OSError as error:
            raise disk_error(Path(folder), error) from error
        self.event = Event

    def scalars(self, step: int, values: Mapping[str, SupportsFloat]) -> None:
        """A point on each curve, at once on its way to the disk."""
        event = self.event(step=step, wall_time=time.time())
        for name, value in values.items():
            event.summary.value.add(tag=name, simple_value=float(value))
        self.writer.write_event(event)
        self.writer.flush()

    def close(self) -> None:
        """Close the file."""
        self.writer.close()


class WandB:
    """A run of Weights & Biases, kept on this machine until ``wandb sync``.

    ``mode`` is W&B's own: ``online`` sends everything as it comes. Raises `InputError`
    E135 without the extra ``wandb``.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        name: str | None = None,
        config: Mapping[str, Any] | None = None,
        mode: str = "offline",
    ) -> None:
        try:
            import wandb
        except ImportError as error:
            what = "metrics cannot be written for Weights & Biases"
            raise missing_extra(what, error, "wandb") from error
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.run = wandb.init(
            project="sim2gp",
            dir=str(folder),
            name=name,
            config=dict(config or {}),
            mode=mode,
        )

    def scalars(self, step: int, values: Mapping[str, SupportsFloat]) -> None:
        """One row; steps may repeat, so that several learners can share a run."""
        self.run.log({"step": step} | {k: float(v) for k, v in values.items()})

    def close(self) -> None:
        """Finish the run."""
        self.run.finish()


class Nowhere:
    """Forgets everything."""

    def scalars(self, step: int, values: Mapping[str, SupportsFloat]) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


@contextmanager
def opened(
    kind: str | None, out: Path, config: Mapping[str, Any] | None = None
) -> Iterator[Sink]:
    """A sink next to the run directory ``out``, closed however the block ends.

    ``jsonl`` writes ``OUT.jsonl``; ``tensorboard`` a folder in ``OUT.tensorboard`` for
    each time it is run; ``wandb`` writes to ``OUT.wandb``, and sends it where the
    variable ``WANDB_MODE`` says ``online``. None is nowhere. Raises E135 and E190.
    """
    target = out.with_name(f"{out.name}.{kind}")
    sink: Sink
    if kind is None:
        sink = Nowhere()
    elif kind == "jsonl":
        sink = JSONLines(target)
    elif kind == "tensorboard":
        stamp = time.strftime("%Y%m%d-%H%M%S", time.gmtime())
        sink = TensorBoard(target / stamp)
    else:
        mode = os.environ.get("WANDB_MODE", "offline")
        sink = WandB(target, name=out.name, config=config, mode=mode)
    try:
        yield sink
    finally:
        sink.close()


def each_episode(sink: Sink, name: str = "") -> Callable[[Any], None]:
    """What `sim2gp.psrl` calls ``on_episode``: it writes each episode's numbers.

    ``return``, ``failed_plans``, and the parameters at the posterior's mean in their
    units, where the belief has any; all under ``name``.
    """

    from sim2gp.types import (
        in_float64,  # with JAX, which a policy's reader need not have
    )

    def write(episode: Any) -> None:
        trajectory, belief = episode.trajectory, episode.belief
        found = {"return": float(trajectory.reward.sum())}
        found["failed_plans"] = float(trajectory.failed.sum())
        table = getattr(getattr(belief, "system", None), "parameters", ())
        if table:
            table = table.ungrouped()
            at = in_float64(lambda: table.constrain(belief.parameters()[0]))()
            names = (f"constants/{name}" for name in table.names)
            found |= dict(zip(names, at.tolist(), strict=True))
        prefix = f"{name}/" if name else ""
        sink.scalars(episode.index, {prefix + k: v for k, v in found.items()})

    return write
