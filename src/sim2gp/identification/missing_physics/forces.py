"""Forces that the simulator of a run lacks: of one-step data, and of windows of logs.

Windows have the corrected intervals (`sim2gp.identification.intervals`), with functions
that have details. Of one-step data the functions are fitted (`estimate_groups`), and
each that is on is tried without: where a machine has a pendulum, a force that acts as
its gravity lets all masses and forces grow together, and choices on a linear model
alone do not undo it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim2gp.data.one_step import OneStepLikelihood, estimate_forces
from sim2gp.identification.intervals.averaging import NONE, NOTHING
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.identification.missing_physics.curves import Curve, curves_of
from sim2gp.identification.missing_physics.data import (
    FREE,
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.reach import box_of, box_of_rows
from sim2gp.identification.missing_physics.shapes import is_nothing
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.groups import Start
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import EARNED, OFF, ON, price
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.types import in_float64


@dataclass(frozen=True)
class FoundForces:
    """The probability of each force, of all joints of a kind or of one, and of nothing
    (`NONE`); all curves."""

    each: Mapping[str, float] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()

    @property
    def found(self) -> tuple[Curve, ...]:
        """Forces that are rather there than not, and whose band leaves zero."""
        likely = (c for c in self.curves if self.probability(c) > NOTHING)
        return tuple(c for c in likely if not is_nothing(c))

    def probability(self, curve: Curve) -> float:
        """That one of the functions that a curve is the sum of is there."""
        names = {*curve.kinds, *(f"{curve.where}.{kind}" for kind in curve.kinds)}
        return max((p for name, p in self.each.items() if name in names), default=0.0)


def find_forces(data: AbstractData, bare: Estimate) -> FoundForces:
    """Which forces the machine of ``data`` lacks, given the fit without any.

    None of a plant that takes no forces. Raises `NotFinite` E203.
    """
    if not takes_forces(plant_of(data.system)):
        return FoundForces()
    if isinstance(data, OneStepData):
        return _of_transitions(data)
    assert isinstance(data, WindowData)
    box = box_of(data.system, data.windows)
    forces = missing_forces(data.system, box, fine=True, closely=True)
    likelihood = data.likelihood(data.system)
    found = corrected_windows(at_zero(likelihood, bare, forces), data.recording)
    return FoundForces(found.each, found.curves)


@in_float64
def _of_transitions(data: OneStepData) -> FoundForces:
    """The functions that are on in the fit of highest evidence, sizes left free."""
    machine = data.system
    states, inputs = (np.concatenate(x) for x in zip(*data.episodes, strict=True))
    box = box_of_rows(machine, states, inputs)
    forces = missing_forces(machine, box, fine=True, closely=True)
    system = free_parts(machine, forces, period=data.period)
    table = system.parameters
    names = tuple(table.groups)
    rows = jax.tree.map(jnp.asarray, data.transitions(system.history))
    prior = ParameterPrior(table.prior(), table, jnp.ones(len(table.groups)))
    key, zero = jax.random.key(data.seed), jnp.zeros(len(table))

    def fit(last: Start) -> _Fit:
        args = rows, data.period, prior, last, key
        found = estimate_forces(system, *args)
        found.convergence.check(table.names, "transitions")
        return _Fit(found, np.asarray(prior.scales_in(found.prior)))

    def without(best: _Fit, name: str) -> _Fit:
        """The best fit from where this one is, but for one function."""
        off = np.asarray(names) == name
        z = prior.gaussian.whitened(best.found.posterior.mean)
        z = z.at[table.groups[name]].set(0.0)
        scales = jnp.where(off, OFF, jnp.asarray(best.scales))
        # Only this start: what has no more noise than nothing at all is enough.
        noise = jnp.maximum(likelihood.first_noise().sd, best.found.noise.sd)
        return fit(Start(z, noise, scales, jnp.ones((), bool)))

    likelihood = data.likelihood(system)
    start = Start(
        zero, likelihood.first_noise().sd, jnp.zeros(len(names)), jnp.zeros((), bool)
    )
    best, gains = fit(start), dict[str, float]()
    while True:
        on = [n for n, s in zip(names, best.scales, strict=True) if s > ON]
        tried = {name: without(best, name) for name in on}
        gains = {name: best.nats - less.nats for name, less in tried.items()}
        if not gains or min(gains.values()) >= 0.0:
            break
        best = tried[min(gains, key=gains.__getitem__)]
    each = {n: 1.0 / (1.0 + math.exp(-min(g + EARNED, 50.0))) for n, g in gains.items()}
    nothing = math.prod(1.0 - p for p in each.values())
    wide = [best.scales[k] / (FREE if n in each else 1.0) for k, n in enumerate(names)]
    free = _with_free_sizes(likelihood, best.found, prior.scaled(jnp.asarray(wide)))
    curves = curves_of(system, forces, box, free.posterior)
    return FoundForces({NONE: nothing} | each, curves)


@dataclass(frozen=True)
class _Fit:
    """A fit, and the scales of its functions."""

    found: Estimate
    scales: Float[np.ndarray, " g"]

    @property
    def nats(self) -> float:
        """Evidence, less what functions that are on must earn."""
        return float(self.found.log_evidence - price(jnp.asarray(self.scales)))


@eqx.filter_jit
def _with_free_sizes(
    likelihood: OneStepLikelihood, best: Estimate, prior: ParameterPrior
) -> Estimate:
    """The fit where functions that are on may be of any size.

    A prior whose scale is the data's says nothing of a force's size. But where masses
    and motor are unknown, too, it draws weights to zero together with them: along that
    direction by as many variances as a function has weights.
    """
    wide = prior.as_gaussian()
    start = wide.whitened(best.posterior.mean)[None]
    about = ParameterPrior(wide, prior.table.without_groups())
    return estimate(likelihood, about, starts=start, noise=best.noise)
