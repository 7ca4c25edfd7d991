"""Forces that a simulator lacks, as Gaussian processes inside its equations of motion.

Along a joint or through an input, each a function of one variable ``z`` with a prior
around nothing:

    f(z) = sum_k w_k phi_k(z),        w_k ~ N(0, tau^2 magnitude^2 S_k)

with the features of `sim2gp.systems.effects.bases`. The weights are parameters of the
machine like all others, and enter it linearly. Those of one function are one group,
whose scale ``tau`` the data choose (`sim2gp.inference.relevance`).
"""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant, index_of
from sim2gp.systems.effects.base import (
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointEffect,
)
from sim2gp.systems.effects.bases import SHAPE_SD, Basis, Gap, StateBasis
from sim2gp.systems.effects.friction_laws import COULOMB_SUBSTEP
from sim2gp.systems.effects.units import force_unit, velocity_of
from sim2gp.systems.mechanism import AbstractMechanism, Inertia, Pair
from sim2gp.types import AnyArray, Scalar, State

#: Functions, the states that they are of, and those that they push.
Places = tuple[tuple[Basis, int, int], ...]


class AbstractUnknownFunction(AbstractEffect):
    """A function of one variable with a basis; its weights are one group.

    ``magnitude`` is its prior sd, in its own unit.
    """

    basis: AbstractVar[Basis]
    weights: AbstractVar[tuple[float, ...]]

    @property
    def of(self) -> str:
        """The channel that it is a function of."""
        return self.where

    def __check_init__(self) -> None:
        size = len(self.basis.sds)
        if self.weights:
            checks.same_shape(type(self).__name__, (size,), weights=self.weights)

    @property
    def values(self) -> dict[str, float]:
        weights = self.weights or (0.0,) * len(self.basis.sds)
        found = {f"{self.name}[{k}]": w for k, w in enumerate(weights, start=1)}
        if isinstance(self.basis, Gap):
            found[f"{self.name}.width"] = self.basis.width
            found[f"{self.name}.softness"] = self.basis.softness
        return found

    def own(self, values: Mapping[str, Scalar]) -> Float[AnyArray, " k"]:
        return jnp.stack([values[name] for name in self.values])

    def priors(self, plant: AbstractPlant) -> tuple[Parameter, ...]:
        unit, names = self.unit(plant), tuple(self.values)
        what = f"weight in the {self.meaning}", "identity"
        found = [
            Parameter(name, unit, *what, sd=self.magnitude * sd, group=self.name)
            for name, sd in zip(names, self.basis.sds, strict=False)
        ]
        if isinstance(self.basis, Gap):
            gap = self.basis
            shapes = (
                (names[-2], unit, "width of the dead zone", gap.width),
                (names[-1], "1", "share of it in which it ends", gap.softness),
            )
            for name, of, means, median in shapes:
                about = name, of, means, "log", 0.0, math.inf, math.log(median)
                shape = Parameter(*about, SHAPE_SD, group=self.name, shape=True)
                found.append(shape)
        return tuple(found)


class MissingForce(AbstractUnknownFunction):
    """A force along one joint, by its position or by its velocity."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    basis: StateBasis
    of_velocity: bool = eqx.field(static=True, default=False)
    what: str = eqx.field(static=True, default="position_force")
    weights: tuple[float, ...] = eqx.field(static=True, default=())
    meaning: ClassVar[str] = "force that is missing"
    max_substep: ClassVar[float] = math.inf

    @property
    def of(self) -> str:
        return f"{self.where}.velocity" if self.of_velocity else self.where

    def unit(self, plant: AbstractPlant) -> str:
        return force_unit(plant, self.where)


class MissingFriction(MissingForce):
    """Dry friction of one joint: as steep as its substep can follow."""

    max_substep: ClassVar[float] = COULOMB_SUBSTEP


class MissingInput(AbstractInputEffect, AbstractUnknownFunction):
    """What is added to an input before it arrives, as a function of it."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    basis: Basis
    what: str = eqx.field(static=True, default="input_force")
    weights: tuple[float, ...] = eqx.field(static=True, default=())
    meaning: ClassVar[str] = "input that is missing"
    max_substep: ClassVar[float] = math.inf

    def through(self, x: Float[AnyArray, " k"], u: Scalar) -> Scalar:
        return u + _value(self.basis, x, u)


@eqx.filter_jit
def _value(basis: Basis, x: Float[Array, " k"], z: Scalar) -> Scalar:
    """Traced once for all inputs: six take 1 s, with their derivatives."""
    return basis.value(x, z)


