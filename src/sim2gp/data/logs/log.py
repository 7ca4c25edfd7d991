"""A log: one uninterrupted recording of a machine, in the system's names and units.

``channels`` has what was measured, ``inputs`` what was commanded. A sample that must
not count has False in its channel's mask; its value is then a placeholder.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from numpy.typing import ArrayLike


@runtime_checkable
class ChannelLike(Protocol):
    """What a reader must know of a state or an input of a system."""

    @property
    def name(self) -> str: ...
    @property
    def unit(self) -> str: ...
    @property
    def angle(self) -> bool: ...
    @property
    def low(self) -> float: ...
    @property
    def high(self) -> float: ...


@dataclass(frozen=True)
class Column:
    """Where a channel is in a file, and how its numbers become the channel's.

    ``value = sign * scale * number + offset``, the number first converted from
    ``unit``, the offset in the channel's unit. Numbers at or beyond ``saturation``
    (low, high: in the file's unit) are masked.
    """

    column: str
    unit: str | None = None
    sign: int = 1
    scale: float = 1.0
    offset: float = 0.0
    saturation: tuple[float, float] | None = None


@dataclass(frozen=True)
class RawLog:
    """Named columns of a recording that no machine has read yet (`Log.of`)."""

    name: str
    columns: Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Note:
    """Something worth saying about a log that is no error; ``code`` is stable."""

    code: str
    text: str

    def __str__(self) -> str:
        return f"{self.code} {self.text}"


@dataclass(frozen=True)
class Log:
    """One recording without gaps: time in s, channels and inputs by sim2gp name."""

    name: str
    source: str
    time: Float[np.ndarray, " N"]
    channels: Mapping[str, Float[np.ndarray, " N"]]
    inputs: Mapping[str, Float[np.ndarray, " N"]]
    mask: Mapping[str, Bool[np.ndarray, " N"]]
    fixed: Mapping[str, float] = field(default_factory=dict)
    group: int = 0
    notes: tuple[Note, ...] = ()

    @staticmethod
    def of(
        columns: Mapping[str, ArrayLike] | None = None,
        /,
        *,
        name: str = "log",
        **more: ArrayLike,
    ) -> RawLog:
        """Columns of NumPy or pandas, such as ``Log.of(time=t, q1=q, torque1=u)``.

        ``time`` in s; the others by the names of the machine's channels and inputs, in
        their units, or by those that a project file states. A column whose name is no
        name of Python's is given in a mapping, which a data frame is. They are checked
        where a machine reads them, as those of a file are.
        """
        given = {**(columns if columns is not None else {}), **more}
        return RawLog(name, {str(k): np.asarray(v) for k, v in given.items()})

    def __len__(self) -> int:
        return len(self.time)

    @property
    def period(self) -> float:
        """The median time between rows, s."""
        return float(np.median(np.diff(self.time)))

    @property
    def duration(self) -> float:
        """From the first row to the last, s."""
        return float(self.time[-1] - self.time[0])

    def measured(
        self, names: Sequence[str]
    ) -> tuple[Float[np.ndarray, "N n"], Bool[np.ndarray, "N n"]]:
        """The channels side by side in the given order, and which samples count.

        A channel that was not recorded is zero with a mask of False.
        """
        values = np.zeros((len(self), len(names)))
        mask = np.zeros((len(self), len(names)), dtype=bool)
        for i, name in enumerate(names):
            if name in self.channels:
                values[:, i], mask[:, i] = self.channels[name], self.mask[name]
        return values, mask

    def commanded(self, names: Sequence[str]) -> Float[np.ndarray, "N m"]:
        """The inputs side by side in the given order; each is held to the next row."""
        columns = [self.inputs[name] for name in names]
        return np.asarray(columns, float).reshape(len(names), len(self.time)).T
