"""Any MuJoCo model as a system: C MuJoCo steps it, constants are found by path.

The state is ``(qpos, qvel, act)`` of hinges and slides; a substep is MuJoCo's own, no
longer than the model's time step. Derivatives are central differences
(`sim2gp.systems.external`): every feature of MuJoCo can be used, nothing is compiled.
What MuJoCo derives from masses and lengths when it compiles a model is derived anew for
every value that they take.
"""

import copy
import math
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.errors import InputError
from sim2gp.parameters import Parameter, Parameters
from sim2gp.systems.actuator import LONGEST_MEAN
from sim2gp.systems.base import AbstractPlant, Channel
from sim2gp.systems.external import AbstractSimulator, flow
from sim2gp.systems.mjcf import (
    DERIVED,
    SIGNED,
    Constant,
    constants_of,
    matching,
    name_of,
    set_constants,
)
from sim2gp.systems.mjcf_file import ModelFile
from sim2gp.systems.mjcf_load import compiled
from sim2gp.types import Action, Scalar, State

#: Without a stated prior a constant is within this factor of the model's number.
FACTOR = 3.0
#: Fewer steps than these are not worth waking other threads for.
FEW = 256


class Engine(AbstractSimulator):
    """C MuJoCo with some constants of a model open; the model itself stays as it is."""

    def __init__(
        self, model: Any, constants: Sequence[Sequence[Constant]], table: Parameters
    ) -> None:
        import mujoco
        from mujoco import rollout

        self.model = model
        self.constants = tuple(tuple(group) for group in constants)
        free = {p.name: p for p in table.free}
        given = [free.get(group[0].path) for group in self.constants]
        self.low = np.asarray([p.low if p else -np.inf for p in given])
        self.high = np.asarray([p.high if p else np.inf for p in given])
        self.scale = np.asarray([_spread(p) if p else 1.0 for p in given])
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
        out = s.copy()
        good = np.isfinite(np.concatenate([theta, s, a, h[:, None]], axis=1)).all(1)
        out[~good] = np.nan
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


def _spread(p: Parameter) -> float:
    """Half the distance between the prior's quantiles of an sd, in physical units."""
    return 0.5 * abs(p.constrain(p.mean + p.sd) - p.constrain(p.mean - p.sd))


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


