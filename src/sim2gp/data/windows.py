"""Logs cut into padded windows: what a likelihood of real logs is evaluated on."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.inference.linearized import in_blocks
from sim2gp.systems.simulate import HeldInputs
from sim2gp.types import AnyArray

#: Rows of windows that a program works on at a time.
AT_A_TIME = 100_000
P = TypeVar("P", bound="Pieces")


class Pieces(HeldInputs):
    """Stretches of held inputs, all of one size, a row for each end of a step."""

    span: Float[AnyArray, "W L"]
    knots: Float[AnyArray, "W H"]
    area: Float[AnyArray, "W H m"]

    def held(self) -> list[HeldInputs]:
        """The inputs of each alone, as NumPy's arrays."""
        parts = map(np.asarray, (self.span, self.knots, self.area))
        return [HeldInputs(*rows) for rows in zip(*parts, strict=True)]

    def each(self, f: Callable[..., Any], *per_window: Any) -> Any:
        """``f`` of one of them (and of one row of each argument), for all.

        Of very many, some at a time (`AT_A_TIME`).
        """
        W, L = self.span.shape
        rows, size = (self._each_with_all(), *per_window), max(1, AT_A_TIME // L)
        return in_blocks(jax.vmap(f), rows, jnp.ones(W, bool), size)

    def _each_with_all(self: P) -> P:
        """With a row for each of them in every array."""
        return self


class Windows(Pieces):
    """Padded windows, a row for each end of an integration step.

    Row 0 is the start, padding rows have zero length, and a row without a sample (where
    the clock left a gap too long for one step) has a false mask. ``outputs`` are the
    indices of the measured states, ``floor`` the sensors' resolution. ``configuration``
    is the machine's, an index into its table's.
    """

    y: Float[AnyArray, "W L c"]
    mask: Bool[AnyArray, "W L c"]
    start: Float[AnyArray, "W n"]
    start_sd: Float[AnyArray, "W n"]
    floor: Float[AnyArray, " c"]
    configuration: Int[AnyArray, " W"]
    outputs: tuple[int, ...] = eqx.field(static=True)

    def __len__(self) -> int:
        return len(self.y)

    @property
    def length(self) -> int:
        """Rows of each window."""
        return int(self.span.shape[1])

    @property
    def counts(self) -> Float[np.ndarray, "W c"]:
        """Samples of each window and channel."""
        return np.asarray(np.asarray(self.mask).sum(axis=1), float)

    @property
    def most(self) -> int:
        """Measured rows of the window that has most."""
        return int(np.asarray(self.mask).any(axis=2).sum(axis=1).max())

    @property
    def seconds(self) -> Float[np.ndarray, " W"]:
        """How long each lasts."""
        return np.asarray(self.span).sum(axis=1)

    def whole(self) -> "Windows":
        """All of them."""
        return self

    def masked(self, used: Bool[np.ndarray, " W"]) -> "Windows":
        """The same, where nothing is measured in the others."""
        mask = np.asarray(self.mask) & used[:, None, None]
        found: Windows = eqx.tree_at(lambda w: w.mask, self, mask)
        return found

    def in_parts(self, size: int) -> Iterator[tuple[Int[np.ndarray, " w"], "Windows"]]:
        """So many windows at a time, and their numbers (`parts_of`)."""
        if size >= len(self):
            yield np.arange(len(self)), self
        else:
            yield from parts_of(self.some, len(self), size)

    def some(self, which: Bool[np.ndarray, " W"] | Int[np.ndarray, " w"]) -> "Windows":
        """The windows chosen by a mask or by number; the floor belongs to all."""
        bare = eqx.tree_at(lambda w: w.floor, self, None)
        if not isinstance(self.y, jax.core.Tracer):
            bare = jax.tree.map(np.asarray, bare)  # which asks for no program
        chosen: Windows = eqx.tree_at(
            lambda w: w.floor,
            jax.tree.map(lambda x: x[which], bare),
            self.floor,
            is_leaf=lambda x: x is None,
        )
        return chosen

    def _each_with_all(self) -> "Windows":
        floor = jnp.broadcast_to(self.floor, (len(self), self.floor.size))
        whole: Windows = eqx.tree_at(lambda w: w.floor, self, floor)
        return whole


def parts_of(
    some: Callable[[Int[np.ndarray, " w"]], Windows], count: int, size: int
) -> Iterator[tuple[Int[np.ndarray, " w"], Windows]]:
    """So many of ``count`` windows at a time, and their numbers: all parts as large.

    ``some`` gives windows by number. The last part is filled up with windows in which
    nothing is measured.
    """
    for begin in range(0, count, size):
        own = np.arange(begin, min(begin + size, count))
        windows = some(np.resize(own, size))
        yield own, windows.masked(np.arange(size) < len(own))


def evenly_spread(size: int, count: int) -> Int[np.ndarray, " w"]:
    """Numbers of ``size`` of ``count`` windows, from the first to the last."""
    return np.linspace(0, count - 1, min(size, count)).round().astype(int)


def at_most(count: int, group: Int[np.ndarray, " W"]) -> Int[np.ndarray, " W"]:
    """Numbers of groups; of more than ``count``, successive ones are one."""
    names, own = np.unique(group, return_inverse=True)
    return group if len(names) <= count else own * count // len(names)


def channel_motion(windows: Windows) -> Float[np.ndarray, "W c"]:
    """Mean square of how far each channel went within a window."""
    y, mask = np.asarray(windows.y), np.asarray(windows.mask)
    away = np.where(mask, (y - y[:, :1]) ** 2, 0.0)
    return np.asarray(away.sum(axis=1) / np.maximum(mask.sum(axis=1), 1))
