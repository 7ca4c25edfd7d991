"""What moves the joints of a machine: the scale of what it may lack."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from sim2gp.systems.base import LONGEST_MEAN, AbstractPlant
from sim2gp.systems.effects.units import joints_of, velocity_of
from sim2gp.systems.mechanism import AbstractForcedPlant, AbstractMechanism
from sim2gp.types import in_float64

AWAY = 0.5  # rad or m from zero, where a joint's weight is felt


class Drive(NamedTuple):
    """The largest force that inputs and weight give a joint at rest, and what it does.

    ``force`` is in N or N m, or an acceleration where a plant takes no forces;
    ``acceleration`` is in the joint's unit per s^2.
    """

    force: float
    acceleration: float


@in_float64
def drives(plant: AbstractPlant) -> dict[str, Drive]:
    """Of each joint whose velocity is a state; 1 where nothing moves it.

    With nominal parameters, each input at either end of its range, the joints at zero
    and away from it. Of an engine the force is the one that accelerates the joint as
    much alone.
    """
    names = [c.name for c in plant.physical_states]
    joints = [c for c in joints_of(plant) if f"{c.name}.velocity" in names]
    rest = np.zeros(len(names))
    away = np.asarray([AWAY * (c in joints) for c in plant.physical_states])
    high = [c.high if math.isfinite(c.high) else 1.0 for c in plant.actions]
    low = [c.low if math.isfinite(c.low) else -1.0 for c in plant.actions]
    inputs = [np.zeros(len(high)), *np.diag(high), *np.diag(low)]
    pairs = [(s, a) for s in (rest, away) for a in inputs]
    S, A = (jnp.asarray(x) for x in zip(*pairs, strict=True))
    at = tuple(velocity_of(plant, c.name) for c in joints)
    found = np.abs(_forces(plant, S, A, at))
    most = np.max(found, axis=0)
    forces = accelerations = np.where((most > 0.0) & np.isfinite(most), most, 1.0)
    if isinstance(plant, AbstractMechanism):
        first, _, second = eqx.filter_jit(plant.inertia)(plant.nominal(), jnp.zeros(2))
        accelerations = forces / np.asarray([first, second])
    if isinstance(plant, AbstractForcedPlant):
        forces = accelerations * plant.joint_inertias
    both = zip(joints, forces.tolist(), accelerations.tolist(), strict=True)
    return {c.name: Drive(f, a) for c, f, a in both}


@eqx.filter_jit
def _forces(
    plant: AbstractPlant,
    S: Float[Array, "B n"],
    A: Float[Array, "B m"],
    velocities: tuple[int, ...],
) -> Float[Array, "B j"]:
    """Of each joint, or its mean acceleration where a plant takes no forces."""
    params, h = plant.nominal(), LONGEST_MEAN

    def each(s: Array, a: Array) -> Array:
        if isinstance(plant, AbstractMechanism):
            return jnp.stack(plant.forces(params, s[:2], jnp.zeros(2), a))
        return (plant.flow(params, s, a, h) - s)[np.asarray(velocities, int)] / h

    return jax.vmap(each)(S, A)
