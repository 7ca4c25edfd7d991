"""MissingForces: the simulator with Gaussian processes where physics may be missing.

    M(q) dv/dt = forces(q, v, u + h(u)) + f(q) + g(v),      f, g, h ~ GP(0, tau^2 k)

(`sim2gp.systems.effects.forces`). Weights of the functions are parameters like the
simulator's own, so that the linearised posterior is that of `Sim2GP`. Each fit chooses
the scales (`sim2gp.inference.relevance`): before data all are off.

Where much is missing, a descent from the prior's mean ends at parameters that explain
little with much noise. Fits start from draws of the simulator's own parameters for
which the forces are solved linearly (variable projection: Golub and Pereyra 1973), with
the noise that is left there.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import CONVERGED
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.prior import ParameterPrior
from sim2gp.inference.relevance import OFF
from sim2gp.inference.variable_projection import projected
from sim2gp.models.features import Encoding
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief, belief_of
from sim2gp.systems.assemble import free_parts
from sim2gp.systems.base import AbstractSystem
from sim2gp.systems.effects.missing import missing_forces
from sim2gp.types import Action, Key, State, in_float64

#: Draws of the simulator's parameters, and transitions that judge them.
DRAWS, ROWS = 64, 64
BROAD = 3.0  # scale of every force in a first descent
SAME = 1.2  # times the last noise: the last fit still explains the data


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
        first = np.asarray([at[0] for at in self.system.parameters.groups.values()])
        scales = (jnp.diag(belief.prior.scale) / jnp.diag(about.scale))[first]
        last = _Start(z, belief.noise, scales, belief.count > 0)
        found = _fit(self, rows, last, key)
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
        scales = np.full(len(table.groups), scale)
        return ParameterPrior(self.sim.prior, table, scales)


class _Start(NamedTuple):
    """Where a descent begins: whitened parameters, noise, scales of the forces.

    ``enough`` asks for no other start where it leaves no more noise than it began with;
    ``project`` for projected parameters and their noise in place of these.
    """

    z: Float[Array, "*s p"]
    noise: Float[Array, "*s d"]
    scales: Float[Array, "*s g"]
    enough: Bool[Array, "*s"]
    project: bool | Bool[Array, "*s"] = False


@eqx.filter_jit
def _fit(model: MissingForces, data: Transitions, last: _Start, key: Key) -> Estimate:
    """From the last fit; where that no longer explains the data, the fit of highest
    evidence from projected parameters, and from the simulator with all forces off."""
    likelihood = OneStepLikelihood(model.system, data, model.sim.dt)
    prior = model.prior(BROAD)
    first, no = likelihood.first_noise().sd, jnp.zeros((), bool)
    off = last.z.at[np.asarray(prior.linear)].set(0.0)
    fitted = last._replace(z=jnp.where(last.enough, last.z, jnp.nan))
    plain = _Start(off, first, OFF / BROAD * prior.scales, no)
    each = fitted, _Start(off, first, prior.scales, no, True), plain

    def best_draw(_: _Start) -> tuple[Array, Array]:
        some = likelihood.thinned(ROWS)
        (z,), (sd,) = projected(some, prior, DRAWS, 1, key)
        return z, sd

    def descend(start: _Start) -> Estimate:
        given = lambda start: (start.z, start.noise)  # noqa: E731
        z, sd = jax.lax.cond(start.project, best_draw, given, start)
        noise, about = Noise(sd, jnp.ones(1)), prior.scaled(start.scales)
        starts = z[None]
        return estimate(likelihood, about, starts=starts, noise=noise)

    def skip(start: _Start) -> Estimate:
        shapes = jax.eval_shape(descend, start)
        none: Estimate = jax.tree.map(lambda x: jnp.full(x.shape, -1, x.dtype), shapes)
        return none

    def turn(done: Array, start: _Start) -> tuple[Array, Estimate]:
        found = jax.lax.cond(done, skip, descend, start)
        same = jnp.all(found.noise.sd <= SAME * start.noise)
        ended = found.convergence.status == CONVERGED
        return done | (start.enough & same & ended), found

    stacked = jax.tree.map(lambda *x: jnp.stack(x), *each)
    _, found = jax.lax.scan(turn, no, stacked)
    there = found.convergence.status == CONVERGED
    there = there & jnp.isfinite(found.log_evidence)
    ranked = jnp.where(there, found.log_evidence, -jnp.inf)
    best: Estimate = jax.tree.map(lambda x: x[jnp.argmax(ranked)], found)
    return best
