"""Forces that the simulator of a run lacks: of one-step data, and of windows of logs.

One step of exact states has white noise. So its rows are linearised where the machine
with all of its forces fits best, and the average over which forces are on is that of
the corrected intervals (`sim2gp.identification.intervals`), without the scatter of
windows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.identification.intervals.averaging import NOTHING, averaged
from sim2gp.identification.intervals.discrepancy import (
    corrected_windows,
    identifiable,
)
from sim2gp.identification.missing_physics.curves import Curve, curves_of
from sim2gp.identification.missing_physics.data import (
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.reach import box_of
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import Linear, relevant
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import AbstractMechanism
from sim2gp.types import in_float64

ROUNDS = 20  # linearisations
HALVINGS = 8
SETTLED = 0.1  # nats


@dataclass(frozen=True)
class FoundForces:
    """The probability of each kind of force, and of nothing (`NONE`); all curves."""

    each: Mapping[str, float] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()

    @property
    def found(self) -> tuple[Curve, ...]:
        """Forces that are rather there than not."""
        likely = {kind for kind, p in self.each.items() if kind and p > NOTHING}
        return tuple(c for c in self.curves if likely & set(c.kinds))


def find_forces(data: AbstractData, bare: Estimate) -> FoundForces:
    """Which forces the machine of ``data`` lacks, given the fit without any.

    None of a plant without a mass matrix.
    """
    if not isinstance(plant_of(data.system), AbstractMechanism):
        return FoundForces()
    if isinstance(data, OneStepData):
        return _of_transitions(data, bare)
    assert isinstance(data, WindowData)
    return _of_windows(data, bare)


def _of_windows(data: WindowData, bare: Estimate) -> FoundForces:
    likelihood = data.likelihood(data.system)
    found = corrected_windows(likelihood, bare, data.recording, closely(data))
    return FoundForces(found.each, found.curves)


@in_float64
def _of_transitions(data: OneStepData, bare: Estimate) -> FoundForces:
    machine, box = data.system, _visited(data)
    forces = missing_forces(machine, box, fine=True, closely=True)
    system = free_parts(machine, forces, period=data.period)
    table = system.parameters
    own = np.asarray([table.names.index(name) for name in machine.parameters.names])
    prior = ParameterPrior(table.prior(), table)
    start = np.zeros(len(table))
    start[own] = np.asarray(bare.z())
    z, rows, noise = _descend(data, system, prior, start, bare.noise, own)
    # With forces on, masses and motor times a number are forces divided by it: that the
    # forces are there must be seen where they are off, and how large where they are on.
    off = np.zeros(len(z))
    off[own] = z[own]
    A, data_off = _whitened(_rows(data, system, off), noise, off)
    T, groups = identifiable(A, own, table.groups)
    on, data_on = _whitened(rows, noise, z)
    mean, scale, each = averaged(A @ T, data_off, groups, (on @ T, data_on))
    about = prior.gaussian
    at = about.at(jnp.asarray(T @ mean))
    virtual = Gaussian(at, about.scale @ jnp.asarray(T @ scale))
    return FoundForces(each, curves_of(system, forces, box, virtual))


def _descend(
    data: OneStepData,
    system: AbstractSystem,
    prior: ParameterPrior,
    z: Float[np.ndarray, " p"],
    noise: Noise,
    own: Int[np.ndarray, " o"],
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "c k k"], Noise]:
    """Where the machine with all its forces fits best: parameters, rows, noise.

    Each step goes to the posterior of the linearised rows, with the noise and the
    scales of highest evidence there, and is halved as long as residuals fall by that.
    """
    likelihood = data.likelihood(system)
    counts, floor = likelihood.counts[0], likelihood.floor
    rows, none = _rows(data, system, z), jnp.zeros_like(floor)
    for k in range(ROUNDS):
        t0 = time.perf_counter()
        grams = jnp.asarray(np.swapaxes(rows, 1, 2) @ rows)
        linear = Linear(grams, none, counts, floor)
        noise, scaled = _relevant(linear, jnp.asarray(z), noise, prior)
        noise = jax.block_until_ready(noise)
        t1 = time.perf_counter()
        R = _whole(rows, noise)
        each = np.asarray(scaled.each())
        whole = np.concatenate([R[:, :-1] * each, np.eye(len(z))])
        data_and_prior = np.concatenate([R[:, :-1] @ z - R[:, -1], np.zeros(len(z))])
        step = each * np.linalg.lstsq(whole, data_and_prior)[0] - z
        best = _misfit(rows, counts, floor) - SETTLED
        before, tried = best, None
        for share in 0.5 ** np.arange(HALVINGS):
            at = z + share * step
            found = _rows(data, system, at)
            change = _weights(_whole(found, noise), at, each, own)
            now = _misfit(found, counts, floor, change)
            if now > best and tried is not None:
                break
            if now <= best:
                best, tried = now, at + change
        t2 = time.perf_counter()
        if VERBOSE:
            print("round", k, share, before - best, best, np.asarray(noise.sd).round(4), round(t1 - t0, 2), round(t2 - t1, 2), len(z))
        if tried is None:
            break
        z, prior = tried, scaled
        rows = _rows(data, system, z)
    return z, rows, noise


def _rows(
    data: OneStepData, system: AbstractSystem, z: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "c k k"]:
    """Factors ``[J r]`` of each channel's rows at ``z``."""
    return np.asarray(data.blocks(system, z[None], jnp.zeros((1, 0)))[0, 0])


