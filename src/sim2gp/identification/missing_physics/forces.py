"""Forces that the simulator of a run lacks: of one-step data, and of windows of logs.

All functions that may be missing are fitted (`estimate_groups`), and each that is on is
tried without: where a machine has a pendulum, a force that acts as its gravity lets all
masses and forces grow together, and choices on a linear model alone do not undo it.
Errors of windows may be coloured: what a function gains counts as often as their
samples do, and bands are as wide as windows scatter
(`sim2gp.identification.intervals`). A simulator on the host has the corrected intervals
alone, whose noise has in it what is missing.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from sim2gp.data.windows_likelihood import WindowsLikelihood
from sim2gp.errors import NotConverged, NotFinite
from sim2gp.identification.intervals.averaging import NONE, NOTHING
from sim2gp.identification.intervals.discrepancy import corrected_windows
from sim2gp.identification.intervals.pulls import Pulls, pulls_of_windows
from sim2gp.identification.intervals.scatter import correct_posterior, posterior_of
from sim2gp.identification.missing_physics.at_zero import at_zero
from sim2gp.identification.missing_physics.curves import Curve, curves_of
from sim2gp.identification.missing_physics.data import (
    FREE,
    AbstractData,
    OneStepData,
    WindowData,
)
from sim2gp.identification.missing_physics.reach import (
    Range,
    box_of,
    box_of_rows,
)
from sim2gp.identification.missing_physics.shapes import is_nothing
from sim2gp.inference.convergence import NEAR
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.groups import Start, estimate_groups
from sim2gp.inference.likelihood import AbstractLikelihood
from sim2gp.inference.parameters import Parameters
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import (
    EARNED,
    NEVER,
    OFF,
    ON,
    TRIED,
    gains_if_on,
    price,
)
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import plant_of
from sim2gp.systems.mechanism import takes_forces
from sim2gp.types import in_float64

SHARE = 0.3  # of a force, that its shape may be another
COMPARED = 1.0  # posterior sd from its MAP, of a fit whose evidence is compared alone
EXCLUDED = 2.0  # nats less than without it: the data exclude a force of this size


@dataclass(frozen=True)
class FoundForces:
    """The probability of each force, of all joints of a kind or of one, and of nothing
    (`NONE`); all curves; why there are none where the fit did not converge."""

    each: Mapping[str, float] = field(default_factory=dict)
    curves: tuple[Curve, ...] = ()
    failure: str = ""

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

    None of a plant that takes no forces, or where a fit with all of them fails. Raises
    `NotFinite` E203 where a simulator on the host is not finite.
    """
    if not takes_forces(plant_of(data.system)):
        return FoundForces()
    box = _box(data)
    forces = missing_forces(data.system, box, fine=True, closely=True)
    likelihood = data.likelihood(data.system)
    if not likelihood.on_host:
        try:
            return _fitted(data, forces, box)
        except (NotConverged, NotFinite) as failed:
            return FoundForces(failure=str(failed))
    assert isinstance(data, WindowData)
    assert isinstance(likelihood, WindowsLikelihood)
    found = corrected_windows(at_zero(likelihood, bare, data.recording, forces))
    return FoundForces(found.each, found.curves)


def _box(data: AbstractData) -> dict[str, Range]:
    """Where the machine has been."""
    if isinstance(data, WindowData):
        return box_of(data.system, data.windows)
    assert isinstance(data, OneStepData)
    states, inputs = (np.concatenate(x) for x in zip(*data.episodes, strict=True))
    return box_of_rows(data.system, states, inputs)


@in_float64
def _fitted(
    data: AbstractData,
    forces: Sequence[AbstractUnknownFunction],
    box: Mapping[str, Range],
) -> FoundForces:
    """The functions that are on in the fit of highest evidence, sizes left free."""
    system = free_parts(data.system, forces, period=data.period or None)
    table = system.parameters
    names, p = tuple(table.groups), len(table)
    prior = ParameterPrior(table.prior(), table, jnp.ones(len(names)))
    likelihood = data.likelihood(system)
    first = likelihood.first_noise().sd

    def fit(last: Start, near: float = 0.0) -> _Fit:
        found = estimate_groups(likelihood, prior, last, data.freedom)
        found.convergence.check(table.names, "the data", near)
        return _Fit(found, np.asarray(prior.scales_in(found.prior)))

    def without(best: _Fit, name: str) -> _Fit:
        """The best fit from where this one is, but for one function."""
        off = np.asarray(names) == name
        z = prior.gaussian.whitened(best.found.posterior.mean)
        z = z.at[table.groups[name]].set(0.0)
        scales = jnp.where(off, NEVER, jnp.asarray(best.scales))
        # Only this start: what has no more noise than nothing at all is enough.
        noise = jnp.maximum(first, best.found.noise.sd)
        return fit(Start(z, noise, scales, jnp.ones((), bool)), COMPARED)

    none = jnp.zeros((), bool)
    best = fit(Start(jnp.zeros(p), first, jnp.ones(len(names)), none))
    about = _Linear.of(data, likelihood, best.found)
    alike = about.posterior(best.kept(table))[1]
    while True:
        on = [n for n, s in zip(names, best.scales, strict=True) if s > ON]
        tried = {name: without(best, name) for name in on}
        gains = {n: (best.nats - x.nats) / alike for n, x in tried.items()}
        if not gains or min(gains.values()) >= 0.0:
            break
        best = tried[min(gains, key=gains.__getitem__)]
        best.found.convergence.check(table.names, "the data")
    each = {n: 1.0 / (1.0 + math.exp(-min(g + EARNED, 50.0))) for n, g in gains.items()}
    nothing = math.prod((1.0 - p for p in each.values()), start=1.0)
    most = _largest(best.found, prior.scaled(jnp.asarray(best.scales)), alike)
    best = replace(best, scales=_of_free_size(best.scales, forces))
    wide = prior.scaled(jnp.asarray(best.scales))
    any_size = _with_free_sizes(likelihood, best.found, wide, data.freedom)
    free = _Linear.of(data, likelihood, any_size)
    curves: list[Curve] = []
    for own in dict.fromkeys((f.where, f.of) for f in forces):
        mine = np.asarray([(f.where, f.of) == own for f in forces])
        some = np.where(mine & (best.scales <= ON), most, best.scales)
        wider = prior.each(some) / prior.each(best.scales)
        kept = replace(best, scales=some).kept(table)
        known, _ = free.posterior(kept, wider)
        virtual = free.found.prior.with_block(kept, known)
        own_forces = [f for f, x in zip(forces, mine, strict=True) if x]
        curves += curves_of(system, own_forces, box, virtual)
    return FoundForces({NONE: nothing} | each, tuple(curves))


