"""Forces that a simulator lacks, as Gaussian processes inside its equations of motion.

Along a joint or through an input, each a function of one variable ``z`` with a prior
around nothing:

    f(z) = sum_k w_k phi_k(z),        w_k ~ N(0, tau^2 magnitude^2 S_k)

On an interval these are the reduced-rank features of a squared-exponential kernel
(Solin and Sarkka 2020, Statistics and Computing 30), zero at its ends and beyond:

    phi_k(z) = sin(k pi (z + L) / 2L),
    S_k      = sqrt(2 pi) l / L exp(-1/2 (l k pi / 2L)^2)

The weights are parameters of the machine like all others, and enter it linearly. Those
of one function are one group, whose scale ``tau`` the data choose
(`sim2gp.inference.relevance`).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp import checks
from sim2gp.inference.linalg import library
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant, index_of
from sim2gp.systems.effects.base import (
    AbstractEffect,
    AbstractInputEffect,
    AbstractJointEffect,
)
from sim2gp.systems.effects.friction_laws import dead_zone
from sim2gp.systems.effects.units import force_unit, velocity_of
from sim2gp.systems.mechanism import AbstractMechanism, Inertia, Pair
from sim2gp.types import AnyArray, Scalar, State

#: Of the interval and of the kernel's length, in half-widths of where a machine moves.
REACH, LENGTH = 2.5, 1.0
COUNT = 6  # of features
SOFT = 0.05  # of a dead zone's width: how soon it ends
WIDTH_SD = 0.6  # of the logarithm of a dead zone's width

#: One value, or a batch of them in NumPy.
Points = Float[AnyArray, "*b"]


@dataclass(frozen=True)
class Sines:
    """``sin(k w (z - start))``, ``k = 1..count``, on ``span``; constant beyond it.

    With ``cosines`` those too, after the sines. ``sds`` are those of the weights of a
    function whose own sd is one. Of NumPy arrays, points may come in batches.
    """

    frequency: float
    sds: tuple[float, ...]
    start: float = 0.0
    span: float = math.inf
    cosines: bool = False

    def value(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """The function with weights ``x``."""
        xp, (angle, _) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        if not self.cosines:
            return sine * _clenshaw(x, cosine)[0]
        half = len(self.sds) // 2
        first, second = _clenshaw(x[half:], cosine)
        return sine * _clenshaw(x[:half], cosine)[0] + cosine * first - second

    def slope(self, x: Float[AnyArray, "k *b"], z: Points) -> Points:
        """Its derivative."""
        xp, (angle, rate) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        half = len(self.sds) // 2 if self.cosines else len(self.sds)
        k = np.arange(1, half + 1)
        first, second = _clenshaw((x[:half].T * k.astype(x.dtype)).T, cosine)
        slope = cosine * first - second
        if self.cosines:
            others = (x[half:].T * k.astype(x.dtype)).T
            slope = slope - sine * _clenshaw(others, cosine)[0]
        return rate * slope

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b k"]:
        """Its values for each weight alone."""
        xp, (angle, _) = library(z), self._angle(z)
        sine, cosine = xp.sin(angle), xp.cos(angle)
        half = len(self.sds) // 2 if self.cosines else len(self.sds)
        found = _multiples(xp.zeros_like(sine), sine, cosine, half)
        if self.cosines:
            found += _multiples(xp.ones_like(cosine), cosine, cosine, half)
        return xp.stack(found, axis=-1)

    def _angle(self, z: Points) -> tuple[Points, AnyArray]:
        """``w (z - start)``, and its derivative."""
        xp, end = library(z), self.start + self.span
        w = xp.asarray(self.frequency, z.dtype)
        if not math.isfinite(end):
            return w * (z - self.start), w
        inside = (z > self.start) & (z < end)
        angle = w * (xp.clip(z, self.start, end) - self.start)
        return angle, xp.where(inside, w, xp.zeros_like(w))


def _clenshaw(x: Float[AnyArray, "k *b"], cosine: Points) -> tuple[Points, Points]:
    """``b_1`` and ``b_2`` of Clenshaw's recurrence.

    ``sum x_k sin(k a) = b_1 sin(a)`` and ``sum x_k cos(k a) = b_1 cos(a) - b_2``: one
    sine and one cosine, and nothing that must be kept.
    """
    first, second = x[-1] + 0.0 * cosine, 0.0 * cosine
    for k in range(len(x) - 2, -1, -1):
        first, second = x[k] + 2.0 * cosine * first - second, first
    return first, second


def _multiples(none: Points, one: Points, cosine: Points, count: int) -> list[Points]:
    """``sin(k a)`` or ``cos(k a)`` for ``k = 1..count``, by Chebyshev's recurrence.

    From those of ``k = 0`` and ``1``: XLA takes one sine at a time, eight times as long
    as a product.
    """
    found = [none, one]
    for _ in range(count - 1):
        found.append(2.0 * cosine * found[-1] - found[-2])
    return found[1:]


def smooth(
    low: float,
    high: float,
    *,
    count: int = COUNT,
    reach: float = REACH,
    length: float = LENGTH,
) -> Sines:
    """Smooth functions where a machine moves, ``low`` to ``high``, and beyond.

    There is room on both sides: functions fall to zero where the data end, not before.
    ``reach`` and ``length`` (of the kernel) are in half-widths.
    """
    half = 0.5 * (high - low)
    L, l = reach * half, length * half
    w, top = 0.5 * math.pi / L, math.sqrt(2.0 * math.pi) * l / L
    variances = [math.exp(-0.5 * (l * k * w) ** 2) for k in range(1, count + 1)]
    sds = tuple(math.sqrt(top * v) for v in variances)
    return Sines(w, sds, 0.5 * (low + high) - L, 2.0 * L)


def periodic(count: int) -> Sines:
    """Harmonics of an angle that may turn round."""
    sds = tuple(1.0 / k for k in range(1, count + 1))
    return Sines(1.0, sds + sds, cosines=True)


def ripple(count: int) -> Sines:
    """Of an angle, up to so many waves in a turn, each as large: a motor's cogging."""
    sds = (1.0,) * count
    return Sines(1.0, sds + sds, cosines=True)


