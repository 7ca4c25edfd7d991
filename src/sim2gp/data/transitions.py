"""Transitions ``(s, a, s')`` at a fixed capacity, with a mask: the replay data.

Compiled fits see the capacity, not the count; it doubles when it is full, so a run of
any length compiles a fit at most logarithmically often.
"""

import logging

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sim2gp.types import AnyArray

logger = logging.getLogger(__name__)

PAST = 3  # earlier inputs that are tried: a delay shows there


class Transitions(eqx.Module):
    """Rows of ``(state, action, next_state)``; rows with a false mask do not exist.

    ``configuration`` is the machine's, an index, where it has several.
    """

    state: Float[AnyArray, "capacity n"]
    action: Float[AnyArray, "capacity m"]
    next_state: Float[AnyArray, "capacity n"]
    mask: Bool[AnyArray, " capacity"]
    configuration: Int[AnyArray, " capacity"] | None = None

    @classmethod
    def empty(cls, capacity: int, n: int, m: int) -> "Transitions":
        """No data yet; room for ``capacity`` transitions."""
        state = np.zeros((max(capacity, 1), n))
        action = np.zeros((max(capacity, 1), m))
        return cls(state, action, state, np.zeros(max(capacity, 1), bool))

    @classmethod
    def of(
        cls,
        state: Float[AnyArray, "N n"],
        action: Float[AnyArray, "N m"],
        next_state: Float[AnyArray, "N n"],
        configuration: Int[AnyArray, " N"] | None = None,
    ) -> "Transitions":
        """Exactly these transitions, at a capacity of their number."""
        n, m = np.shape(state)[1], np.shape(action)[1]
        empty = cls.empty(len(state), n, m)
        return empty.extend(state, action, next_state, configuration)

    @property
    def count(self) -> int:
        """Number of transitions held (host-side)."""
        return int(np.sum(np.asarray(self.mask)))

    @property
    def held(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``(s, a, s')`` of the transitions held (host-side)."""
        N = self.count
        s, a, s2 = map(np.asarray, (self.state, self.action, self.next_state))
        return s[:N], a[:N], s2[:N]

    def extend(
        self,
        state: Float[AnyArray, "N n"],
        action: Float[AnyArray, "N m"],
        next_state: Float[AnyArray, "N n"],
        configuration: Int[AnyArray, " N"] | None = None,
    ) -> "Transitions":
        """These transitions and more; the capacity doubles as often as needed.

        Where only some rows have a configuration, the others are of the first.
        """
        count, new = self.count, len(state)
        capacity = len(self.mask)
        while capacity < count + new:
            capacity *= 2
        if capacity != len(self.mask):
            logger.info("transitions: capacity %d -> %d", len(self.mask), capacity)

        def put(old: AnyArray, add: AnyArray) -> np.ndarray:
            out = np.zeros((capacity, *np.shape(old)[1:]), np.float64)
            out[:count] = np.asarray(old)[:count]
            out[count : count + new] = np.asarray(add)
            return out

        which = None
        if configuration is not None or self.configuration is not None:
            which = np.zeros(capacity, np.int32)
            if self.configuration is not None:
                which[:count] = np.asarray(self.configuration)[:count]
            if configuration is not None:
                which[count : count + new] = np.asarray(configuration)
        return Transitions(
            put(self.state, state),
            put(self.action, action),
            put(self.next_state, next_state),
            np.arange(capacity) < count + new,
            which,
        )

    def delta(self) -> Float[Array, "capacity n"]:
        """The regression target ``y = s' - s``."""
        return jnp.asarray(self.next_state) - jnp.asarray(self.state)


def earlier_inputs(
    a: Float[np.ndarray, "N m"], episode: Int[np.ndarray, " N"]
) -> Float[np.ndarray, "N l"]:
    """The `PAST` inputs before each row; before an episode, its first one."""
    first = np.searchsorted(episode, episode)
    rows = [np.maximum(np.arange(len(a)) - k, first) for k in range(1, PAST + 1)]
    return np.concatenate([a[row] for row in rows], axis=1)


def episode_numbers(
    start: Float[np.ndarray, "N n"], end: Float[np.ndarray, "N n"]
) -> Int[np.ndarray, " N"]:
    """An episode goes on where a row starts in the state in which the last ended."""
    breaks = np.any(start[1:] != end[:-1], axis=1)
    return np.concatenate([np.zeros(min(len(start), 1), int), np.cumsum(breaks)])


def with_history(
    S: Float[np.ndarray, "times n"], A: Float[np.ndarray, "T m"], history: int
) -> tuple[
    Float[np.ndarray, "T k"], Float[np.ndarray, "T m"], Float[np.ndarray, "T k"]
]:
    """``(s, a, s')`` of one episode's T + 1 states and T actions.

    States carry ``history`` past actions, newest first, zero before the episode:
    k = n + history m columns.
    """
    T, m = A.shape
    # Row history + t of `done` is the action of step t.
    done = np.concatenate([np.zeros((history, m), A.dtype), A])
    past = [done[history - k : history - k + T + 1] for k in range(1, history + 1)]
    full = np.concatenate([S, *past], axis=1)
    return full[:-1], A, full[1:]
