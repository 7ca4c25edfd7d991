"""A machine with the forces that it may lack, all at zero where a fit has ended."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Int

from sim2gp.data.windows_likelihood import AnyWindows, likelihood_of
from sim2gp.identification.intervals.pulls import WindowRows, rows_of
from sim2gp.identification.missing_physics.reach import Range, box_of
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import in_float64

Places = Int[np.ndarray, " _"]


@dataclass(frozen=True)
class AtZero:
    """A fit of windows, and the same with forces at zero.

    ``likelihood``, ``fitted`` and ``forces`` are those of the machine with forces,
    ``own`` the places of the machine's parameters among its own, ``box`` where it
    moved. ``group`` numbers the logs of the windows, which follow each other in one.
    """

    machine: AbstractSystem
    alone: Estimate
    likelihood: AnyWindows
    fitted: Estimate
    group: Int[np.ndarray, " W"]
    own: Int[np.ndarray, " p"]
    forces: tuple[AbstractUnknownFunction, ...]
    box: Mapping[str, Range]

    @cached_property
    def rows(self) -> WindowRows:
        """The windows, linearised (`rows_of`): once for all who ask."""
        tt = self.fitted.posterior.mean
        return rows_of(self.likelihood, self.fitted, tt, self.group)


@in_float64
def at_zero(
    likelihood: AnyWindows,
    fitted: Estimate,
    group: Int[np.ndarray, " W"],
    forces: Sequence[AbstractUnknownFunction] | None = None,
) -> AtZero:
    """A fit with what its machine may lack: None is those of `forces_of`.

    Measured sums count as they do in the fit's prior (`Estimate.with_measurements`).
    """
    machine, cut = likelihood.system, likelihood.windows
    box = box_of(machine, cut)
    given = forces_of(machine, box) if forces is None else tuple(forces)
    system, whole, own = forces_at_zero(machine, fitted, given)
    wider = likelihood_of(system, cut)
    group = np.asarray(group)
    return AtZero(machine, fitted, wider, whole, group, own, given, box)


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
    about = prior.with_block(own, fitted.prior)
    mean, scale = prior.with_block(own, fitted.posterior).mean, about.scale
    whole = replace(
        fitted,
        prior=about,
        posterior=Gaussian(mean, scale),
        information=np.zeros(scale.shape),  # of another machine
        scores=np.broadcast_to(0.0, (len(fitted.scores), len(scale))),
    )
    return system, whole, own
