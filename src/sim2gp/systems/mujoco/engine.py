"""C MuJoCo as a simulator on the host: batches of rows, in several threads.

A row's parameters are set in a copy of the model. What MuJoCo derives from masses and
lengths when it compiles a model is derived again for each of their values. Inputs may
have a force on each joint behind them, in N or N m: they are held alike.
"""

import copy
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameters
from sim2gp.systems.base import steps_in
from sim2gp.systems.mujoco.constants import CENTRED, DERIVED, Constant, set_constants
from sim2gp.systems.mujoco.slopes.numbers import moved_by, numbers_of, tree_of
from sim2gp.systems.mujoco.slopes.step import Model, acceleration_slopes, in_closed_form
from sim2gp.systems.plants.external import (
    AbstractSimulator,
    Differences,
    untouched,
)

#: Fewer steps than these are not worth waking other threads for.
FEW = 256
#: Copies of the model at a time: one of a humanoid with its meshes has 70 MiB.
COPIES = 16
#: Linearised models that are kept: variants of one fit, at a few lengths of steps.
KEPT = 32


class Engine(AbstractSimulator):
    """C MuJoCo with some parameters of a model open; the model does not change."""

    def __init__(
        self, model: Any, constants: Sequence[Sequence[Constant]], table: Parameters
    ) -> None:
        import mujoco
        from mujoco import rollout

        _check_centres(model, constants)
        self.model = model
        self.constants = tuple(tuple(group) for group in constants)
        self.names = tuple(group[0].path for group in self.constants)
        self.differences = Differences.of(table, self.names)
        self._derive = any(c.quantity in DERIVED for g in self.constants for c in g)
        self._copies: list[Any] = []
        self._held: list[bytes] = []
        threads = _cores()
        self._datas = [mujoco.MjData(model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._alone = rollout.Rollout(nthread=0)
        self._lock = threading.Lock()  # JAX may call from several programs at once
        self._tree = tree_of(model) if in_closed_form(model) else None
        self._known: dict[tuple[bytes, float], Model] = {}

    def with_values(self, theta: Float[np.ndarray, " p"]) -> Any:
        """A copy of the model in which the open parameters have these values."""
        import mujoco

        model = copy.copy(self.model)
        self._set(model, theta, mujoco.MjData(model))
        return model

    def _set(self, model: Any, theta: Float[np.ndarray, " p"], data: Any) -> None:
        """All open parameters, and what MuJoCo derives of them; ``data`` is scratch."""
        import mujoco

        both = zip(self.constants, theta, strict=True)
        set_constants(model, ((c, float(v)) for group, v in both for c in group))
        if self._derive:
            mujoco.mj_setConst(model, data)

    def flow(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> Float[np.ndarray, "B n"]:
        h = np.round(h, 12)  # rows that are equally long differ by rounding
        out, good = untouched(theta, s, a, h)
        index = np.flatnonzero(good & (h > 0.0))
        with self._lock:
            for rows, models, which in self._blocks(theta[index]):
                here = index[rows]
                for span in np.unique(h[here]):
                    mine = h[here] == span
                    at, chosen = here[mine], [models[k] for k in which[mine]]
                    out[at] = self._rolled(chosen, models, s[at], a[at], float(span))
        return out

    def substeps(self, span: Float[np.ndarray, "*r"]) -> Int[np.ndarray, "*r"]:
        return steps_in(np.round(span, 12), float(self.model.opt.timestep))

    def rollout(
        self,
        theta: Float[np.ndarray, "W p"],
        x0: Float[np.ndarray, "W n"],
        u: Float[np.ndarray, "W L m"],
        span: Float[np.ndarray, "W L"],
    ) -> Float[np.ndarray, "W L n"]:
        moving, length = span > 0.0, np.round(span.max(axis=1, initial=0.0), 12)
        even = np.abs(span - length[:, None]) <= 1e-12
        lengths, which = np.unique(
            np.where((even | ~moving).all(axis=1), length, -1.0), return_inverse=True
        )
        finite = all(np.isfinite(x).all() for x in (theta, x0, u))
        if lengths[-1] <= 0.0 or not finite:
            return super().rollout(theta, x0, u, span)
        if lengths.size == 1:
            return self._evenly(theta, x0, u, moving, float(lengths[0]))
        out = np.empty((*span.shape, x0.shape[1]))
        for k in range(lengths.size):  # of logs with periods of their own
            at = which.reshape(-1) == k
            out[at] = self.rollout(theta[at], x0[at], u[at], span[at])
        return out

    def _evenly(
        self,
        theta: Float[np.ndarray, "W p"],
        x0: Float[np.ndarray, "W n"],
        u: Float[np.ndarray, "W L m"],
        moving: Bool[np.ndarray, "W L"],
        length: float,
    ) -> Float[np.ndarray, "W L n"]:
        """`rollout` where rows are equally long, or not there: one call a window."""
        count = int(self.substeps(np.asarray(length)))
        order = np.argsort(~moving, axis=1, kind="stable")
        inputs = np.take_along_axis(u, order[..., None], axis=1)
        inputs = inputs[:, : moving.sum(1).max()]
        control = np.repeat(inputs, count, axis=1)
        states = np.empty((*inputs.shape[:2], x0.shape[1]))
        with self._lock:
            for at, models, which in self._blocks(theta):
                args = [models[k] for k in which], models, x0[at], control[at]
                found = self._stepped(*args, length / count)
                states[at] = found[:, count - 1 :: count]
        whole = np.concatenate([x0[:, None], states], axis=1)
        return whole[np.arange(len(u))[:, None], np.cumsum(moving, axis=1)]

    def jacobian(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
        after: Float[np.ndarray, "B n"],
    ) -> Float[np.ndarray, "B n pnm"]:
        """In closed form where the model's step has one, else by differences."""
        n, p, nv = s.shape[1], theta.shape[1], self.model.nv
        out = np.zeros((len(s), n, p + n + a.shape[1]))
        out[:, :, p : p + n] = np.eye(n)
        left = h > 0.0
        if self._tree is not None:
            known, which = _distinct(np.column_stack([theta, np.round(h, 12)]))
            for k, value in enumerate(known):
                at = np.flatnonzero((which == k) & (h > 0.0))
                if not at.size:
                    continue
                span, of = float(value[-1]), self._linearised(value[:-1], value[-1])
                args = s[at, :nv].T, s[at, nv:].T, a[at].T, after[at, nv:].T
                found = acceleration_slopes(of, *args, span)
                good = at[found.hold]
                rate = span * found.by[found.hold]
                rate[:, :, p + nv : p + n] += np.eye(nv)
                out[good, nv:] = rate
                out[good, :nv] += span * rate
                left[good] = False
        rest = np.flatnonzero(left)
        if rest.size:
            args = theta[rest], s[rest], a[rest], h[rest]
            out[rest] = super().slopes(*args)[1]
        return out

    def slopes(
        self,
        theta: Float[np.ndarray, "B p"],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        h: Float[np.ndarray, " B"],
    ) -> tuple[Float[np.ndarray, "B n"], Float[np.ndarray, "B n pnm"]]:
        return self.slopes_of_steps(theta, s, a, h)

    def _inputs(self, width: int) -> int:
        """What MuJoCo is given: its controls, and forces on the joints where asked."""
        import mujoco

        spec = int(mujoco.mjtState.mjSTATE_CTRL)
        if width > self.model.nu:
            spec |= int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        return spec

    def _linearised(self, theta: Float[np.ndarray, " p"], h: float) -> Model:
        """The numbers of the model and what the parameters change of them."""
        key = theta.tobytes(), float(h)
        with self._lock:
            if key not in self._known:
                model = copy.copy(self.model)
                model.opt.timestep = h

                def at(values: Float[np.ndarray, " p"]) -> Any:
                    self._set(model, values, self._datas[0])
                    return model

                by = self.differences
                step = by.constants * by.scale
                changes = moved_by(at, theta, step, by.low, by.high)
                tree = self._tree
                assert tree is not None
                if len(self._known) >= KEPT:
                    self._known.clear()
                found = Model(at(theta), tree, numbers_of(model), changes)
                self._known[key] = found
            return self._known[key]

    def _blocks(
        self, theta: Float[np.ndarray, "B p"]
    ) -> Iterator[tuple[Int[np.ndarray, " b"], list[Any], Int[np.ndarray, " b"]]]:
        """Rows whose models exist at the same time, those models, and whose is which.

        Call it under the lock: the next block's models are the same copies.
        """
        values, which = _distinct(theta)
        for first in range(0, len(values), COPIES):
            models = self._models(values[first : first + COPIES])
            rows = np.flatnonzero((which >= first) & (which < first + COPIES))
            yield rows, models, which[rows] - first

    def _models(self, values: Float[np.ndarray, "U p"]) -> list[Any]:
        """A model for each vector of values; copies are used again."""
        while len(self._copies) < len(values):
            self._copies.append(copy.copy(self.model))
            self._held.append(b"")
        for k, theta in enumerate(values):
            if self._held[k] == theta.tobytes():
                continue
            self._set(self._copies[k], theta, self._datas[0])
            self._held[k] = theta.tobytes()
        return self._copies[: len(values)]

    def _rolled(
        self,
        chosen: list[Any],
        models: list[Any],
        s: Float[np.ndarray, "B n"],
        a: Float[np.ndarray, "B m"],
        span: float,
    ) -> Float[np.ndarray, "B n"]:
        count = int(self.substeps(np.asarray(span)))
        control = np.broadcast_to(a[:, None], (len(a), count, a.shape[1]))
        return self._stepped(chosen, models, s, control, span / count)[:, -1]

    def _stepped(
        self,
        chosen: list[Any],
        models: list[Any],
        s: Float[np.ndarray, "B n"],
        control: Float[np.ndarray, "B K m"],
        h: float,
    ) -> Float[np.ndarray, "B K n"]:
        """States after each of ``K`` steps of ``h`` seconds."""
        for model in models:
            model.opt.timestep = h
        start = np.concatenate([np.zeros((len(s), 1)), s], axis=1)
        few = control.shape[0] * control.shape[1] < FEW
        pool = self._alone if few else self._pool
        datas = self._datas[:1] if few else self._datas
        with _quiet():
            out, _ = pool.rollout(
                chosen,
                datas,
                start,
                np.ascontiguousarray(control),
                control_spec=self._inputs(control.shape[-1]),
            )
        # Where a state runs away MuJoCo stops, or begins again.
        due = h * np.arange(1, control.shape[1] + 1)
        ahead = np.abs(out[..., 0] - due) < 1e-6 * due
        going = np.logical_and.accumulate(ahead, axis=1)
        return np.where(going[..., None], out[..., 1:], np.nan)


def _distinct(
    rows: Float[np.ndarray, "B k"],
) -> tuple[Float[np.ndarray, "U k"], Int[np.ndarray, " B"]]:
    """The different rows, and which of them each is."""
    differ = (rows != rows[:1]).any(axis=0)
    if not differ.any():  # as in most fits; sorting takes longer than to see it
        return rows[:1], np.zeros(len(rows), int)
    _, first, which = np.unique(
        rows[:, differ], axis=0, return_index=True, return_inverse=True
    )
    return rows[first], which.reshape(-1)


def _check_centres(model: Any, constants: Sequence[Sequence[Constant]]) -> None:
    """Bodies that MuJoCo has simplified keep their centre of mass (E172)."""
    for c in (c for group in constants for c in group):
        if c.quantity in CENTRED and c.kind == "body" and model.body_simple[c.index]:
            raise error("centre_of_simple_body", got="body_simple", path=c.path)


def _cores() -> int:
    """That this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _quiet() -> Iterator[None]:
    """Without warnings on the terminal and in a file: what ran away is NaN."""
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
