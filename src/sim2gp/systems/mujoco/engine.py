"""C MuJoCo as a simulator on the host: batches of rows, in several threads.

A row's constants are set in a copy of the model, and what MuJoCo derives from masses
and lengths when it compiles a model is derived anew for every value that they take.
"""

import copy
import math
import os
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float

from sim2gp.errors import InputError
from sim2gp.inference.parameters import Parameters
from sim2gp.systems.mujoco.constants import CENTRED, DERIVED, Constant, set_constants
from sim2gp.systems.plants.external import AbstractSimulator, Differences, untouched

#: Fewer steps than these are not worth waking other threads for.
FEW = 256


class Engine(AbstractSimulator):
    """C MuJoCo with some constants of a model open; the model itself stays as it is."""

    def __init__(
        self, model: Any, constants: Sequence[Sequence[Constant]], table: Parameters
    ) -> None:
        import mujoco
        from mujoco import rollout

        _check_centres(model, constants)
        self.model = model
        self.constants = tuple(tuple(group) for group in constants)
        names = [group[0].path for group in self.constants]
        self.differences = Differences.of(table, names)
        self._derive = any(c.quantity in DERIVED for g in self.constants for c in g)
        self._copies: list[Any] = []
        self._held: list[bytes] = []
        threads = _cores()
        self._datas = [mujoco.MjData(model) for _ in range(threads)]
        self._pool = rollout.Rollout(nthread=threads if threads > 1 else 0)
        self._alone = rollout.Rollout(nthread=0)
        self._lock = threading.Lock()  # JAX may call from several programs at once

    def with_values(self, theta: Float[np.ndarray, " p"]) -> Any:
        """A copy of the model in which the open constants have these values."""
        import mujoco

        model = copy.copy(self.model)
        self._set(model, theta, mujoco.MjData(model))
        return model

    def _set(self, model: Any, theta: Float[np.ndarray, " p"], data: Any) -> None:
        """All open constants, and what MuJoCo derives of them; ``data`` is scratch."""
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
        values, which = np.unique(theta[good], axis=0, return_inverse=True)
        index = np.flatnonzero(good)
        with self._lock:
            models = self._models(values)
            for span in np.unique(h[good]):
                mine = h[index] == span
                if span > 0.0:
                    at = index[mine]
                    chosen = [models[k] for k in which.reshape(-1)[mine]]
                    out[at] = self._rolled(chosen, models, s[at], a[at], float(span))
        return out

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
        count = max(1, math.ceil(span / self.model.opt.timestep - 1e-9))
        for model in models:
            model.opt.timestep = span / count
        start = np.concatenate([np.zeros((len(s), 1)), s], axis=1)
        few = len(s) * count < FEW
        pool = self._alone if few else self._pool
        datas = self._datas[:1] if few else self._datas
        control = np.broadcast_to(a[:, None], (len(a), count, a.shape[1]))
        with _quiet():
            out, _ = pool.rollout(chosen, datas, start, np.ascontiguousarray(control))
        time, state = out[:, -1, 0], out[:, -1, 1:]
        # Where a state runs away MuJoCo stops, or begins again.
        stopped = time < span * (1.0 - 1e-6)
        return np.where(stopped[:, None], np.nan, state)


def _check_centres(model: Any, constants: Sequence[Sequence[Constant]]) -> None:
    """Bodies that MuJoCo has simplified keep their centre of mass (E172)."""
    for c in (c for group in constants for c in group):
        if c.quantity in CENTRED and c.kind == "body" and model.body_simple[c.index]:
            raise InputError(
                "E172",
                f"{c.path} of a body that MuJoCo has simplified",
                got="body_simple",
                expected="a body with a general inertia",
                fix="leave it out if the body only slides, where it does not matter; "
                'else simple="false" on the body (MuJoCo 4 or newer)',
            )


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
