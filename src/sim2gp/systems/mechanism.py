"""Machines on whose joints forces act: their own equations, or an engine's.

Those of two joints have inertia and forces, solved in closed form, with effects:

    (M + dM(q)) dv/dt = forces(q, v, a) + force(q, v),

where ``dM`` and ``force`` are those of the effects (`sim2gp.systems.effects`). An
engine is given missing forces alone, each held for one of its steps.
"""

import abc
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
from equinox import AbstractVar
from jaxtyping import Array, Float

from sim2gp.systems.base import AbstractODE, AbstractPlant, index_of, rk4
from sim2gp.systems.function_checks import check_mechanism
from sim2gp.types import Action, AnyArray, Scalar, State

if TYPE_CHECKING:
    from sim2gp.systems.effects.base import AbstractJointEffect
    from sim2gp.systems.effects.forces import ForceField

Inertia = tuple[Scalar, Scalar, Scalar]
Pair = Float[Array, " 2"]
#: An effect and its magnitude, or all missing forces and their weights.
Acting = tuple["AbstractJointEffect | ForceField", AnyArray]
Effects = Sequence[Acting]


class AbstractMechanism(AbstractODE):
    """Two joints ``q``: ``M(q) dv/dt = forces(q, v, a)``, solved in closed form.

    States are ``(q1, q2, v1, v2)``. A locked joint keeps its place: its velocity counts
    as zero for any state.
    """

    locked: AbstractVar[tuple[bool, bool]]

    def check_functions(self) -> None:
        """That inertia and forces are those of two joints."""
        check_mechanism(self)

    @abc.abstractmethod
    def inertia(self, params: Any, q: Pair) -> Inertia:
        """The three numbers ``M11, M12, M22`` of the symmetric ``M(q)``."""

    @abc.abstractmethod
    def forces(self, params: Any, q: Pair, v: Pair, a: Action) -> Pair:
        """Inputs, gyroscopic terms, gravity and friction: all but ``M dv/dt``."""

    def mass_matrix(self, params: Any, q: Pair) -> Float[Array, "2 2"]:
        """Joint-space inertia ``M(q)``."""
        a, b, c = self.inertia(params, q)
        return jnp.stack([jnp.stack([a, b]), jnp.stack([b, c])])

    def equations(
        self, params: Any, effects: Effects, q: Pair, v: Pair, a: Action
    ) -> tuple[Inertia, Pair]:
        """``M(q)`` and ``forces(q, v, a)``, with effects of these magnitudes."""
        M, f = self.inertia(params, q), self.forces(params, q, v, a)
        for effect, x in effects:
            more = effect.inertia(self, params, x, q)
            M = M[0] + more[0], M[1] + more[1], M[2] + more[2]
            f = f + effect.force(self, params, x, q, v)
        return M, f

    def ode(self, params: Any, s: State, a: Action) -> State:
        """``(v, M^-1 forces)``."""
        return self.ode_with(params, (), s, a)

    def ode_with(self, params: Any, effects: Effects, s: State, a: Action) -> State:
        """The same with effects of these magnitudes."""
        rest = jnp.zeros_like(s[2])
        v = [rest if locked else s[2 + i] for i, locked in enumerate(self.locked)]
        M, f = self.equations(params, effects, s[:2], jnp.stack(v), a)
        return jnp.stack([*v, *solve_two(M, f, self.locked)])

    def flow_with(
        self, params: Any, effects: Effects, s: State, a: Action, h: float | Scalar
    ) -> State:
        """`flow` with effects of these magnitudes."""
        return rk4(lambda x, u: self.ode_with(params, effects, x, u), s, a, h)

    def joint(self, name: str) -> int:
        """Index of a joint by the name of its position channel (E103 if unknown)."""
        return index_of(name, self.states[:2])


class AbstractForcedPlant(AbstractPlant):
    """A plant with an engine that takes a force on each of its joints, in N or N m.

    Its first states are the positions of the joints; their velocities follow.
    """

    @property
    @abc.abstractmethod
    def joint_inertias(self) -> Float[AnyArray, " j"]:
        """What a force on each joint accelerates, ``1 / (M^-1)_jj`` at the model's
        reference, the other joints free; kg m^2 or kg."""

    @abc.abstractmethod
    def flow_forced(
        self, params: Any, forces: Acting, s: State, a: Action, h: float | Scalar
    ) -> State:
        """`flow` under missing forces."""


def takes_forces(plant: AbstractPlant) -> bool:
    """Whether missing forces are in N and N m; else each accelerates its joint."""
    return isinstance(plant, AbstractMechanism | AbstractForcedPlant)


def solve_two(
    M: Inertia, f: Float[Array, " 2"], locked: tuple[bool, bool]
) -> tuple[Scalar, Scalar]:
    """``M^-1 f`` for two joints; a locked joint does not accelerate."""
    a, b, c = M
    rest = jnp.zeros_like(f[0])
    if all(locked):
        return rest, rest
    if locked[0]:
        return rest, f[1] / c
    if locked[1]:
        return f[0] / a, rest
    det = a * c - b * b
    return (c * f[0] - b * f[1]) / det, (a * f[1] - b * f[0]) / det
