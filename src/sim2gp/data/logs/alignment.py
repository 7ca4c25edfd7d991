"""Do commands and motion belong to the same rows? (W118)

A command acts on accelerations at once, so second differences of a position over some
20 ms are regressed on what states and commands, shifted by k rows, make of them:

    q(t + h) - 2 q(t) + q(t - h) = D [ c_0 + c_1 dq + ... + b u_{i - k} ]

D integrates twice and takes the same difference, so a held command needs no derivative.
The share of what the states leave open that commands explain, R^2(k), has its peak
where they belong. A controller's commands depend on the rows before them and explain
their noise, too: a peak at k < 0 counts only where commands explain little in their own
rows.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from sim2gp.data.logs.log import ChannelLike, Log, Note

HALF_WIDTH = 0.02  # s, h
REACH = 0.1  # s that commands are shifted by, at most, in rows at least NEAREST
NEAREST = 3
ROWS = 5_000  # that are looked at: those where the commands change most
LEAST_ROWS = 100  # of a regression
LATE = 0.5, 0.8  # k > 0: least R^2, and most of what is left, relative to k = 0
EARLY = 0.85, 0.5  # k < 0: least R^2, and most of it at k = 0

Values = Float[np.ndarray, " N"]


def alignment_notes(
    log: Log, states: Sequence[ChannelLike], delay: float = 0.0
) -> list[Note]:
    """Whether commands explain the motion best if they are shifted by some rows (W118).

    ``delay`` (s) is what the model may take up.
    """
    angles = [state.name for state in states if state.angle]
    moved = {n: u for n, u in log.inputs.items() if np.ptp(u) > 0.0}
    joints = {
        n: q
        for n, q in log.channels.items()
        if not n.endswith(".velocity") and np.ptp(q) > 0.0
    }
    if not moved or not joints or len(log) < LEAST_ROWS:
        return []
    found = _Regression(log, joints, moved, angles).best()
    if found is None:
        return []
    joint, lag, there, here = found
    if lag > 0:
        taken = lag * log.period <= delay + 0.5 * log.period
        sure = there >= LATE[0] and 1.0 - there <= LATE[1] * (1.0 - here)
    else:
        taken, sure = False, there >= EARLY[0] and here <= EARLY[1]
    if taken or not sure:
        return []
    rows = f"{abs(lag)} row" + ("s" if abs(lag) > 1 else "")
    side = "ahead of" if lag > 0 else "behind"
    text = (
        f"{', '.join(moved)} in {log.source}: {rows} {side} the motion "
        f"({1e3 * abs(lag) * log.period:.3g} ms); shifted so, commands explain "
        f"{100 * there:.0f} % of what states leave open of {joint}'s acceleration, as "
        f"recorded {100 * here:.0f} %"
    )
    hint = " (a delay of the actuator would do so, too)" if lag > 0 else ""
    return [Note("W118", text + hint)]


class _Regression:
    """Second differences of positions on those of the integrals of what acts."""

    def __init__(
        self,
        log: Log,
        joints: Mapping[str, Values],
        inputs: Mapping[str, Values],
        angles: Sequence[str],
    ) -> None:
        some = _busiest_rows(np.stack(list(inputs.values()), axis=1))
        self.t = log.time[some]
        self.names = list(joints)
        self.u = [u[some] for u in inputs.values()]
        q = {n: x[some] for n, x in joints.items()}
        rate = {n: _rate(log, n, some) for n in q}
        self.h = max(1, round(HALF_WIDTH / log.period))
        reach = max(NEAREST, round(REACH / log.period))
        self.reach = min(reach, len(self.t) // 20)
        edge = self.h + self.reach
        step = max(1, self.h // 2)
        self.at: Int[np.ndarray, " n"] = np.arange(edge, len(self.t) - edge, step)
        self.turns = [f(q[n]) for n in q if n in angles for f in (np.sin, np.cos)]
        acts = [np.ones_like(self.t), *self.turns]
        for n, v in rate.items():
            acts += [v, np.tanh(10.0 * v / max(float(np.std(v)), 1e-300))]
            acts += [np.sin(q[m]) * v**2 for m in q if m in angles]
            acts += [] if n in angles else [q[n]]
        self.states = _unit_column_basis(self._columns(acts))
        self.y = self._left(np.stack([self._second(x) for x in q.values()], axis=1))

    def best(self) -> tuple[str, int, float, float] | None:
        """Joint, lag, and the share explained there and at no lag; None at an end."""
        if len(self.at) < max(LEAST_ROWS, 4 * (self.states.shape[1] + len(self.u))):
            return None
        coarse = np.unique(np.round(np.geomspace(1, self.reach, 12)).astype(int))
        known = [*(-coarse[::-1]).tolist(), 0, *coarse.tolist()]
        shares = {k: self.share(k) for k in known}
        first = max(known, key=lambda k: float(shares[k].max()))
        place = known.index(first)
        near = known[max(place - 1, 0)], known[min(place + 1, len(known) - 1)]
        shares |= {k: self.share(k) for k in range(near[0], near[1] + 1)}
        lag = max(shares, key=lambda k: (float(shares[k].max()), -abs(k)))
        if lag == 0 or abs(lag) == self.reach:
            return None
        j = int(np.argmax(shares[lag]))
        return self.names[j], lag, float(shares[lag][j]), float(shares[0][j])

    def share(self, lag: int) -> Float[np.ndarray, " joints"]:
        """R^2 of the commands, ``lag`` rows later, of what the states leave open."""
        shifted = [np.roll(u, lag) for u in self.u]  # its ends are not looked at
        acts = [u * turn for u in shifted for turn in (1.0, *self.turns)]
        explained = _unit_column_basis(self._left(self._columns(acts))).T @ self.y
        total = np.maximum(np.sum(self.y**2, axis=0), 1e-300)
        return np.asarray(np.sum(explained**2, axis=0) / total)

    def _columns(self, acts: Sequence[Values]) -> Float[np.ndarray, "n k"]:
        return np.stack([self._second(self._twice(f)) for f in acts], axis=1)

    def _twice(self, f: Values) -> Values:
        """The double integral of a held value."""
        dt = np.diff(self.t)
        once = np.concatenate([[0.0], np.cumsum(f[:-1] * dt)])
        steps = once[:-1] * dt + 0.5 * f[:-1] * dt**2
        return np.concatenate([[0.0], np.cumsum(steps)])

    def _second(self, x: Values) -> Float[np.ndarray, " n"]:
        """Slope after less slope before; a straight line has none."""
        t, at, h = self.t, self.at, self.h
        after = (x[at + h] - x[at]) / (t[at + h] - t[at])
        return after - (x[at] - x[at - h]) / (t[at] - t[at - h])

    def _left(self, x: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """What the states do not explain."""
        return x - self.states @ (self.states.T @ x)


def _unit_column_basis(columns: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n r"]:
    """An orthonormal basis of what the columns span."""
    norm = np.linalg.norm(columns, axis=0)
    unit = columns[:, norm > 0.0] / norm[norm > 0.0]
    left, sizes, _ = np.linalg.svd(unit, full_matrices=False)
    return np.asarray(left[:, sizes > 1e-9])


def _rate(log: Log, name: str, some: slice) -> Values:
    measured = log.channels.get(f"{name}.velocity")
    if measured is None:
        measured = np.gradient(log.channels[name], log.time)
    return measured[some]


def _busiest_rows(u: Float[np.ndarray, "N m"]) -> slice:
    """The rows in which commands change most, where there are too many."""
    if len(u) <= ROWS:
        return slice(0, len(u))
    change = np.abs(np.diff(u, axis=0)) / np.maximum(np.ptp(u, axis=0), 1e-300)
    total = np.concatenate([[0.0], np.cumsum(change.sum(axis=1))])
    start = int(np.argmax(total[ROWS - 1 :] - total[: len(total) - ROWS + 1]))
    return slice(start, start + ROWS)