class MuJoCo(AbstractPlant):
    """A MuJoCo model whose constants are named by path (`sim2gp.systems.mjcf`).

    Its joints are the states, ``<joint>`` and ``<joint>.velocity``, then activations of
    actuators; its actuators are the inputs. ``constants`` are paths or patterns, all
    with a non-zero value in the model where it is None. Those in one inner sequence are
    tied: one number, under the first one's name. Priors are within a factor of 3 of the
    model's number; ``priors`` replaces them by name, or fixes the constant. ``root`` is
    the folder that the model's files must lie in, its own if None; ``source`` the file
    that a compiled model was made of.

    Raises `InputError` E130, E170 and E171 for a file that is no model, E170 for what
    the model does not have, E142 for a constant that is zero in the model and has no
    prior, E172 for joints with quaternions.
    """

    engine: Engine = eqx.field(static=True)
    parameters: Parameters = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    inputs: tuple[Channel, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    source: Path | None = eqx.field(static=True)

    def __init__(
        self,
        model: Any,
        constants: Sequence[str | Sequence[str]] | None = None,
        priors: Mapping[str, Parameter | float] | None = None,
        *,
        root: Path | None = None,
        source: Path | None = None,
    ) -> None:
        named = isinstance(model, str | os.PathLike)
        self.source = Path(model) if named else source
        model = loaded(model, root)
        known = constants_of(model)
        groups = _groups(model, known, constants)
        priors = dict(priors or {})
        table = Parameters(tuple(_prior(g[0], model, priors) for g in groups))
        self.parameters = table.replace(**priors)
        self.names = tuple(group[0].path for group in groups)
        self.channels = _states(model)
        self.inputs = _inputs(model)
        self.engine = Engine(model, groups, self.parameters)

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.channels

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.inputs

    def by_path(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values by name as those of every constant: what is tied has the same."""
        groups = zip(self.names, self.engine.constants, strict=True)
        known = ((values[n], group) for n, group in groups if n in values)
        return {c.path: float(value) for value, group in known for c in group}

    def file(self, *, mjcf: bool = False) -> ModelFile:
        """The model's file, to be written with other constants (``mjcf``: as MJCF).

        Raises `InputError` E170 where there is no file.
        """
        if self.source is None:
            fix = "give the path of its file instead of a compiled model"
            raise InputError("E170", "a model without a file", fix=fix)
        return ModelFile(self.source, self.engine.model, mjcf=mjcf)

    @property
    def max_substep(self) -> float:
        return math.inf  # the engine divides by its own time step

    @property
    def window_substep(self) -> float:
        return LONGEST_MEAN  # of a delayed input, which is averaged between rows

    def record(self, values: Mapping[str, Scalar]) -> Float[Array, " p"]:
        """Values in the order of the engine's constants."""
        return jnp.stack([jnp.asarray(values[name]) for name in self.names])

    def flow(
        self, params: Float[Array, " p"], s: State, a: Action, h: float | Scalar
    ) -> State:
        theta = params.astype(s.dtype)
        span = jnp.asarray(h, s.dtype)
        return flow(self.engine, theta, s, a.astype(s.dtype), span)


def loaded(model: Any, root: Path | None = None) -> Any:
    """A compiled model, of a file or of one that is compiled already.

    Raises `InputError` E135 where MuJoCo is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise InputError(
            "E135",
            "a MuJoCo model cannot be read",
            got=str(error),
            expected="mujoco",
            fix="pip install 'sim2gp[mujoco]'",
        ) from error

    if isinstance(model, mujoco.MjModel):
        found = copy.copy(model)
    else:
        found = compiled(Path(model), root)
    for j in range(found.njnt):
        if found.jnt_type[j] not in (2, 3):
            raise InputError(
                "E172",
                "joint with a quaternion",
                got=name_of(found, "joint", j),
                expected="hinges and slides",
                fix="fix the base, or replace a free joint by slides and hinges",
            )
    return found


def _groups(
    model: Any,
    known: dict[str, Constant],
    constants: Sequence[str | Sequence[str]] | None,
) -> list[list[Constant]]:
    """The open constants; each inner list is one number."""
    if constants is None:
        usual = ("damping", "armature", "frictionloss", "mass", "gain", "kp", "kv")
        found = [c for c in known.values() if c.quantity in usual]
        return [[c] for c in found if c.get(model) != 0.0]
    groups: list[list[Constant]] = []
    for entry in constants:
        if isinstance(entry, str):
            groups += [[c] for c in matching(known, entry)]
        else:
            groups.append([c for path in entry for c in matching(known, path)])
    paths = [c.path for group in groups for c in group]
    for path in paths:
        if paths.count(path) > 1:
            fix = "let one path or pattern name it"
            raise InputError("E145", "a constant named twice", got=path, fix=fix)
    return groups


def default_prior(constant: Constant, model: Any) -> Parameter | None:
    """Within a factor of the model's own number; None where that is not positive."""
    value = constant.get(model)
    if value <= 0.0 or constant.quantity in SIGNED:
        return None
    about = constant.path, constant.unit, constant.meaning
    return Parameter(*about, "log_box", value / FACTOR, value * FACTOR, nominal=value)


def _prior(
    constant: Constant, model: Any, given: Mapping[str, Parameter | float]
) -> Parameter:
    """The default, or room for the one that is given."""
    default = default_prior(constant, model)
    if default is not None:
        return default
    if constant.path in given:
        return Parameter(constant.path, constant.unit, constant.meaning, "identity")
    raise InputError(
        "E142",
        f"no prior for {constant.path}",
        got=f"{constant.get(model):g} in the model",
        expected="a positive number to start from",
        fix="give its prior: mean and sd, or low and high",
    )


def _states(model: Any) -> tuple[Channel, ...]:
    positions, velocities = [], []
    for j in range(model.njnt):
        name, hinge = name_of(model, "joint", j), model.jnt_type[j] == 3
        unit, free = ("rad" if hinge else "m"), not model.jnt_limited[j]
        low, high = (-math.inf, math.inf) if free else model.jnt_range[j].tolist()
        turns = bool(hinge and free)
        positions.append(Channel(name, unit, angle=turns, low=low, high=high))
        velocities.append(Channel(f"{name}.velocity", f"{unit}/s"))
    order = np.argsort(model.jnt_qposadr)
    acts = [
        Channel(f"{name_of(model, 'actuator', i)}.activation", "1")
        for i in range(model.nu)
        if model.actuator_actnum[i]
    ]
    return (
        *(positions[j] for j in order),
        *(velocities[j] for j in order),
        *acts,
    )


def _inputs(model: Any) -> tuple[Channel, ...]:
    joints = [name_of(model, "joint", j) for j in range(model.njnt)]
    found = []
    for i in range(model.nu):
        limited = model.actuator_ctrllimited[i]
        low, high = (
            model.actuator_ctrlrange[i].tolist() if limited else (-math.inf, math.inf)
        )
        name = name_of(model, "actuator", i)
        if name in joints:
            name += ".control"  # a joint has the name already
        found.append(Channel(name, "1", low=low, high=high))
    return tuple(found)
