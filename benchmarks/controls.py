"""What a referee would ask of MissingForces: parts of it left out, and other models.

Learners for `missing_forces.py`. Left out, one at a time: the projected starts, the
choice of scales, the smooth functions. Other models of what the simulator leaves: an
exact Gaussian process on each output of a step, and an ensemble of networks. The
paper's learners about a simulator that was fitted from more starts. And physics that is
no force of one variable: backlash, friction that grows with the load, damping that
grows with position.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from residual_models import Ensemble, ProcessResidual
from sim2gp.belief import AbstractBelief
from sim2gp.data.one_step import OneStepLikelihood
from sim2gp.data.transitions import Transitions
from sim2gp.inference.arrowhead import Noise
from sim2gp.inference.convergence import converged
from sim2gp.inference.estimate import Estimate, estimate
from sim2gp.inference.gaussian import Gaussian
from sim2gp.inference.groups import BROAD, ROWS, Start, best_ended
from sim2gp.inference.least_squares import prior_rows
from sim2gp.inference.parameters import Parameter
from sim2gp.inference.prior import AbstractPrior, ParameterPrior
from sim2gp.inference.variable_projection import projected
from sim2gp.models import FunctionSpace, MissingForces, Residual, Sim2GP
from sim2gp.models.sim2gp import Sim2GPBelief, belief_of
from sim2gp.studies.learners import METHODS
from sim2gp.studies.swingup import Cell
from sim2gp.systems.actuators import Lag
from sim2gp.systems.effects.base import SUBSTEP, AbstractForce, on_joint
from sim2gp.systems.effects.bases import Gap, Sign
from sim2gp.systems.effects.forces import AbstractUnknownFunction
from sim2gp.systems.effects.friction_laws import COULOMB_SUBSTEP, coulomb
from sim2gp.systems.effects.units import gravity_of
from sim2gp.systems.mechanism import AbstractMechanism, Pair
from sim2gp.systems.parts import AbstractPart
from sim2gp.types import AnyArray, Key, Scalar, in_float64

DRAWS, BEST = 256, 3  # of the prior, and of these as starts
#: Past inputs that a gap depends on, s; a swing crosses it more often.
REMEMBERED = 0.2


class AbstractLessForces(MissingForces):
    """MissingForces with another estimate, and nothing else changed."""

    def found(
        self,
        likelihood: OneStepLikelihood,
        prior: ParameterPrior,
        last: Start,
    ) -> Estimate:
        raise NotImplementedError

    def _estimate(
        self, sim: Sim2GP, belief: Sim2GPBelief, rows: Transitions
    ) -> Estimate:
        likelihood = OneStepLikelihood(sim.system, rows, sim.dt)
        return self.found(likelihood, self._prior(), self._start(belief))


class WithoutProjection(AbstractLessForces):
    """From the last fit, or from the prior's mean with the noise of no model."""

    def found(
        self,
        likelihood: OneStepLikelihood,
        prior: ParameterPrior,
        last: Start,
    ) -> Estimate:
        first = likelihood.first_noise().sd
        z = jnp.where(last.enough, last.z, 0.0)
        sd = jnp.where(last.enough, last.noise, first)
        scales = jnp.where(last.enough, BROAD * last.scales, BROAD)
        noise = Noise(sd, jnp.ones(1))
        return estimate(likelihood, prior.scaled(scales), starts=z[None], noise=noise)


class WithoutRelevance(AbstractLessForces):
    """All functions at the scale of their prior, always.

    The fit counts where it ended: the width of a dead zone that does nothing has a
    valley without a bottom.
    """

    def found(
        self,
        likelihood: OneStepLikelihood,
        prior: ParameterPrior,
        last: Start,
    ) -> Estimate:
        some = likelihood.thinned(ROWS)
        z, sd, _ = eqx.filter_jit(projected)(some, prior, last.z)
        given = GivenScales(prior)
        noise = Noise(sd, jnp.ones(1))
        found = estimate(likelihood, given, starts=z[None], noise=noise)
        return replace(found, convergence=converged(len(prior.table)))


class GivenScales(AbstractPrior):
    """A table's prior whose groups are parameters like all others."""

    gaussian: Gaussian
    whole: ParameterPrior

    def __init__(self, whole: ParameterPrior) -> None:
        self.gaussian, self.whole = whole.gaussian, whole

    @property
    def linear(self) -> tuple[int, ...]:
        return self.whole.linear

    def moved(self, z: Float[AnyArray, " p"], dz: Float[AnyArray, " p"]) -> AnyArray:
        return self.whole.moved(z, dz)

    def rows(self, z: Float[AnyArray, " p"]) -> Float[AnyArray, "q p1"]:
        return prior_rows(z)

    def curvature(
        self, z: Float[AnyArray, " p"], gradient: Float[AnyArray, " p"]
    ) -> Float[AnyArray, "p p"]:
        return self.whole.curvature(z, gradient)


class ShapesAlone(MissingForces):
    """Dry friction and dead zones; no smooth functions."""

    def counts(self, function: AbstractUnknownFunction) -> bool:
        return isinstance(function.basis, Gap | Sign)


class MoreStarts(Sim2GP):
    """A simulator fitted from the best of its prior's draws as well.

    Each of three begins with the noise that it leaves itself. The fit of highest
    evidence counts.
    """

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> Sim2GPBelief:
        assert isinstance(belief, Sim2GPBelief)
        rows = jax.tree.map(jnp.asarray, data)
        warm = self.prior.whitened(belief.posterior.mean)
        found = _from_many(self, rows, warm, key)
        found.convergence.check(self.system.parameters.names, f"{data.count} rows")
        return belief_of(self, found, rows)