def _whitened(
    rows: Float[np.ndarray, "c k k"], noise: Noise, z: Float[np.ndarray, " p"]
) -> tuple[Float[np.ndarray, "k p"], Float[np.ndarray, " k"]]:
    """The linear model about ``z``: its slopes, and data as if it went through zero."""
    R = np.asarray(np.linalg.qr(_whole(rows, noise), mode="r"))
    return R[:, :-1], R[:, :-1] @ z - R[:, -1]


def _whole(rows: Float[np.ndarray, "c k k"], noise: Noise) -> np.ndarray:
    """All rows, in sd of the noise."""
    return np.concatenate(list(rows / np.asarray(noise.sd)[:, None, None]))


def _weights(
    R: Float[np.ndarray, "q p1"],
    z: Float[np.ndarray, " p"],
    each: Float[np.ndarray, " p"],
    own: Int[np.ndarray, " o"],
) -> Float[np.ndarray, " p"]:
    """From ``z`` to where the weights of forces are best, parameters as they are."""
    free = np.setdiff1d(np.arange(len(z)), own)
    whole = np.concatenate([R[:, free], np.diag(1.0 / each[free])])
    wanted = np.concatenate([-R[:, -1], -z[free] / each[free]])
    change = np.zeros(len(z))
    change[free] = np.linalg.lstsq(whole, wanted)[0]
    return change


def _misfit(
    rows: Float[np.ndarray, "c k k"],
    counts: Any,
    floor: Any,
    change: Float[np.ndarray, " p"] | None = None,
) -> float:
    """Nats after a small change, each channel's noise at its best."""
    left = rows[:, :, -1]
    if change is not None:
        left = left + rows[:, :, :-1] @ change
    squares = np.sum(left**2, axis=1) + 2.0 * np.asarray(floor) ** 2
    return 0.5 * float(np.sum(np.asarray(counts) * np.log(squares)))


_relevant = jax.jit(relevant)
VERBOSE = False


def _visited(data: OneStepData) -> dict[str, tuple[float, float]]:
    """The range of each channel in the episodes."""
    channels = (*data.system.physical_states, *data.system.actions)
    d = len(data.system.physical_states)
    columns: Sequence[Float[np.ndarray, " N"]] = [
        *np.concatenate([S[:, :d] for S, _ in data.episodes]).T,
        *np.concatenate([A for _, A in data.episodes]).T,
    ]
    return {
        c.name: (float(x.min()), float(x.max()))
        for c, x in zip(channels, columns, strict=True)
    }


def closely(data: WindowData) -> tuple[AbstractUnknownFunction, ...]:
    """What may be missing of a machine, looked at closely."""
    box = box_of(data.system, data.windows)
    return tuple(missing_forces(data.system, box, fine=True, closely=True))