def _largest(
    found: Estimate, prior: ParameterPrior, alike: float
) -> Float[np.ndarray, " g"]:
    """The largest scale of each function that is off which the data do not exclude."""
    each, about = prior.each(), prior.gaussian
    R, gradient = found.information / each[None], -found.scores.sum(axis=0) / each
    root = jnp.linalg.solve(about.scale, found.posterior.scale)
    gains = gains_if_on(R.T @ R, gradient, root @ root.T, prior.members)
    possible = np.asarray(gains) >= -EXCLUDED * alike
    return np.max(np.where(possible, TRIED, OFF), axis=1)


def _of_free_size(
    scales: Float[np.ndarray, " g"], forces: Sequence[AbstractUnknownFunction]
) -> Float[np.ndarray, " g"]:
    """Scales with which functions that are on may be of any size.

    Others of the same variable are part of the curve then, of a share of its size: a
    force is hardly ever exactly of the shape that explains most of it.
    """
    sizes = scales * [f.magnitude for f in forces]
    found = np.where(scales > ON, scales / FREE, scales)
    for k, f in enumerate(forces):
        alike = (scales > ON) & [g.of == f.of for g in forces]
        most = np.max(sizes, where=alike, initial=0.0)
        if scales[k] <= ON < most / f.magnitude:
            found[k] = SHARE * most / f.magnitude
    return found


class _Linear(NamedTuple):
    """A fit, and what its windows say of a machine that is linear about it.

    One-step data are one window.
    """

    found: Estimate
    pulls: Pulls

    @classmethod
    def of(
        cls, data: AbstractData, likelihood: AbstractLikelihood, found: Estimate
    ) -> "_Linear":
        """Linearised at the fit."""
        if isinstance(data, WindowData) and isinstance(likelihood, WindowsLikelihood):
            return cls(found, pulls_of_windows(likelihood, found, data.recording))
        scores = np.asarray(found.scores).sum(axis=0)
        one = np.asarray(found.information)[None], scores[None], np.zeros(1, int)
        return cls(found, Pulls(*one))

    def posterior(
        self, kept: Int[np.ndarray, " k"], wider: Float[np.ndarray, " p"] | None = None
    ) -> tuple[Gaussian, float]:
        """Of the parameters at some places; how many samples count as one.

        The others are held, and ``wider`` multiplies the prior's sd. Of windows both
        are corrected for errors that are coloured.
        """
        about, p = self.found.prior, self.found.prior.mean.size
        wider = np.ones(p) if wider is None else np.asarray(wider)
        pulls = self.pulls.onto((np.eye(p) * wider)[:, kept])
        scale = (np.asarray(about.scale) * wider)[np.ix_(kept, kept)]
        prior = Gaussian(about.mean[kept], jnp.asarray(scale))
        plain = posterior_of(prior, self.found.posterior.mean[kept], pulls)
        corrected = correct_posterior(prior, plain, pulls)
        if corrected.enough:
            return corrected.posterior, max(corrected.inflation, 1.0)
        return plain, 1.0


@dataclass(frozen=True)
class _Fit:
    """A fit, and the scales of its functions."""

    found: Estimate
    scales: Float[np.ndarray, " g"]

    @property
    def nats(self) -> float:
        """Evidence, less what functions that are on must earn."""
        return float(self.found.log_evidence - price(jnp.asarray(self.scales)))

    def kept(self, table: Parameters) -> Int[np.ndarray, " k"]:
        """Places of the machine's own parameters, and of functions that are on."""
        off = {n for n, s in zip(table.groups, self.scales, strict=True) if s <= ON}
        return np.flatnonzero([p.group not in off for p in table.free])


@eqx.filter_jit
def _with_free_sizes(
    likelihood: AbstractLikelihood,
    best: Estimate,
    prior: ParameterPrior,
    freedom: float,
) -> Estimate:
    """The fit where functions that are on may be of any size.

    A prior whose scale is the data's says nothing of a force's size. But where masses
    and motor are unknown, too, it draws weights to zero together with them: along that
    direction by as many variances as a function has weights.
    """
    wide = prior.as_gaussian()
    start = wide.whitened(best.posterior.mean)[None]
    about = ParameterPrior(wide, prior.table.without_groups())
    return estimate(
        likelihood,
        about,
        starts=start,
        noise=best.noise,
        freedom=freedom,
        until=NEAR,
    )
