"""Any MuJoCo model as a system: C MuJoCo steps it, parameters are found by path.

The state is ``(qpos, qvel, act)`` of hinges and slides; a substep is MuJoCo's own, no
longer than the model's time step. Derivatives are central differences
(`sim2gp.systems.plants.external`): every feature of MuJoCo can be used, nothing is
compiled. What MuJoCo derives from masses and lengths when it compiles a model is
derived again for each of their values.
"""

import copy
import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter, Parameters
from sim2gp.systems.applied_forces import WithForces
from sim2gp.systems.base import Channel
from sim2gp.systems.effects.forces import ForceField
from sim2gp.systems.mechanism import AbstractForcedPlant, Acting
from sim2gp.systems.mujoco.constants import (
    OF_INERTIA,
    SIGNED,
    Constant,
    constants_of,
    matching,
    name_of,
    tied,
)
from sim2gp.systems.mujoco.engine import Engine
from sim2gp.systems.mujoco.load import compiled
from sim2gp.systems.mujoco.mjx import MJXEngine, MJXWithForces, mjx_flow
from sim2gp.systems.mujoco.model_file import ModelFile
from sim2gp.systems.mujoco.unsupported import check_supported
from sim2gp.systems.plants.external import flow
from sim2gp.types import Action, Scalar, State

#: Without a stated prior a parameter is within this factor of the model's number.
FACTOR = 3.0
#: Sd of the ten numbers of an inertia; of its shifts, in radii of gyration.
SHARE = 0.2


class MuJoCo(AbstractForcedPlant):
    """A MuJoCo model whose parameters are named by path
    (`sim2gp.systems.mujoco.constants`).

    Its joints are the states, ``<joint>`` and ``<joint>.velocity``, then activations of
    actuators; its actuators are the inputs. ``constants`` are paths or patterns; where
    it is None, dampings, armatures, dry frictions and masses that are not zero in the
    model. Those in one inner sequence are tied: one number for each quantity, under the
    first one's name. Priors are within a factor of 3 of the model's number; ``priors``
    replaces them by name, or fixes the parameter. ``root`` is the folder that the
    model's files must lie in, its own if None; ``source`` the file that a compiled
    model was made of.

    Raises `InputError` E130, E170 and E171 for a file that is no model, E170 for what
    the model does not have, E142 for a parameter that is zero in the model and has no
    prior, E172 for what is not supported (`sim2gp.systems.mujoco.unsupported`).
    """

    engine: Engine = eqx.field(static=True)
    mjx: MJXEngine | None = eqx.field(static=True)
    parameters: Parameters = eqx.field(static=True)
    channels: tuple[Channel, ...] = eqx.field(static=True)
    inputs: tuple[Channel, ...] = eqx.field(static=True)
    source: Path | None = eqx.field(static=True)

    def __init__(
        self,
        model: Any,
        constants: Sequence[str | Sequence[str]] | None = None,
        priors: Mapping[str, Parameter | float] | None = None,
        *,
        root: Path | None = None,
        source: Path | None = None,
        engine: Literal["c", "mjx"] = "c",
    ) -> None:
        named = isinstance(model, str | os.PathLike)
        self.source = Path(model) if named else source
        model = loaded(model, root)
        known = constants_of(model)
        groups = _groups(model, known, constants)
        priors = dict(priors or {})
        table = Parameters(tuple(_prior(g[0], model, priors) for g in groups))
        self.parameters = table.replace(**_described(table, priors))
        self.channels = _states(model)
        self.inputs = _inputs(model)
        self.engine = Engine(model, groups, self.parameters)
        self.mjx = MJXEngine(model, groups) if engine == "mjx" else None

    def check_functions(self) -> None:
        """The engine is no function of the user's."""

    @property
    def states(self) -> tuple[Channel, ...]:
        return self.channels

    @property
    def actions(self) -> tuple[Channel, ...]:
        return self.inputs

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the engine's parameters, in their order."""
        return self.engine.names

    @property
    def drives(self) -> dict[str, str]:
        """The joint that each input acts on, by names, for inputs that act on one."""
        model, found = self.engine.model, {}
        for i, channel in enumerate(self.inputs):
            j = driven_joint(model, i)
            if j is not None:
                found[channel.name] = name_of(model, "joint", j)
        return found

    @property
    def servos(self) -> tuple[str, ...]:
        """The inputs that are positions of joints, which a servo drives to."""
        model = self.engine.model
        return tuple(c.name for i, c in enumerate(self.inputs) if is_servo(model, i))

    def by_path(self, values: Mapping[str, float]) -> dict[str, float]:
        """Values of all parameters by path, from those by name; tied ones are equal."""
        groups = zip(self.names, self.engine.constants, strict=True)
        known = ((values[n], group) for n, group in groups if n in values)
        return {c.path: c.sign * float(value) for value, group in known for c in group}

    def file(self, *, mjcf: bool = False) -> ModelFile:
        """The model's file, to be written with other parameters (``mjcf``: as MJCF).

        Raises `InputError` E170 where there is no file.
        """
        if self.source is None:
            raise error("model_without_file")
        return ModelFile(self.source, self.engine.model, mjcf=mjcf)

    @property
    def max_substep(self) -> float:
        return math.inf  # the engine divides by its own time step

    @property
    def window_substep(self) -> float:
        # A delayed input is averaged over no more than one step of the model.
        return self.own_step

    @property
    def own_step(self) -> float:
        return float(self.engine.model.opt.timestep)

    def record(self, values: Mapping[str, Scalar]) -> Float[Array, " p"]:
        """Values in the order of the engine's parameters."""
        return jnp.stack([jnp.asarray(values[name]) for name in self.names])

    @property
    def joint_inertias(self) -> Float[np.ndarray, " j"]:
        return np.asarray(1.0 / self.engine.model.dof_invweight0)

    def flow(
        self, params: Float[Array, " p"], s: State, a: Action, h: float | Scalar
    ) -> State:
        args = params.astype(s.dtype), s, a.astype(s.dtype), jnp.asarray(h, s.dtype)
        if self.mjx is not None:
            return mjx_flow(self.mjx, *args)
        return flow(self.engine, *args)

    def flow_forced(
        self,
        params: Float[Array, " p"],
        forces: Acting,
        s: State,
        a: Action,
        h: float | Scalar,
    ) -> State:
        field, x = forces
        assert isinstance(field, ForceField)  # `is_applied`
        theta = jnp.concatenate([params, x]).astype(s.dtype)
        args = theta, s, a.astype(s.dtype), jnp.asarray(h, s.dtype)
        if self.mjx is not None:
            return mjx_flow(MJXWithForces(self.mjx, self, field), *args)
        return flow(WithForces(self.engine, self.states, field), *args)