@dataclass(frozen=True)
class Sign:
    """Dry friction: against a velocity, smoothed over ``width``."""

    width: float
    sds: ClassVar[tuple[float, ...]] = (1.0,)

    def value(self, x: Float[AnyArray, "1 *b"], z: Points) -> Points:
        """The force of the level ``x``."""
        return -x[0] * library(z).tanh(z / self.width)

    def features(self, z: Float[AnyArray, "*b"]) -> Float[AnyArray, "*b 1"]:
        """The force of a level of one."""
        return -library(z).tanh(z / self.width)[..., None]

    def slope(self, x: Float[AnyArray, "1 *b"], z: Points) -> Points:
        """Its derivative."""
        return x[0] * (library(z).tanh(z / self.width) ** 2 - 1.0) / self.width


@dataclass(frozen=True)
class Gap:
    """A dead zone of an unknown width: of all bases only this has a shape to learn.

    ``width`` is the width's median; its logarithm has the sd `WIDTH_SD`.
    """

    width: float
    sds: ClassVar[tuple[float, ...]] = (1.0,)

    def value(self, x: Float[AnyArray, " 2"], z: Points) -> Points:
        """What it takes away: ``x[0]`` at the edge, where ``z`` is the width ``x[1]``.

        A true dead zone takes all of the input, ``x[0] = x[1]``.
        """
        w = x[1]
        return (dead_zone(z, w, SOFT * w) - z) * (x[0] / w)

    def features(self, z: Float[AnyArray, "*b"]) -> Float[Array, "*b 1"]:
        """What it takes away for ``x[0] = 1``, at the width's median."""
        x = jnp.asarray([1.0, self.width])
        return jnp.asarray(self.value(x, jnp.asarray(z)))[..., None]


Basis = Sines | Sign | Gap
#: Functions, the states that they are of, and those that they push.
Places = tuple[tuple[Basis, int, int], ...]


