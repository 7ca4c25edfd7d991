"""MissingForces: the simulator with Gaussian processes where physics may be missing.

    M(q) dv/dt = forces(q, v, u + h(u)) + f(q) + g(v),      f, g, h ~ GP(0, tau^2 k)

(`sim2gp.systems.effects.forces`). Weights of the functions are parameters like the
simulator's own, so that the linearised posterior is that of `Sim2GP`. Each fit chooses
the scales (`sim2gp.inference.relevance`): before data all are off. Where inputs arrive
late (`sim2gp.models.late_inputs`) all stay off.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.one_step import OneStepLikelihood, estimate_forces
from sim2gp.data.transitions import Transitions
from sim2gp.errors import NotConverged, NotFinite, warn
from sim2gp.inference.estimate import Estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.groups import Start
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF, ON
from sim2gp.models.draws import LinearizedDraw
from sim2gp.models.features import Encoding
from sim2gp.models.late_inputs import arrive_late
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief, belief_of
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.bases import AbstractSines
from sim2gp.systems.effects.forces import (
    AbstractUnknownFunction,
    MissingFriction,
)
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.systems.machine import as_machine
from sim2gp.types import Action, Dynamics, Key, State, in_float64

FAR = 1.25  # reaches of a channel: a function is accurate within about one


class MissingForces(AbstractModel):
    """The simulator, and forces that it may lack.

    ``sim`` gives the prior of its own parameters. ``reach`` gives half-widths of where
    the machine moves, for some channels by name (`Encoding.of`, whose errors it
    raises); a fit doubles those that its data leave. A belief is about the machine with
    the forces that are on: one that is off costs nothing.
    """

    plain: Sim2GP
    sim: Sim2GP
    wide: Sim2GP
    forces: tuple[AbstractUnknownFunction, ...]
    reach: tuple[tuple[str, float], ...] = eqx.field(static=True)

    @in_float64
    def __init__(
        self, sim: Sim2GP, *, reach: Mapping[str, float] | None = None
    ) -> None:
        box = Encoding.of(sim.system, reach or {}).box()
        self.reach = tuple((reach or {}).items())
        self.plain = sim
        self.forces = self._functions(box)
        self.sim = self._with(self.forces)
        self.wide = self._with(self._functions(box, wide=True))

    def _functions(
        self, box: Mapping[str, tuple[float, float]], *, wide: bool = False
    ) -> tuple[AbstractUnknownFunction, ...]:
        every = missing_forces(self.plain.system, box, wide=wide)
        return tuple(f for f in every if self.counts(f))

    def _with(self, forces: Sequence[AbstractUnknownFunction]) -> Sim2GP:
        """The simulator with forces, and its own prior."""
        own = self.plain.prior
        system = free_parts(self.plain.system, forces)
        prior = system.parameters.prior().with_block(np.arange(own.mean.size), own)
        return Sim2GP(system, dt=self.plain.dt, prior=prior)

    def counts(self, function: AbstractUnknownFunction) -> bool:
        """Whether the machine may lack such a function: any, here."""
        del function
        return True

    @property
    def system(self) -> AbstractSystem:
        """The machine with all forces."""
        return self.sim.system

    @property
    def history(self) -> int:
        return self.sim.history

    def init(self, key: Key) -> Sim2GPBelief:
        """The simulator's prior; all forces are off."""
        return self.plain.init(key)

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> Sim2GPBelief:
        """The best of several starts by evidence, with noise and scales learned.

        Where it does not converge, as where no force of one variable is what is
        missing, the simulator is fitted alone (warning W204). Raises `NotConverged`,
        `NotFinite` or `DeadParameters` where that fails.
        """
        assert isinstance(belief, Sim2GPBelief)
        model = self.holding(data)
        if model is not self:
            return model.fit(belief, data, key=key)
        rows = jax.tree.map(jnp.asarray, data)
        belief = belief if self._same_ranges(belief.system) else self.init(key)
        try:
            belief = self._with_forces(belief, rows)
        except (NotConverged, NotFinite) as failed:
            warn("W204", f"the simulator is fitted without missing forces: {failed}")
        else:
            likelihood = OneStepLikelihood(belief.system, rows, belief.dt)
            on = belief.system.parameters.groups
            late = on and arrive_late(likelihood, belief.prior, belief.posterior)
            if not late:
                return belief
        return self.plain.fit(self.init(key), data, key=key)

    def _with_forces(self, belief: Sim2GPBelief, rows: Transitions) -> Sim2GPBelief:
        """Friction is looked for as wide as the machine's own substeps can follow.

        A fit with the short ones that steep friction needs follows where it is found.
        """
        if not _has_friction(belief.system):
            belief = self._fitted(self.wide, belief, rows)
        if _has_friction(belief.system):
            belief = self._fitted(self.sim, belief, rows)
        return belief

    def _fitted(
        self, sim: Sim2GP, belief: Sim2GPBelief, rows: Transitions
    ) -> Sim2GPBelief:
        """With the forces of ``sim``, about the machine with those that are on."""
        found = self._estimate(sim, belief, rows)
        found.convergence.check(
            self.system.parameters.names, f"{rows.count} transitions"
        )
        return self._needed(belief_of(sim, found, rows))

    def _estimate(
        self, sim: Sim2GP, belief: Sim2GPBelief, rows: Transitions
    ) -> Estimate:
        prior, start = self._prior(), self._start(belief)
        return estimate_forces(sim.system, rows, sim.dt, prior, start)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> Sim2GPBelief:
        """Condition on one transition; scales wait for the next fit."""
        return self.sim.update(belief, s, a, s2)

    def shared(self, draw: Dynamics) -> Dynamics:
        """The draw as one of the machine with all forces: those that are off are zero.

        Slower, but all sets of forces are two programs, with friction and without.
        """
        assert isinstance(draw, LinearizedDraw)
        sim = self.sim if _has_friction(draw.system) else self.wide
        own = {e.name: e for e in as_machine(draw.system).effects}
        whole = as_machine(sim.system)  # whose functions may have other ranges
        effects = tuple(own.get(e.name, e) for e in whole.effects)
        system = replace(whole, effects=effects)
        at, mean = self._places(draw.system), sim.prior.mean.astype(jnp.float32)
        delta = jnp.zeros_like(mean).at[at].set(draw.delta)
        return LinearizedDraw(system, mean.at[at].set(draw.tt), delta, draw.dt)

    def holding(self, data: Transitions) -> "MissingForces":
        """Itself, or with reaches doubled until the data are within them.

        Far beyond its reach a function is constant: a spring would have to be noise.
        """
        given, system = dict(self.reach), self.plain.system
        box = Encoding.of(system, given).box()
        outer = np.max(np.abs(data.held[0]), axis=0, initial=0.0)
        wider = {}
        for channel, x in zip(system.states, outer.tolist(), strict=False):
            half = max(map(abs, box[channel.name]))
            if x > FAR * half and not channel.turns:
                wider[channel.name] = half * 2.0 ** math.ceil(math.log2(x / half))
        return type(self)(self.plain, reach=given | wider) if wider else self

    def _same_ranges(self, system: AbstractSystem) -> bool:
        """Whether a machine's functions have the ranges of these."""
        ours = {f.name: f.basis for f in self.forces}
        pairs = [
            (f.basis, ours[f.name])
            for f in as_machine(system).effects
            if isinstance(f, AbstractUnknownFunction) and f.name in ours
        ]
        return all(
            float(x.start) == float(y.start) and float(x.span) == float(y.span)
            for x, y in pairs
            if isinstance(x, AbstractSines) and isinstance(y, AbstractSines)
        )

    def _prior(self) -> ParameterPrior:
        """With all forces at the scale of their own prior."""
        return ParameterPrior(self.sim.prior, self.system.parameters)

    def _start(self, belief: Sim2GPBelief) -> Start:
        """Where a belief is, among all forces."""
        about, at = self.sim.prior, self._places(belief.system)
        mean = about.mean.at[at].set(belief.posterior.mean)
        sd = OFF * jnp.diagonal(about.scale)
        sd = sd.at[at].set(jnp.diagonal(belief.prior.scale))
        scales = self._prior().scales_in(Gaussian(mean, jnp.diag(sd)))
        return Start(about.whitened(mean), belief.noise, scales, belief.count > 0)

    def _needed(self, belief: Sim2GPBelief) -> Sim2GPBelief:
        """The same about the machine with the forces that are on."""
        scales = self._prior().scales_in(belief.prior)
        groups = zip(self.system.parameters.groups, scales, strict=True)
        on = [name for name, tau in groups if tau > ON]
        system = free_parts(self.plain.system, [f for f in self.forces if f.name in on])
        return belief.marginal(self._places(system), system)

    def _places(self, system: AbstractSystem) -> Int[np.ndarray, " k"]:
        """Those of a machine's parameters in the table with all forces."""
        names = self.system.parameters.names
        return np.asarray([names.index(name) for name in system.parameters.names])


def _has_friction(system: AbstractSystem) -> bool:
    """Whether one of the forces that are on is dry friction."""
    effects = as_machine(system).effects
    return any(isinstance(effect, MissingFriction) for effect in effects)