def loaded(model: Any, root: Path | None = None) -> Any:
    """A compiled model, of a file or of one that is compiled already.

    Raises `InputError` as `compiled` does, E170 where a number is not finite, E172 for
    what is not supported (`sim2gp.systems.mujoco.unsupported`).
    """
    is_file = isinstance(model, str | os.PathLike)
    found = compiled(Path(model), root) if is_file else copy.copy(model)
    _check_finite(found)
    check_supported(found)
    return found


def _check_finite(model: Any) -> None:
    """A file's own numbers are: this is for products of them, and models from code."""
    arrays = ((n, getattr(model, n, None)) for n in dir(model) if n[0] != "_")
    for name, value in arrays:
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            wrong = value[~np.isfinite(value)]
            if wrong.size:
                raise error("compiled_number_not_finite", got=f"{wrong[0]} in {name}")


def _groups(
    model: Any,
    known: dict[str, Constant],
    constants: Sequence[str | Sequence[str]] | None,
) -> list[list[Constant]]:
    """The open parameters; each inner list is one number for each quantity."""
    if constants is None:
        # No gain of a motor or a servo: where it is free, so is the scale of all
        # masses and forces.
        usual = ("damping", "armature", "frictionloss", "mass")
        found = [
            c
            for c in known.values()
            if c.quantity in usual and c.kind in ("joint", "body")
        ]
        return [[c] for c in found if c.get(model) != 0.0]
    groups: list[list[Constant]] = []
    for entry in constants:
        if isinstance(entry, str):
            groups += [[c] for c in matching(known, entry)]
        else:
            groups += tied([c for p in entry for c in matching(known, p)], model)
    paths = [c.path for group in groups for c in group]
    for path in paths:
        if paths.count(path) > 1:
            raise error("constant_of_two_patterns", got=path)
    own = {c.index for group in groups for c in group if c.block is not None}
    for c in (c for group in groups for c in group):
        if c.index in own and c.quantity in OF_INERTIA:
            got = f"{c.path}, and the body's inertia"
            raise error("constant_and_its_inertia", got=got)
    return groups


def default_prior(constant: Constant, model: Any) -> Parameter | None:
    """Within a factor of the model's own number; None where that is not positive.

    Of the ten numbers of an inertia, Gaussian about the model's own body.
    """
    value = constant.get(model)
    if constant.block is not None:
        size = constant.block.radius if constant.unit == "m" else 1.0
        sd = SHARE * size
        about = constant.path, constant.unit, constant.meaning
        return Parameter(*about, "identity", mean=0.0, sd=sd, nominal=0.0)
    if value <= 0.0 or constant.quantity in SIGNED:
        return None
    about = constant.path, constant.unit, constant.meaning
    return Parameter(
        *about, "log_bounded", value / FACTOR, value * FACTOR, nominal=value
    )


def _prior(
    constant: Constant, model: Any, given: Mapping[str, Parameter | float]
) -> Parameter:
    """The default, or room for the one that is given."""
    default = default_prior(constant, model)
    if default is not None:
        return default
    if constant.path in given:
        return Parameter(constant.path, constant.unit, constant.meaning, "identity")
    got = f"{constant.get(model):g} in the model"
    raise error("no_default_prior", got=got, name=constant.path)


def _described(
    table: Parameters, priors: Mapping[str, Parameter | float]
) -> dict[str, Parameter | float]:
    """The priors; one that names no unit has the parameter's, and its meaning."""
    known = {p.name: p for p in table.free}
    return {
        name: dataclasses.replace(p, unit=known[name].unit, meaning=known[name].meaning)
        if isinstance(p, Parameter) and not p.unit and name in known
        else p
        for name, p in priors.items()
    }


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
        j = driven_joint(model, i)
        servo = j is not None and is_servo(model, i) and model.actuator_gear[i, 0] == 1
        unit = ("m" if model.jnt_type[j] == 2 else "rad") if servo else "1"
        found.append(Channel(name, unit, low=low, high=high))
    return tuple(found)


def is_servo(model: Any, i: int) -> bool:
    """Whether an actuator's input is a position that it drives to: kp is its gain."""
    gain = float(model.actuator_gainprm[i, 0])
    affine = model.actuator_biastype[i] == 1
    return bool(affine and gain != 0.0 and model.actuator_biasprm[i, 1] == -gain)


def driven_joint(model: Any, i: int) -> int | None:
    """The index of the joint that an actuator acts on, if that is what it acts on."""
    on_joint = model.actuator_trntype[i] in (0, 1)  # in the joint's or parent's frame
    return int(model.actuator_trnid[i, 0]) if on_joint else None
