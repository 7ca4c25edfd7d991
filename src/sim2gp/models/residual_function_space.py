"""RES-FS: physics plus a residual that is told where it has no business.

    f(x) = f(x, tt) + c (.) W^T phi(x),        c = 3 sig_sim

The residual is trained as in `matching`, with mean zero and covariance ``Se_sim`` as
its target: far from the data it returns to the simulator, with the simulator's fitted
discrepancy as *epistemic* variance. The constants keep their own spread, as wide as
the data's parts disagree about them (`tempering`): beyond the box that the layer was
matched on physics says how uncertainty grows, which saturated features cannot.
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp

from sim2gp.belief import AbstractBelief, AbstractModel
from sim2gp.data.transitions import Transitions
from sim2gp.models import features, hybrid, nlm
from sim2gp.models import function_space_loss as matching
from sim2gp.models.features import Encoding
from sim2gp.models.function_space import (
    budget_of,
    head_of,
    objective_of,
    start,
)
from sim2gp.models.function_space_loss import Budget, Objective
from sim2gp.models.hybrid import HybridBelief
from sim2gp.models.residual import SCALE
from sim2gp.models.sim2gp import Sim2GP, Sim2GPBelief
from sim2gp.models.tempering import tempered
from sim2gp.models.training import chosen
from sim2gp.types import Action, Key, State, in_float64

#: Measured on the Furuta: a narrower start or a faster rate covers less.
RATE, INITIAL_SCALE, POOL = 2e-3, 0.3, 4096


class ResidualFunctionSpace(AbstractModel):
    """Simulator plus residual, matched to the simulator where there are no data.

    steps, refit_steps: Adam steps of the first fit and of later ones; the last third
    is on all data, after the noise has been fitted to the held-out fifth.
    Other options as in `NLM`.
    """

    sim: Sim2GP
    encoding: Encoding
    objective: Objective
    hidden: tuple[int, ...] = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    refit_steps: int = eqx.field(static=True)

    def __init__(
        self,
        sim: Sim2GP,
        *,
        objective: str = "recommended",
        hidden: tuple[int, ...] = (64, 64),
        steps: int = 2000,
        refit_steps: int = 1000,
        reach: Mapping[str, float] | None = None,
    ) -> None:
        self.sim = sim
        self.encoding = Encoding.of(sim.system, reach or {})
        self.objective = objective_of(objective)
        self.hidden = tuple(hidden)
        features.check_training(
            "ResidualFunctionSpace", self.hidden, steps=steps, refit_steps=refit_steps
        )
        self.steps = steps
        self.refit_steps = refit_steps

    @in_float64
    def init(self, key: Key) -> HybridBelief:
        """The simulator's prior, and no residual."""
        return hybrid.before_data(self.sim, self.encoding, self.hidden, key)

    @in_float64
    def fit(
        self, belief: AbstractBelief, data: Transitions, *, key: Key
    ) -> HybridBelief:
        """SIM2GP, then the residual. Raises what SIM2GP's fit raises, `NotFinite`."""
        assert isinstance(belief, HybridBelief)
        if data.count == 0:
            return belief
        first, second = jax.random.split(key)
        sim = self.sim.fit(belief.sim, data, key=first)
        steps = self.refit_steps if int(belief.count) else self.steps
        data = jax.tree.map(jnp.asarray, data)
        budget = budget_of(0, steps, RATE)
        fitted = _fit(belief, sim, data, second, budget, self.objective)
        return nlm.checked(fitted, data)

    def update(
        self, belief: AbstractBelief, s: State, a: Action, s2: State
    ) -> HybridBelief:
        """Condition on one transition; call in float64.

        Before the first fit the constants learn, for there is no residual; from then on
        the layer alone: the constants' spread is how far whole parts of the data
        disagree, of which one row knows nothing.
        """
        assert isinstance(belief, HybridBelief)
        fitted, before = jnp.any(belief.head.output_scale > 0.0), belief.physics
        scale = jnp.where(fitted, 0.0, before.scale)
        still = eqx.tree_at(lambda b: b.physics.scale, belief, scale)
        later = hybrid.conditioned(self.sim, still, s, a, s2)
        physics = chosen(fitted, before, later.physics)
        return eqx.tree_at(lambda b: b.physics, later, physics)


@eqx.filter_jit
def _fit(
    belief: HybridBelief,
    sim: Sim2GPBelief,
    data: Transitions,
    key: Key,
    budget: Budget,
    objective: Objective,
) -> HybridBelief:
    pool, training = jax.random.split(key)
    head, mask = belief.head, data.mask
    X, y = features.encoded(head.encoding, data)
    r, _, J = hybrid.residuals(sim, data, y)
    physics, kappa = tempered(sim, r, J)
    c = SCALE * sim.noise
    S, A = matching.inputs(pool, head.encoding, data, POOL)
    target = matching.targets(
        jax.vmap(head.encoding)(S, A),
        jnp.zeros((len(S), c.size)),
        jnp.zeros((len(S), c.size, 0)),  # the constants' spread is not the layer's
        sim.noise / c,
        objective.sets,
    )
    q, noise = matching.train(
        start(belief, sim, c, INITIAL_SCALE),
        X,
        r / c[None],
        mask,
        target,
        objective,
        budget,
        training,
    )
    head = head_of(belief, q, noise, c)
    kept = jnp.ones(())
    return HybridBelief(sim, physics, kept, kappa, head, noise * c, jnp.sum(mask))
