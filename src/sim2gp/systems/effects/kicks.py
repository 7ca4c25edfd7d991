"""Forces on the joints of a plant that has no mass matrix: a function, or an engine.

Such a plant takes an effect as the acceleration that it makes. In one substep the plant
flows between two half kicks of its joints' velocities, the second in reverse order
(Strang 1968), so that the error of a step is of third order in its length. A kick is
the effect's own closed form (`AbstractJointForce.accelerated`): friction may be as
steep as it likes.

Missing forces are smooth. A function takes them as kicks, too, by the midpoint rule. An
engine takes forces in N and N m (`AbstractForcedPlant`): there they are no kicks, but
act within the engine's steps, each held from where the step begins.
"""

from collections.abc import Iterable
from typing import Any

import jax.numpy as jnp

from sim2gp.systems.base import AbstractPlant
from sim2gp.systems.effects.base import AbstractJointForce
from sim2gp.systems.effects.forces import ForceField, Forcing
from sim2gp.systems.mechanism import AbstractForcedPlant, Acting, Effects
from sim2gp.types import Action, Scalar, State


def kicked(
    plant: AbstractPlant,
    params: Any,
    effects: Effects,
    s: State,
    a: Action,
    h: float | Scalar,
) -> State:
    """State ``h`` seconds later of a plant whose joints are accelerated by effects."""
    half = jnp.asarray(0.5 * h, s.dtype)
    kicks = [x for x in effects if not is_applied(plant, x[0])]
    s = kick(plant, kicks, s, half)
    if len(kicks) == len(effects):
        s = plant.flow(params, s, a, h)
    else:
        assert isinstance(plant, AbstractForcedPlant)  # `is_applied`
        s = plant.flow_forced(params, effects[-1], s, a, h)
    return kick(plant, reversed(kicks), s, half)


def is_applied(plant: AbstractPlant, effect: Forcing) -> bool:
    """Whether an engine takes it as forces, not as kicks."""
    return isinstance(effect, ForceField) and isinstance(plant, AbstractForcedPlant)


def kick(
    plant: AbstractPlant,
    effects: Iterable[Acting],
    s: State,
    t: Scalar,
) -> State:
    """State whose joints' velocities the effects have changed for ``t`` seconds."""
    for effect, x in effects:
        assert isinstance(effect, AbstractJointForce | ForceField)  # `check_effect`
        s = effect.kicked(plant, x.astype(s.dtype), s, t)
    return s
