"""A machine with the forces that it may lack, all at zero where a fit has ended."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.systems.parts import AbstractPart

Places = Int[np.ndarray, " _"]


def forces_of(
    system: AbstractSystem, box: Mapping[str, tuple[float, float]]
) -> tuple[AbstractUnknownFunction, ...]:
    """What a machine may lack where its recordings have been.

    Nothing of a plant that takes no forces, whose intervals rest on the scatter of its
    windows alone: an acceleration of one joint is no force on an arm.
    """
    if not takes_forces(plant_of(system)):
        return ()
    return tuple(missing_forces(system, box, fine=True))


def kinds_of(groups: Mapping[str, Places]) -> dict[str, Places]:
    """Places of the weights of each kind of force, on all joints or inputs."""
    found: dict[str, list[int]] = {}
    for name, places in groups.items():
        found.setdefault(name.rsplit(".", 1)[-1], []).extend(places.tolist())
    return {kind: np.asarray(places) for kind, places in found.items()}


def forces_at_zero(
    machine: AbstractSystem, fitted: Estimate, forces: Sequence[AbstractPart]
) -> tuple[AbstractSystem, Estimate, Int[np.ndarray, " p"]]:
    """The machine with forces, its estimate with all at nothing; its own columns."""
    if not forces:
        return machine, fitted, np.arange(fitted.prior.mean.size)
    system = free_parts(machine, forces)
    names, prior = system.parameters.names, system.parameters.prior()
    own = np.asarray([names.index(name) for name in machine.parameters.names])
    scale = prior.scale.at[np.ix_(own, own)].set(fitted.prior.scale)
    whole = replace(
        fitted,
        prior=Gaussian(prior.mean.at[own].set(fitted.prior.mean), scale),
        posterior=Gaussian(prior.mean.at[own].set(fitted.posterior.mean), scale),
        information=jnp.zeros_like(scale),  # of another machine
        scores=jnp.zeros((len(fitted.scores), len(scale))),
    )
    return system, whole, own
