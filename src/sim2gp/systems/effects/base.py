"""Physics that a real machine has and a simulator may lack.

An effect has one scalar magnitude, zero for no effect. On an input it changes what
arrives; on the joints of a machine it adds inertia and forces to the equations
(`sim2gp.systems.mechanism`). `sim2gp.systems.effects.registry` lists all effects.
"""

import abc
from typing import Any

import jax
import jax.numpy as jnp
from equinox import AbstractClassVar
from jaxtyping import Array, Float

from sim2gp.errors import error
from sim2gp.inference.parameters import Parameter
from sim2gp.systems.base import AbstractPlant, index_of
from sim2gp.systems.effects.units import law_unit, velocity_of
from sim2gp.systems.function_checks import check_returns
from sim2gp.systems.mechanism import AbstractMechanism, Inertia, Pair
from sim2gp.systems.parts import AbstractPart, around_nothing
from sim2gp.types import Action, AnyArray, Scalar, State

SUBSTEP = 0.005  # s; a true machine with effects is integrated twice as finely


class AbstractEffect(AbstractPart):
    """One missing piece of physics; ``max_substep`` (s) is the RK4 substep it needs.

    Free, its mean is no effect, and its sd the magnitude.
    """

    max_substep: AbstractClassVar[float]

    def parameter(self, plant: AbstractPlant) -> Parameter:
        return around_nothing(self, plant, abs(self.magnitude))


class AbstractJointEffect(AbstractEffect):
    """An effect on the equations of a machine's joints."""

    @abc.abstractmethod
    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        """Additional ``M11, M12, M22``, for the magnitude ``x``."""

    @abc.abstractmethod
    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        """Additional generalised forces, for the magnitude ``x``."""


class AbstractForce(AbstractJointEffect):
    """An effect that only adds forces."""

    def inertia(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair
    ) -> Inertia:
        none = jnp.zeros_like(q[0])
        return none, none, none


class AbstractJointForce(AbstractForce):
    """A force along one joint, by its own position and velocity: on any plant.

    A plant without a mass matrix takes it as an acceleration
    (`sim2gp.systems.effects.kicks`). ``powers`` are those of position and velocity that
    the magnitude multiplies, (0, 1) for damping: its unit and its prior follow.
    """

    powers: AbstractClassVar[tuple[int, int]]

    def unit(self, plant: AbstractPlant) -> str:
        return law_unit(plant, self.where, self.powers)

    @abc.abstractmethod
    def along(self, x: Scalar, q: Scalar, v: Scalar) -> Scalar:
        """The force, for the magnitude ``x``."""

    @abc.abstractmethod
    def accelerated(self, x: Scalar, q: Scalar, v: Scalar, t: Scalar) -> Scalar:
        """Velocity after ``t`` seconds of ``dv/dt = along(x, q, v)``, ``q`` held."""

    def kicked(self, plant: AbstractPlant, x: Scalar, s: State, t: Scalar) -> State:
        """The state after ``t`` seconds of this force alone (`effects.kicks`)."""
        i = index_of(self.where, plant.physical_states)
        j = velocity_of(plant, self.where)
        return s.at[j].set(self.accelerated(x, s[i], s[j], t))

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        i = system.joint(self.where)
        return on_joint(i, self.along(x, q[i], v[i]))


class AbstractInputEffect(AbstractEffect):
    """An effect on the input ``where`` of any plant; it has the input's unit."""

    @abc.abstractmethod
    def through(self, x: Scalar, u: Scalar) -> Scalar:
        """What arrives of the input ``u``, for the magnitude ``x``."""

    def unit(self, plant: AbstractPlant) -> str:
        return plant.actions[index_of(self.where, plant.actions)].unit


def on_joint(i: int, f: Scalar) -> Pair:
    """A force on one of two joints."""
    none = jnp.zeros_like(f)
    return jnp.stack([f, none] if i == 0 else [none, f])


def check_effect(plant: AbstractPlant, effect: AbstractEffect) -> None:
    """That an effect's functions have the right shapes (E140, E123, E173).

    Raises `InputError` E145 for an effect that needs the equations of a plant without.
    """
    found: list[tuple[str, Any, int]] = []
    if isinstance(effect, AbstractInputEffect):
        found = [("through", _through, 1)]
    elif not isinstance(effect, AbstractJointEffect):
        pass  # a missing force is ours
    elif isinstance(plant, AbstractMechanism):
        found = [("inertia", _inertia, 3), ("force", _force, 2)]
    elif isinstance(effect, AbstractJointForce):
        found = [("along", _along, 2)]
    else:
        got = type(plant).__name__
        raise error("effect_without_mass_matrix", got=got, name=effect.name)
    for what, f, size in found:
        name = f"{type(effect).__name__}.{what}"
        function = jax.tree_util.Partial(f, plant, effect)
        check_returns(plant, what, function, name=name, size=size)


def _through(
    plant: AbstractPlant,
    effect: AbstractInputEffect,
    params: Any,
    s: State,
    a: Action,
) -> Float[Array, " 1"]:
    """`AbstractInputEffect.through` as an array of one, at a magnitude of one."""
    return jnp.asarray(effect.through(_ones(effect, s), a[0]))[None]


def _along(
    plant: AbstractPlant, effect: AbstractJointForce, params: Any, s: State, a: Action
) -> Float[Array, " 2"]:
    """`AbstractJointForce.along` and `accelerated`, likewise."""
    x, one = _ones(effect, s), jnp.ones((), s.dtype)
    along = effect.along(x, s[0], s[0])
    return jnp.stack([along, effect.accelerated(x, s[0], s[0], one)])


def _inertia(
    system: AbstractMechanism,
    effect: AbstractJointEffect,
    params: Any,
    s: State,
    a: Action,
) -> Any:
    """`AbstractJointEffect.inertia`, likewise."""
    return jnp.stack(effect.inertia(system, params, _ones(effect, s), s[:2]))


def _force(
    system: AbstractMechanism,
    effect: AbstractJointEffect,
    params: Any,
    s: State,
    a: Action,
) -> Any:
    """`AbstractJointEffect.force`, likewise."""
    return effect.force(system, params, _ones(effect, s), s[:2], s[2:4])


def _ones(effect: AbstractEffect, s: State) -> AnyArray:
    """What an effect's functions take where its parameters are one."""
    return effect.own({name: jnp.ones((), s.dtype) for name in effect.values})