@eqx.filter_jit
def _from_many(
    model: Sim2GP, data: Transitions, warm: Float[Array, " p"], key: Key
) -> Estimate:
    likelihood = OneStepLikelihood(model.system, data, model.dt)
    prior = ParameterPrior(model.prior, model.system.parameters)
    some, (p,) = likelihood.thinned(ROWS), warm.shape

    def left(z: Array) -> tuple[Scalar, Array]:
        """The cost with the noise profiled out, and this noise."""
        mean = model.prior.mean + model.prior.scale @ z
        r, _ = some.rows(mean, jnp.zeros((p, 1)))
        sd = jnp.sqrt(jnp.mean(r**2, axis=0)) + likelihood.floor
        cost = ROWS * jnp.sum(jnp.log(sd)) + 0.5 * z @ z
        return jnp.where(jnp.isfinite(cost), cost, jnp.inf), sd

    Z = jax.random.normal(key, (DRAWS, p))
    cost, sd = jax.vmap(left)(Z)
    best = jnp.argsort(cost)[:BEST]
    usual = jnp.stack([warm, jnp.zeros(p)])
    first = jnp.broadcast_to(likelihood.first_noise().sd, (len(usual), sd.shape[1]))

    def descend(start: tuple[Array, Array]) -> Estimate:
        z, noise = start
        noise = Noise(noise, jnp.ones(1))
        return estimate(likelihood, prior, starts=z[None], noise=noise)

    starts = (usual, Z[best]), (first, sd[best])
    return best_ended(jax.lax.map(descend, tuple(map(jnp.concatenate, starts))))


class LoadFriction(AbstractForce):
    """Dry friction of the arm that grows with the pendulum's pull on its bearing.

    ``-magnitude tanh(v / width) |1 + L alpha'^2 cos(alpha) / (2 g)|``, N m.
    """

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=2e-3)
    what: ClassVar[str] = "load_friction"
    meaning: ClassVar[str] = "friction that grows with load"
    max_substep: ClassVar[float] = COULOMB_SUBSTEP

    def unit(self, plant: Any) -> str:
        return "N m"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        pull = params.pendulum_length * v[1] ** 2 * jnp.cos(q[1])
        load = jnp.abs(1.0 + 0.5 * pull / gravity_of(system))
        return on_joint(0, -coulomb(v[0], x, 0.05) * load)


class RisingDamping(AbstractForce):
    """Damping of the arm that grows with its angle: ``-magnitude theta^2 theta'``."""

    where: str = eqx.field(static=True, default="theta")
    magnitude: float = eqx.field(static=True, default=2e-3)
    what: ClassVar[str] = "rising_damping"
    meaning: ClassVar[str] = "damping that grows with position"
    max_substep: ClassVar[float] = SUBSTEP

    def unit(self, plant: Any) -> str:
        return "N m s/rad^3"

    def force(
        self, system: AbstractMechanism, params: Any, x: Scalar, q: Pair, v: Pair
    ) -> Pair:
        return on_joint(0, -x * q[0] ** 2 * v[0])


class Backlash(Lag):
    """Play between command and motor: the input follows once the gap is crossed.

    ``y_k = clip(y_k-1, u_k - magnitude, u_k + magnitude)``, V, from the oldest input
    that the state carries.
    """

    where: str = eqx.field(static=True, default="voltage")
    magnitude: float = eqx.field(static=True, default=0.9)
    what: ClassVar[str] = "backlash"
    meaning: ClassVar[str] = "half the gap of the input"

    def unit(self, plant: Any) -> str:
        return "V"

    def parameter(self, plant: Any) -> Parameter:
        box = 0.05 * self.magnitude, 2.0 * self.magnitude
        return Parameter(self.name, "V", self.meaning, "log_bounded", *box)

    def memory(self, longest: float) -> float:
        return REMEMBERED

    def means(
        self, held: Float[Array, " past"], dt: float, lag: Scalar, count: int
    ) -> Float[Array, " count"]:
        y = held[-1]
        for u in held[-2::-1]:
            y = jnp.clip(y, u - lag, u + lag)
        return jnp.broadcast_to(y, (count,))


OUTSIDE: dict[str, AbstractPart] = {
    "backlash": Backlash(),
    "load friction": LoadFriction(),
    "rising damping": RisingDamping(),
}


class ControlCell(Cell):
    """A cell whose condition may be one of `OUTSIDE`, and its method a control."""

    @property
    def missing(self) -> AbstractPart:
        if self.condition in OUTSIDE:
            return OUTSIDE[self.condition]
        return super().missing


def _on(make: Any, system: Any, _: AbstractPart, options: Mapping[str, Any]) -> Any:
    return make(Sim2GP(system), reach=options["reach"])


CONTROLS = {
    "without projection": partial(_on, WithoutProjection),
    "without relevance": partial(_on, WithoutRelevance),
    "shapes alone": partial(_on, ShapesAlone),
    "GP residual": partial(_on, ProcessResidual),
    "SIM2GP, more starts": lambda system, *_: MoreStarts(system),
    "FS, more starts": lambda system, _, options: FunctionSpace(
        MoreStarts(system), **options
    ),
    "FS literal, more starts": lambda system, _, options: FunctionSpace(
        MoreStarts(system), objective="literal", **options
    ),
    "RES, more starts": lambda system, _, options: Residual(
        MoreStarts(system), **options
    ),
    "ensemble": lambda system, _, options: Ensemble(
        Residual(Sim2GP(system), **options)
    ),
}
METHODS.update(CONTROLS)