class AbstractUnknownFunction(AbstractEffect):
    """A function of one variable with a basis; its weights are one group.

    ``magnitude`` is its prior sd, in its own unit.
    """

    basis: AbstractVar[Basis]
    weights: AbstractVar[tuple[float, ...]]

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
            about = names[-1], unit, "width of the dead zone", "log", 0.0, math.inf
            mean, sd = math.log(self.basis.width), WIDTH_SD
            width = Parameter(*about, mean, sd, group=self.name, shape=True)
            found.append(width)
        return tuple(found)


class MissingForce(AbstractUnknownFunction):
    """A force along one joint, by its position or by its velocity."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    basis: Sines | Sign = eqx.field(static=True)
    of_velocity: bool = eqx.field(static=True, default=False)
    what: str = eqx.field(static=True, default="position_force")
    weights: tuple[float, ...] = eqx.field(static=True, default=())
    meaning: ClassVar[str] = "force that is missing"
    max_substep: ClassVar[float] = math.inf

    def unit(self, plant: AbstractPlant) -> str:
        return force_unit(plant, self.where)


class MissingInput(AbstractInputEffect, AbstractUnknownFunction):
    """What is added to an input before it arrives, as a function of it."""

    where: str = eqx.field(static=True)
    magnitude: float = eqx.field(static=True)
    basis: Basis = eqx.field(static=True)
    what: str = eqx.field(static=True, default="input_force")
    weights: tuple[float, ...] = eqx.field(static=True, default=())
    meaning: ClassVar[str] = "input that is missing"
    max_substep: ClassVar[float] = math.inf

    def through(self, x: Float[AnyArray, " k"], u: Scalar) -> Scalar:
        return u + self.basis.value(x, u)


class ForceField(eqx.Module):
    """All missing forces of a machine at once, for the weights of all.

    It acts on a machine as `AbstractJointForce` does, on all of its joints.
    """

    forces: tuple[MissingForce, ...] = eqx.field(static=True)

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
        own = dict(zip(self.forces, _split(self.forces, x), strict=True))
        found = {}
        for name in dict.fromkeys(f.where for f in self.forces):
            mine = tuple(f for f in self.forces if f.where == name)
            weights = jnp.concatenate([own[f] for f in mine])
            found[name] = _force(mine, weights, q[name], v[name])
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


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _force(
    forces: tuple[MissingForce, ...], x: Float[AnyArray, " k"], q: Scalar, v: Scalar
) -> Scalar:
    """The force on one joint. Its derivatives by the state and by each weight are the
    same for every parameter: they are computed once."""
    parts = zip(forces, _split(forces, x), strict=True)
    each = [f.basis.value(w, v if f.of_velocity else q) for f, w in parts]
    return sum(each[1:], each[0])


@_force.defjvp
def _force_jvp(
    forces: tuple[MissingForce, ...], primals: tuple, tangents: tuple
) -> tuple[Scalar, Scalar]:
    (x, q, v), (dx, dq, dv) = primals, tangents
    by = {False: jnp.zeros_like(q), True: jnp.zeros_like(q)}
    for f, w in zip(forces, _split(forces, x), strict=True):
        slope = f.basis.slope(w, v if f.of_velocity else q)
        by[f.of_velocity] = by[f.of_velocity] + slope
    each = [f.basis.features(v if f.of_velocity else q) for f in forces]
    by_x = jnp.concatenate(each)
    by_x, by_q, by_v = jax.lax.optimization_barrier((by_x, by[False], by[True]))
    return _force(forces, x, q, v), by_x @ dx + by_q * dq + by_v * dv


def _split(
    forces: tuple[MissingForce, ...], x: Float[AnyArray, " k"]
) -> list[Float[AnyArray, " _"]]:
    """The weights of each."""
    return jnp.split(x, np.cumsum([len(f.basis.sds) for f in forces])[:-1])


#: What acts on joints: one effect, or all missing forces.
Forcing = AbstractJointEffect | ForceField