class ForceField(eqx.Module):
    """All missing forces of a machine at once, for the weights of all.

    It acts on a machine as `AbstractJointForce` does, on all of its joints.
    """

    forces: tuple[MissingForce, ...]

    @property
    def values(self) -> dict[str, float]:
        """Its weights by name, as those of a part."""
        return {k: w for force in self.forces for k, w in force.values.items()}

    def own(self, values: Mapping[str, Scalar]) -> Float[AnyArray, " k"]:
        """What its functions take, out of all values: all weights."""
        return jnp.concatenate([force.own(values) for force in self.forces])

    def along(
        self,
        x: Float[AnyArray, " k"],
        q: Mapping[str, Scalar],
        v: Mapping[str, Scalar],
    ) -> dict[str, Scalar]:
        """The force on each joint that has one, at positions and velocities by name."""
        each = list(zip(self.forces, _split(self.forces, x), strict=True))
        found = {}
        for name in dict.fromkeys(f.where for f in self.forces):
            mine = [(f, w) for f, w in each if f.where == name]
            forces, weights = zip(*mine, strict=True)
            own = jnp.concatenate(weights)
            found[name] = _force(own, q[name], v[name], forces=forces)
        return found

    def inertia(
        self, system: AbstractMechanism, params: Any, x: AnyArray, q: Pair
    ) -> Inertia:
        """None is added."""
        none = jnp.zeros_like(q[0])
        return none, none, none

    def force(
        self, system: AbstractMechanism, params: Any, x: AnyArray, q: Pair, v: Pair
    ) -> Pair:
        """As `AbstractJointEffect.force`, for all weights."""
        return self.on_joints(system, x, q, v)

    def on_joints(
        self,
        plant: AbstractPlant,
        x: Float[AnyArray, " k"],
        q: Float[Array, " j"],
        v: Float[Array, " j"],
    ) -> Float[Array, " j"]:
        """The force on each joint of a plant, whose first states are positions."""
        names, none = [c.name for c in plant.states[: q.size]], jnp.zeros_like(q[0])
        at, moving = (dict(zip(names, y, strict=True)) for y in (q, v))
        found = self.along(x.astype(q.dtype), at, moving)
        return jnp.stack([found.get(name, none) for name in names])

    def kicked(
        self, plant: AbstractPlant, x: Float[AnyArray, " k"], s: State, t: Scalar
    ) -> State:
        """The state after ``t`` seconds of the forces alone, by the midpoint rule."""
        names = [f.where for f in self.forces]
        j = {name: velocity_of(plant, name) for name in names}
        q = {name: s[index_of(name, plant.physical_states)] for name in names}
        v = {name: s[j[name]] for name in names}
        first = self.along(x, q, v)
        middle = {name: v[name] + 0.5 * t * first[name] for name in names}
        for name, a in self.along(x, q, middle).items():
            s = s.at[j[name]].add(t * a)
        return s


@eqx.filter_custom_jvp
def _force(
    x: Float[Array, " k"], q: Scalar, v: Scalar, *, forces: tuple[MissingForce, ...]
) -> Scalar:
    """The force on one joint. Its derivatives by the state and by each weight are the
    same for every parameter: they are computed once."""
    parts = zip(forces, _split(forces, x), strict=True)
    each = [f.basis.value(w, v if f.of_velocity else q) for f, w in parts]
    return sum(each[1:], each[0])


@_force.def_jvp
def _force_jvp(
    primals: tuple, tangents: tuple, *, forces: tuple[MissingForce, ...]
) -> tuple[Scalar, Scalar]:
    (x, q, v), (dx, dq, dv) = primals, tangents  # None where nothing moves
    by = {False: jnp.zeros_like(q), True: jnp.zeros_like(q)}
    for f, w in zip(forces, _split(forces, x), strict=True):
        slope = f.basis.slope(w, v if f.of_velocity else q)
        by[f.of_velocity] = by[f.of_velocity] + slope
    each = [f.basis.features(v if f.of_velocity else q) for f in forces]
    by_x = jnp.concatenate(each)
    by_x, by_q, by_v = jax.lax.optimization_barrier((by_x, by[False], by[True]))
    change = jnp.zeros_like(q)
    if dx is not None:
        # Inference asks for all weights at once. Planning, in float32, follows one of
        # their directions, where a product of matrices would end the compiler's fusion.
        single = dx.dtype == jnp.float32
        change = jnp.sum(by_x * dx) if single else by_x @ dx
    for slope, moved in ((by_q, dq), (by_v, dv)):
        change = change if moved is None else change + slope * moved
    return _force(x, q, v, forces=forces), change


def _split(
    forces: tuple[MissingForce, ...], x: Float[AnyArray, " k"]
) -> list[Float[AnyArray, " _"]]:
    """The weights of each."""
    return jnp.split(x, np.cumsum([len(f.basis.sds) for f in forces])[:-1])


#: What acts on joints: one effect, or all missing forces.
Forcing = AbstractJointEffect | ForceField
