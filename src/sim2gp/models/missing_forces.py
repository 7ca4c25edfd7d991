"""MissingForces: the simulator with Gaussian processes where physics may be missing.

    M(q) dv/dt = forces(q, v, u + h(u)) + f(q) + g(v),      f, g, h ~ GP(0, tau^2 k)

(`sim2gp.systems.effects.forces`). Weights of the functions are parameters like the
simulator's own, so that the linearised posterior is that of `Sim2GP`. Each fit chooses
the scales (`sim2gp.inference.relevance`): before data all are off.
"""

from collections.abc import Mapping

import jax
import jax.numpy as jnp

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.one_step import estimate_forces
from sim2gp.data.transitions import Transitions
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.groups import Start
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF
from sim2gp.models.features import Encoding
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief, belief_of
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.types import Action, Key, State, in_float64


class MissingForces(AbstractModel):
    """The simulator, and forces that it may lack.

    ``sim`` gives the prior of its own parameters. ``reach`` gives half-widths of where
    the machine moves, for some channels by name (`Encoding.of`, whose errors it
    raises).
    """

    sim: Sim2GP

    @in_float64
    def __init__(
        self, sim: Sim2GP, *, reach: Mapping[str, float] | None = None
    ) -> None:
        parts = missing_forces(sim.system, Encoding.of(sim.system, reach or {}).box())
        system, own = free_parts(sim.system, parts), sim.prior
        more, p = system.parameters.prior(), own.mean.size
        scale = more.scale.at[:p, :p].set(own.scale)
        prior = Gaussian(more.mean.at[:p].set(own.mean), scale)
        self.sim = Sim2GP(system, dt=sim.dt, prior=prior)

    @property
    def system(self) -> AbstractSystem:
        """The machine with its forces."""
        return self.sim.system

    @property
    def history(self) -> int:
        return self.sim.history

    @in_float64
    def init(self, key: Key) -> Sim2GPBelief:
        """The simulator's prior; all forces are off."""
        return self.sim.with_prior(self.prior(OFF).as_gaussian()).init(key)

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> Sim2GPBelief:
        """The best of several starts by evidence, with noise and scales learned.

        Raises `NotConverged`, `NotFinite` or `DeadParameters`.
        """
        assert isinstance(belief, Sim2GPBelief)
        rows, about = jax.tree.map(jnp.asarray, data), self.sim.prior
        z = about.whitened(belief.posterior.mean)
        scales = self.prior(1.0).scales_in(belief.prior)
        last = Start(z, belief.noise, scales, belief.count > 0)
        found = estimate_forces(
            self.system, rows, self.sim.dt, self.prior(1.0), last, key
        )
        names = self.system.parameters.names
        found.convergence.check(names, f"{data.count} transitions")
        return belief_of(self.sim, found, rows)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> Sim2GPBelief:
        """Condition on one transition; scales wait for the next fit."""
        return self.sim.update(belief, s, a, s2)

    def prior(self, scale: float) -> ParameterPrior:
        """The simulator's, with all forces at one scale."""
        table = self.system.parameters
        return ParameterPrior(self.sim.prior, table, jnp.full(len(table.groups), scale))
